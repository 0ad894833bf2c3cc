"""What the pages share: one HTML file each, escaped, with Plotly's script in it, that asks nobody for anything."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jinja2
import plotly.graph_objects as go
from plotly.utils import PlotlyJSONEncoder

from station import __version__
from station.runs.files import new_file
from station.view import wording

PLOTLY = "plotly-basic.min.js"
"""Plotly's basic bundle, which every page holds; plotly-basic.toml says where it comes from."""


def render(template: str, *styles: str, figures: Mapping[str, go.Figure] = MappingProxyType({}), **values: Any) -> str:
    """A page's HTML; every text is escaped but the style, the scripts and the figures' JSON.

    ``styles``: sheets beyond the one that all pages have; ``figures``: by name, drawn by the page's script.
    """
    drawn = script_json({name: figure.to_plotly_json() for name, figure in figures.items()})
    css = "\n".join(map(_asset, ("report.css", *styles)))
    return _environment().get_template(template).render(words=wording, version=__version__, css=css,
                                                        plotly=_asset(PLOTLY), js=_asset("report.js"), figures=drawn,
                                                        **values)


def write_page(path: str | Path, text: str, overwrite: bool = True) -> None:
    """Write a page, whole or not at all; WorkError where the file cannot be written."""
    with new_file(path, overwrite) as part:
        part.write_text(text, encoding="utf-8")


def script_json(value: Any) -> str:
    """JSON for a script element, without a character that could end it."""
    text = json.dumps(value, cls=PlotlyJSONEncoder, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(loader=jinja2.FunctionLoader(_asset), autoescape=True, trim_blocks=True,
                                     lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    environment.filters["capitalize_first"] = lambda text: text[:1].upper() + text[1:]
    return environment


def _asset(name: str) -> str:
    return (resources.files("station.view") / "page" / name).read_text(encoding="utf-8")

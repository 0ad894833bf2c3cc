"""What the pages share: one HTML file each, escaped, with Plotly's script in it, that asks nobody for anything."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from plotly.utils import PlotlyJSONEncoder

from station.runs.files import new_file
from station.view import wording

PLOTLY = "plotly-basic.min.js"
"""Plotly's basic bundle, which every page holds; plotly-basic.toml says where it comes from."""


def render(template: str, *styles: str, **values: Any) -> str:
    """A page's HTML; every text is escaped but the style, the scripts and the figures' JSON.

    ``styles`` are sheets beyond the one that all pages have.
    """
    css = "\n".join(map(_asset, ("report.css", *styles)))
    return _environment().get_template(template).render(words=wording, plotly=_asset(PLOTLY), css=css,
                                                        js=_asset("report.js"), **values)


def write_page(path: str | Path, text: str) -> None:
    """Write a page, whole or not at all; WorkError where the file cannot be written."""
    with new_file(path, overwrite=True) as part:
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

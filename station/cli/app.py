"""All commands, gathered from one small file per group."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

import station
from station.cli import bench, campaign, demo, devices, diagnosis, files, investigate, models, run, unseal, views


def build() -> typer.Typer:
    """The application; nothing heavy is imported before a command runs."""
    app = typer.Typer(
        name="station", add_completion=True, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog="Start here: station demo. Every command has its own --help with an example.")
    app.callback()(_options)
    for group in (demo, unseal, devices, bench, run, files, views, models, diagnosis, investigate, campaign):
        app.add_typer(group.app)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"station {station.__version__}")
        raise typer.Exit


def _options(
    version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_print_version,
                                          help="Show the version and exit.")] = False,
    effects: Annotated[list[Path] | None, typer.Option("--effects", metavar="FILE.py", help=(
        "Python file with effects of your own, which is run; may be repeated. Stands before the command; the "
        "environment variable STATION_EFFECTS does the same."))] = None,
) -> None:
    """Test a rig, find what its simulation gets wrong, name the cause, and measure the gain."""
    if effects:
        from station.model.effects import FILES, load_effects

        for path in effects:
            load_effects(path)
        files = [os.environ.get(FILES, ""), *(str(path.resolve()) for path in effects)]
        os.environ[FILES] = os.pathsep.join(filter(None, files))    # for the processes that a command starts

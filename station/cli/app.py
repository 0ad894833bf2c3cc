"""All commands, gathered from one small file per group."""

from __future__ import annotations

from typing import Annotated

import typer

import station
from station.cli import demo, devices, diagnosis, files, models, run, views


def build() -> typer.Typer:
    """The application; nothing heavy is imported before a command runs."""
    app = typer.Typer(
        name="station", add_completion=True, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog="Start here: station demo. Every command has its own --help with an example.")
    app.callback()(_options)
    for group in (demo, devices, run, files, views, models, diagnosis):
        app.add_typer(group.app)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"station {station.__version__}")
        raise typer.Exit


def _options(version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_print_version,
                                                   help="Show the version and exit.")] = False) -> None:
    """Test a rig, find what its simulation gets wrong, name the cause, and measure the gain."""

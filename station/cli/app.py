"""All commands, gathered from one small file per group."""

from __future__ import annotations

import typer

from station.cli import demo, devices, diagnosis, files, models, tests


def build() -> typer.Typer:
    """The application; nothing heavy is imported before a command runs."""
    app = typer.Typer(
        name="station", add_completion=True, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Test a rig, find what its simulation gets wrong, name the cause, and measure the gain.",
        epilog="Start here: station demo. Every command has its own --help with an example.")
    app.callback()(_version)
    for group in (demo, devices, tests, files, models, diagnosis):
        app.add_typer(group.app)
    return app

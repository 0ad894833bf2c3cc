"""The line and the device behind it, without a test: ports."""

from __future__ import annotations

import typer

from station.cli.options import Json, command
from station.cli.terminal import console, row, say, table, write_json

app = typer.Typer()
PANEL = "Devices"


@command(app, "ports", PANEL, "station ports")
def ports(json: Json = None) -> None:
    """List the serial ports of this machine, and the simulated rigs."""
    from station.device.port import list_ports
    from station.rig import builtin_rigs

    found = list_ports()
    simulated = [f"sim://{name}" for name in builtin_rigs()]
    if json:
        write_json(json, {"ports": [{"port": port.path, "description": port.description, "hardware": port.hardware}
                                    for port in found], "simulated": simulated})
        if json == "-":
            return
    shown = table("", "port", "description")
    for port in found:
        row(shown, port.path, port.description)
    for url in simulated:
        row(shown, url, "simulated rig, no hardware")
    console().print(shown)
    if not found:
        say("This machine has no serial port; is the board plugged in?")

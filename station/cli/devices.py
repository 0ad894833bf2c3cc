"""The line and the device behind it, without a test: ports, loopback, check, device."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from station.cli.options import AnswerTicks, Baud, Json, Overwrite, Port, RigName, command, need_outputs
from station.cli.terminal import as_json, console, note, number, progress, row, say, table

if TYPE_CHECKING:
    from station.device.server import Addresses

app = typer.Typer()
PANEL = "Devices"


@command(app, "ports", PANEL, "station ports")
def ports(json: Json = None, overwrite: Overwrite = False) -> None:
    """List the serial ports of this machine, and the simulated rigs."""
    from station.device.port import list_ports
    from station.device.sealed import sealed_rigs
    from station.rig import builtin_rigs

    need_outputs(json, overwrite=overwrite)
    found = list_ports()
    simulated = [f"sim://{name}" for name in builtin_rigs()]
    sealed = [f"sim://{name}" for name in sealed_rigs()]
    if as_json(json, {"ports": [{"port": port.path, "description": port.description, "hardware": port.hardware}
                                for port in found], "simulated": simulated, "sealed": sealed}, overwrite):
        return
    shown = table("", "port", "description")
    for port in found:
        row(shown, port.path, port.description)
    for url in simulated:
        row(shown, url, "simulated rig, no hardware")
    for url in sealed:
        row(shown, url, "the rig sflr with a hidden effect; `station unseal` opens it")
    console().print(shown)
    if not found:
        say("This machine has no serial port; is the board plugged in?")


@command(app, "loopback", PANEL, "station loopback --port sim://sflr")
def loopback(
    port: Port,
    rate: Annotated[float | None, typer.Option("--rate", min=1.0, metavar="HZ", help=(
        "Samples per second; by default the most that device and line offer."))] = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, max=3600.0, help="How long, s.")] = 2.0,
    answer_ticks: AnswerTicks = 1, baud: Baud = None, json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Check a line and its device, the motor held at zero: identity, rate, losses, latency, and what to do."""
    from station.device.client import Client
    from station.device.port import open_port
    from station.loop.loopback import loopback as exchange

    need_outputs(json, overwrite=overwrite)
    with open_port(port, baud) as line, progress(f"loopback on {port}") as update:
        found = exchange(line, rate, seconds, answer_ticks, lambda row, rows: update(row / rows))
        counters = Client(line).statistics()._asdict()
    if as_json(json, {**asdict(found), "counters": counters}, overwrite):
        return
    say(f"{'Good' if found.ok else 'Not good'}: {found.identity.board} on {port}")
    for words in found.verdict:
        say(f"  {words}")
    shown = table("", "", "median", "99 %", "99.9 %", "longest")
    arrival = [] if found.identity.virtual_time else [("arrival, us", found.arrival_jitter)]
    for name, spread in (("answer, us", found.latency), ("device's ticks, us", found.device_jitter), *arrival):
        row(shown, name, *(f"{1e6 * value:.1f}" for value in asdict(spread).values()))
    console().print(shown)
    for line_ in found.histogram.lines():
        say(f"  {line_}")
    measured = "virtual time" if found.rate_measured is None else f"{found.rate_measured:.3f} Hz by this host's clock"
    say(f"{found.counts.samples} samples at {found.rate:g} Hz ({measured}), "
        f"{100.0 * found.answered:.3f} % answered in time, {found.counts.lost} lost, {found.counts.corrupt} corrupt")
    shown_counters = (f"{name} {value}" for name, value in counters.items() if name not in ("state", "fault", "status"))
    say(f"the device's counters: {', '.join(shown_counters)}; last reset: {found.identity.reset_words}")


@command(app, "check", PANEL, "station check --port sim://sflr --rig sflr")
def check(
    port: Port, rig: RigName,
    amplitude: Annotated[float, typer.Option("--amplitude", help="Size of the pulses, counts.")] = 20.0,
    baud: Baud = None, json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Send small pulses either way; say whether motor, encoder and accelerometer work and which way they point."""
    from station.cli import motor_driven
    from station.device.port import open_port
    from station.loop.check import check as check_rig
    from station.rig import load_rig

    need_outputs(json, overwrite=overwrite, inputs=[rig])
    model = load_rig(rig)
    with motor_driven(), open_port(port, baud) as line, progress(f"check on {port}") as update:
        found = check_rig(line, model, amplitude, lambda row, rows: update(row / rows))
    if as_json(json, asdict(found), overwrite):
        return
    say(f"{'Passed' if found.passed else 'Not passed'}: {model.name} on {port}")
    for words in found.words:
        say(f"  {words}")
    say(f"  encoder moved {number(found.travel)} counts, expected {number(found.expected_travel)}")
    if model.accelerometer is not None:
        say(f"  accelerometer peaked at {number(found.accel_peak)} counts, "
            f"expected {number(found.expected_accel_peak)}")


@command(app, "device", PANEL, "station device --rig sflr --tcp 7777")
def device(
    rig: RigName,
    tcp: Annotated[int | None, typer.Option("--tcp", min=0, max=65535, metavar="PORT", help=(
        "Listen at this TCP port of 127.0.0.1 (0: any free one), and never at another address."))] = None,
    pty: Annotated[bool | None, typer.Option("--pty/--no-pty", help=(
        "Offer a pseudo-terminal. By default where the platform has them and no --tcp is given."))] = None,
    speed: Annotated[int, typer.Option("--speed", min=0, max=1, help="1: real time; 0: lockstep.")] = 1,
    noise: Annotated[float, typer.Option("--noise", min=0.0, help="Accelerometer noise, counts, one sigma.")] = 0.0,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Repeats the noise.")] = None,
    board: Annotated[str, typer.Option("--board", help=(
        "host: the firmware compiled for this machine; mps2_an385: for a Cortex-M3 that QEMU emulates."))] = "host",
) -> None:
    """Put a simulated rig at a pseudo-terminal or a loopback socket, for any serial program; Ctrl-C ends it."""
    import os

    from station.device.server import serve
    from station.device.simulated import Options
    from station.rig import load_rig

    if pty is None:
        pty = tcp is None and hasattr(os, "ttyname")
        tcp = 0 if tcp is None and not pty else tcp
    model = load_rig(rig)

    def ready(found: Addresses) -> None:
        for address in (found.pty, found.tcp):
            if address:
                say(address)
        note(f"{model.name} answers; Ctrl-C ends it")

    with suppress(KeyboardInterrupt):
        serve(model, pty, tcp, ready_callback=ready, options=Options(speed=speed, noise=noise, seed=seed), board=board)

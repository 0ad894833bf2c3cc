#!/usr/bin/env python3
"""An effect of one's own: rubber stops at both ends of an axis's travel, which no effect of the catalogue describes.

    python scripts/own_effect.py [FOLDER]       hides the stops in a simulated axis, tests it, and diagnoses it twice:
                                                without this file, then with it (about half a minute)
    station --effects scripts/own_effect.py diagnose --rig RIG.toml RUN...      the same on runs of your own

Everything above RIG is what such a file must hold; docs/own_effect.md explains it line by line.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlencode

from station.model.effects import Effect, Stage
from station.model.effects.base import parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = -k (|x| - reach) sign(x) beyond the reach, else 0; N m, x the angle in rad, p the parameters in order."""
    if x > p[1]:
        return -p[0] * (x - p[1])
    if x < -p[1]:
        return -p[0] * (x + p[1])
    return 0.0


class RubberStops(Effect):
    """The arm runs into rubber at the same angle on either side."""

    name, title = "rubber_stops", "rubber stops"
    sites: ClassVar = ("base",)
    stage, law = Stage.TORQUE, torque
    absolute = "reach"
    picture = "angle"
    experiment: ClassVar = {"kind": "step", "amplitude": 200, "controller": "p"}
    telling = ("moves within the reach are right and longer ones bounce, at the same angle every time; a cable spring "
               "and gravity by tilt pull at every angle")

    stiffness: float = parameter("N m/rad", 0.0, neutral=0.0)
    reach: float = parameter("rad", 0.0, math.pi)

    @classmethod
    def guesses(cls, rig, at):
        """A stop as stiff as lets the motor's whole torque bend it by 0.2 rad or by 2 rad, at several angles."""
        return [{"stiffness": torque_scale(rig) / bend, "reach": reach}
                for bend in (0.2, 2.0) for reach in (0.2, 0.4, 0.8, 1.6)]


RIG = """
name = "axis"
sample_rate = 500.0

[amplifier]
limit = 200.0

[motor]
inertia = 0.02
damping = 0.15
gain = 0.01

[encoder]
counts_per_revolution = 1024

[uncertainty]
default = 0.1
"""
HIDDEN = RIG.replace("damping = 0.15", "damping = 0.16") + """
[[effects]]
effect = "rubber_stops"
stiffness = 4.0
reach = 0.55
"""
"""The rig that is tested; whoever diagnoses knows RIG alone.  A rig file names the effect, it never brings it."""
TESTS = [("p", {"kind": "step", "amplitude": 60.0, "duration": 1.4}),
         ("p", {"kind": "step", "amplitude": 140.0, "duration": 1.4}),
         ("p", {"kind": "step", "amplitude": -110.0, "duration": 1.4}),
         ("open", {"kind": "pulse", "amplitude": 90.0, "width": 0.3, "duration": 1.4})]
"""Controller and test."""


def measure(folder: Path) -> list[str]:
    """Test the hidden rig through the serial protocol, as a real one; names of the logs.

    One line for all tests: runs that share an encoder zero say together at which angles the stops are.
    """
    from functools import partial

    from station.cli.controllers import controller_spec
    from station.cli.run import perform
    from station.device.port import open_port
    from station.rig import Rig
    from station.runs import McapLogWriter

    rig, logs = Rig.from_toml(RIG), []
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (folder / "hidden.toml").write_text(HIDDEN, encoding="utf-8")
    with open_port(f"sim://hidden?{urlencode({'rig': folder / 'hidden.toml', 'speed': 0})}") as line:
        for number, (controller, test) in enumerate(TESTS):
            logs.append(f"{number}-{test['kind']}.mcap")
            perform(line, rig, controller_spec(controller, rig.sample_rate), test,
                    partial(McapLogWriter, folder / logs[-1]), metadata={"test": test, "rig": "axis"})
    return logs


def diagnose(folder: Path, logs: list[str], name: str, effects: bool) -> dict[str, Any]:
    """`station diagnose` in a process of its own, this file brought along or not; what its file says."""
    given = ["--effects", str(Path(__file__).resolve())] if effects else []
    environment = {key: value for key, value in os.environ.items() if key != "STATION_EFFECTS"}
    subprocess.run([sys.executable, "-m", "station", *given, "diagnose", "--rig", "rig.toml", *logs,
                    "--effort", "quick", "--json", f"{name}.json", "--report", f"{name}.html"],
                   cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def told(found: dict[str, Any]) -> str:
    """A diagnosis in one line."""
    causes = [f"{cause['effect']} at {cause['at']} ({cause['probability']:.0%}): " + ", ".join(
        f"{name} {value['value']:.3g} ({value['low']:.3g} to {value['high']:.3g}) {value['unit']}"
        for name, value in cause["parameters"].items()) for cause in found["causes"]]
    gain = found["gain"]["encoder"]
    return (f"{found['verdict']}; {'; '.join(causes) or 'no cause'}; error on unseen runs "
            f"{gain['nrmse_before']:.1%} > {gain['nrmse_after']:.1%}")


def demonstrate(folder: Path) -> None:
    """Test the hidden rig and diagnose it without and with this file."""
    logs = measure(folder)
    print(f"{len(logs)} tests on an axis with hidden rubber stops, stiffness 4 N m/rad, reach 0.55 rad", flush=True)
    for name, effects in (("without", False), ("with", True)):
        print(f"{name} this file: {told(diagnose(folder, logs, name, effects))}", flush=True)


def main() -> None:
    """Work in the folder named, or in one that is gone afterwards."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, help="where runs, diagnoses and reports are kept")
    folder = parser.parse_args().folder
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="station-") as made:
            demonstrate(Path(made))
    else:
        folder.mkdir(parents=True, exist_ok=True)
        demonstrate(folder.resolve())


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:      # station has said why, in one line
        sys.exit(error.returncode)

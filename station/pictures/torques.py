"""Pictures of the torque that is missing without a cause, against what its law depends on.

Points never know the law: they are smoothed from the run with nothing assumed (station.pictures.missing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import signal

from station.model.along import law_values
from station.model.effects import Effect, Stage
from station.pictures.missing import MissingTorque, missing_torque
from station.pictures.picture import TOP, Cause, Evidence, count, grid_over, thin
from station.rig import Rig
from station.runs.run import Run

MOVING = 0.02
"""Share of the largest speed above which a row counts as moving: friction at rest holds what it must."""


def sceptics_view(found: MissingTorque, run: Run) -> list[Evidence]:
    """One run's missing torque against time, speed, angle, command, load and frequency, no law assumed."""
    note = (f"Run {run.name}. Nothing is assumed but the rig without any cause: the torque missing at the motor is a "
            "random walk, smoothed from command, encoder and accelerometer; its standard deviation is "
            f"{np.median(found.sigma):.2g} N m. Jumps are rounded by the smoothing; what is wrong elsewhere in the rig "
            "shows here too.")
    if found.mistrust > 1.0:
        note += (f" No torque there explains the accelerometer, which was taken {found.mistrust:g} times noisier than "
                 "at rest.")
    title, label_y = "Torque missing at the motor, against", "torque missing at the motor"
    views = [thin(f"{title} {kind}", kind, label, f"{label_y} (N m)", x, found.torque, note=note)
             for kind, label, x in (("time", "time (s)", found.t), ("speed", "motor speed (rad/s)", found.speed),
                                    ("angle", "motor angle (rad)", found.angle),
                                    ("command", "command (counts)", found.command),
                                    ("load", "load on the gears (N m)", found.load))]
    rate = 1.0 / (found.t[1] - found.t[0])
    frequency, density = signal.welch(found.torque, rate, nperseg=min(512, len(found.t)))
    shown = (frequency > 0.0) & (frequency < TOP * rate)
    return [*views, thin(f"{title} frequency", "spectrum", "frequency (Hz)", f"{label_y} (N m/√Hz)",
                         frequency[shown], np.sqrt(density[shown]), note=note)]


def against_motion(cause: Cause, effect: Effect) -> list[Evidence]:
    """Missing torque at a part against its speed, of which alone friction is a law, or its angle."""
    found = joined(estimates(cause, effect.at))
    by_speed = effect.stage is Stage.FRICTION or effect.picture == "speed"
    x, against = (found.speed, "speed") if by_speed else (found.angle, "angle")
    grid = grid_over(x)
    motion = (np.zeros_like(grid), grid) if by_speed else (grid, np.zeros_like(grid))
    law = None if effect.states else (grid, _torque(cause.extended, effect, *motion, 0.0))
    label = f"{effect.at} speed (rad/s)" if by_speed else f"{effect.at} angle (rad)"
    rest = " At rest anything between its two sides may hold." if effect.stage is Stage.FRICTION else ""
    return [thin(f"Torque missing at the {effect.at}, against its {against}: {cause.title}", against,
                 label, "missing torque (N m)", x, found.torque, law, _torque_note(cause, found) + rest)]


def against_time(cause: Cause, effect: Effect) -> list[Evidence]:
    """Missing torque at the effect's part against time, where the effect names no better picture."""
    at = effect.at if effect.at in ("motor", "base", "drive", "clamp") else "motor"
    found = estimates(cause, at)
    worst = max(found, key=lambda m: float(np.mean(m.torque**2)))
    law = _torque(cause.extended, effect, worst.angle, worst.speed, worst.load)
    note = _torque_note(cause, joined(found), "The run that misses most. Line: the fitted law along its motion.")
    return [thin(f"Torque missing at the {at}, against time: {cause.title}", "time", "time (s)",
                 "missing torque (N m)", worst.t, worst.torque, (worst.t, law), note)]


def against_load(cause: Cause, effect: Effect) -> list[Evidence]:
    """Friction in proportion to load: what opposes the motor's motion against the load on its gears."""
    found = joined(estimates(cause, "motor"))
    load, moving = np.abs(found.load), np.abs(found.speed) > MOVING * np.max(np.abs(found.speed))
    grid = grid_over(load)
    law = None if effect.states else (grid, law_values(cause.extended, effect, 1.0, 0.0, grid))
    load_is = ("the torque in the drive" if cause.extended.drive is not None else
               "the motor's torque less what acts on the axis from outside (gravity, a beam)")
    return [thin(f"Torque that opposes the motor, against the load on its gears: {cause.title}", "load",
                 "size of the load on the gears (N m)", "torque missing against the motion (N m)", load[moving],
                 (-np.sign(found.speed) * found.torque)[moving], law,
                 _torque_note(cause, found) + f" The load is {load_is}; rows at rest are left out.")]


def against_command(cause: Cause) -> list[Evidence]:
    """Missing torque at the motor, in counts, against the command."""
    each = estimates(cause, "motor")
    found = joined(each)
    late = sum(e.values()["time"] for e in cause.without.effects if e.stage is Stage.INPUT_DELAY)
    command = np.concatenate([np.interp(m.t - late, m.t, m.command, left=0.0) for m in each])
    grid = grid_over(command)
    law = grid, _chain(cause.extended, grid) - _chain(cause.without, grid)
    return [thin(f"Command that is missing, against the command: {cause.title}", "command", "command (counts)",
                 "missing torque over motor gain (counts)", command, found.torque / cause.extended.motor.gain, law,
                 _torque_note(cause, found, "Line: what the fitted chain adds to the command."))]


def _torque(rig: Rig, effect: Effect, angle: np.ndarray, speed: np.ndarray, load: np.ndarray | float) -> np.ndarray:
    """What an effect's law puts on a part that moves so."""
    if effect.stage is Stage.FRICTION:
        return -np.sign(speed) * law_values(rig, effect, np.abs(speed), 0.0, np.abs(load))
    return law_values(rig, effect, angle, speed)


def _chain(rig: Rig, command: np.ndarray) -> np.ndarray:
    """The static part of the amplifier's chain."""
    out = np.clip(command, -rig.command_limit, rig.command_limit)
    for effect in sorted((e for e in rig.effects if e.stage is Stage.COMMAND and not e.states), key=lambda e: e.order):
        out = law_values(rig, effect, out, 0.0, rig.amplifier.limit)
    return out


def estimates(cause: Cause, at: str) -> list[MissingTorque]:
    """Of every run; by the encoder alone where no torque at this place explains the accelerometer of some run.

    Else the beam that the model has wrong would be made up for by torque, and that would bury the law.
    """
    found = [missing_torque(cause.without, run, at) for run in cause.runs]
    if all(m.mistrust == 1.0 for m in found):
        return found
    return [missing_torque(cause.without, run, at, accelerometer=False) for run in cause.runs]


def joined(found: Sequence[MissingTorque]) -> MissingTorque:
    """The rows of all runs, one run after the other, with the first run's mistrust."""
    rows: dict[str, Any] = {name: np.concatenate([getattr(m, name) for m in found])
                            for name, first in vars(found[0]).items() if isinstance(first, np.ndarray)}
    return replace(found[0], by_accel=any(m.by_accel for m in found), **rows)


def _torque_note(cause: Cause, found: MissingTorque, line: str = "Line: the fitted law.") -> str:
    alone = "" if cause.extended.accelerometer is None or found.by_accel else ", by command and encoder alone,"
    return (f"Points: torque smoothed from {count(cause.runs)}{alone} against the extended rig without this effect, "
            f"its shape not assumed; standard deviation {np.median(found.sigma):.2g} N m, jumps rounded. {line}")

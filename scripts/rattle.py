#!/usr/bin/env python3
"""What the arm's accelerometer holds above 40 Hz, and one honest try at it: the swept sine of the measured logs.

    python scripts/rattle.py [FOLDER]        the folder of measured logs, by default ../shared/data

Prints, per run, the share of the accelerometer's variance above 40 Hz; of the swept sine the amplitudes at the
command's frequency and its multiples while it passes the beam's first mode; and how well the whole closed loop of that
one run, simulated from its reference, meets it where every constant is free: alone, with drag, and with drag and a gap
in a stiff drive (squared errors, each channel's over their own mean, renewed on the way; priors as the diagnosis has
them).  About a minute.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from station.diagnose.whole_run import whole_run
from station.estimation.cause import Sizes
from station.estimation.dataset import Dataset, dataset
from station.estimation.parameters import Hypothesis, Parameters, parameters
from station.model.effects import effect_class
from station.model.simulate import build
from station.rig import PROFILE, load_rig
from station.runs import load_run
from station.runs.run import Run
from station.view.wording import number

EDGE = 40.0
RESONANCE = (9.5, 10.5)
"""Seconds of the swept sine in which the command passes the first clamped mode."""
STIFF = {"drive.stiffness": 300.0, "drive.damping": 0.3, "motor.inertia": 0.3}
"""Factors on the nominal constants from which the fit with a gap begins."""
RIGID = 100.0
"""Multiple of the nominal stiffness beyond which a drive is as good as rigid; how far beyond, rounding decides."""
GAP = 0.002
INDEPENDENT = 300.0
"""Independent errors that each channel counts for."""
ROUNDS, EACH = 12, 4
"""Times that the weights are renewed, and steps between."""
DRAG, PLAY = effect_class("sublinear_drag"), effect_class("backlash")
STEP = 1e-3
"""Of the differences: a simulation with a gap is not smooth."""


def variance_above(accel: np.ndarray, rate: float) -> float:
    """Share of a signal's variance above EDGE."""
    power = np.abs(np.fft.rfft(accel - accel.mean())) ** 2
    return float(power[np.fft.rfftfreq(len(accel), 1.0 / rate) > EDGE].sum() / power.sum())


def harmonics(run: Run, most: int = 6) -> list[tuple[float, float]]:
    """Frequency (Hz) and the accelerometer's amplitude (counts) at multiples of the command's, near the resonance."""
    rows = (run.t >= RESONANCE[0]) & (run.t < RESONANCE[1])
    window = np.hanning(rows.sum())
    frequency = np.fft.rfftfreq(rows.sum(), 1.0 / run.sample_rate)
    command, accel = (2.0 / window.sum() * np.abs(np.fft.rfft((y[rows] - y[rows].mean()) * window))
                      for y in (run.command, run.accel))
    first = frequency[np.argmax(command)]
    return [(k * first, float(accel[np.abs(frequency - k * first) <= 1.5].max())) for k in range(1, most + 1)]


def start(space: Parameters, factors: dict[str, float]) -> np.ndarray:
    """The prior's mean with some constants multiplied."""
    x = space.mean.copy()
    x[space.parts["constants"]] = np.linalg.solve(space.root, np.log([factors.get(p, 1.0) for p in space.paths]))
    return x


def errors(data: Dataset, space: Parameters, x: np.ndarray) -> np.ndarray:
    """(2, n) of the one run, each channel over its standard deviation."""
    made = whole_run(data, build(space.rig_at(x), 0.01, 5e-4), 0, data.own[0], rounding=False, place=space.place(x, 0))
    away = data.records[0].measured - np.stack([made.encoder, made.accel])
    return np.nan_to_num(away / data.records[0].measured.std(axis=1, keepdims=True), nan=1e3, posinf=1e3, neginf=-1e3)


def fitted(data: Dataset, effects: list[tuple[type, str]], sizes: Sizes, factors: dict[str, float],
           ) -> tuple[tuple[float, float], Parameters, np.ndarray]:
    """Fits of angle and acceleration, %, where every constant is free."""
    constants = tuple(path for path in data.rig.constants() if path not in PROFILE)
    centres = {(cls.name, at): sizes.get((cls.name, at), cls.guesses(data.rig, at)[0]) for cls, at in effects}
    space = parameters(data, Hypothesis(tuple(effects), constants), centres)
    x = start(space, factors)
    for _ in range(ROUNDS):
        scale = np.sqrt(INDEPENDENT / np.sum(errors(data, space, x) ** 2, axis=1, keepdims=True))

        def residual(x: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            held = np.sqrt(space.precision) * (x - space.mean)
            return np.concatenate([(scale * errors(data, space, x)).ravel(), held])

        def slopes(x: np.ndarray, residual: Callable[[np.ndarray], np.ndarray] = residual) -> np.ndarray:
            here = residual(x)
            return np.stack([(residual(x + STEP * unit) - here) / STEP for unit in np.eye(space.size)], axis=1)

        x = least_squares(residual, x, slopes, max_nfev=EACH).x
    angle, acceleration = 100.0 * (1.0 - np.sqrt(np.mean(errors(data, space, x) ** 2, axis=1)))
    return (float(angle), float(acceleration)), space, x


def shares(runs: Mapping[str, Run]) -> str:
    """A table: of each run the share above EDGE, and the fit of what meets all below and nothing above."""
    rows = [f"| run | of the variance above {EDGE:g} Hz | a simulation that met all below would fit by |",
            "| --- | --- | --- |"]
    for name, run in runs.items():
        share = variance_above(run.accel, run.sample_rate)
        rows.append(f"| {name} | {100 * share:.1f} % | {100 * (1 - share**0.5):.1f} % |")
    return "\n".join(rows)


def multiples(sweep: Run) -> str:
    """A sentence: the amplitudes at the command's frequency and its multiples."""
    return ", ".join(f"{amplitude:.1f} counts at {frequency:.0f} Hz" for frequency, amplitude in harmonics(sweep))


def tries(sweep: Run) -> str:
    """A table: how well the swept sine's whole loop is met."""
    data = dataset(load_rig("sflr"), [sweep])
    rows = ["| swept sine, constants free | angle | acceleration | drive's stiffness, times the rig file's | gap |",
            "| --- | --- | --- | --- | --- |"]
    for words, effects, sizes, factors in (
            ("no cause", [], {}, {}), ("sublinear drag", [(DRAG, "motor")], {}, {}),
            ("sublinear drag, a gap in a stiff drive", [(DRAG, "motor"), (PLAY, "drive")],
             {("backlash", "drive"): {"gap": GAP}}, STIFF)):
        (angle, acceleration), space, x = fitted(data, effects, sizes, factors)
        stiffness = space.rig_at(x).constants()["drive.stiffness"] / data.rig.constants()["drive.stiffness"]
        gap = space.values(x).get(("backlash", "drive"), {}).get("gap")
        rows.append(f"| {words} | {angle:.1f} % | {acceleration:.1f} % | "
                    f"{number(stiffness) if stiffness < RIGID else f'over {RIGID:g}'} | "
                    f"{'' if gap is None else f'{1e3 * gap:.1f} mrad'} |")
    return "\n".join(rows)


def main() -> int:
    """Print what is measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    paths = sorted((parser.parse_args().folder / "sflr").glob("*.txt"))
    if not paths:
        raise SystemExit("rattle: no logs there; name the folder that holds sflr/")
    runs = {path.stem[:24]: load_run(path) for path in paths}
    sweep = max(runs.values(), key=len)
    print(shares(runs), f"\nswept sine at its resonance: {multiples(sweep)}\n", tries(sweep), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

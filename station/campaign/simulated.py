"""Blind cases on Station's own simulated rig: drawn, tested, diagnosed, then held against what was hidden."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from station.campaign.battery import NOISE, TESTS
from station.campaign.hidden import draw
from station.campaign.outcome import Outcome, Task, diagnosed
from station.control.named import NAMED
from station.control.references import reference_from_test
from station.control.rounding import round_half_up
from station.errors import UsageError
from station.model.simulate import build, simulate_model
from station.rig import Rig
from station.runs.run import Run, RunMetadata

FACTORS = (0.7, 1.3)
"""Range of the factor on each test's amplitude."""
OFFSET = 5.0
"""Largest offset of the accelerometer, counts."""
STRAYS = 4.0
"""How far, in amplitudes, a rig may go under a compensator that suits it."""
LEAST_TESTS = 3


def planned(rig: Rig, factors: Sequence[float] | None = None) -> list[Run]:
    """The tests as runs that have not happened: references, controllers, and the open loops' commands."""
    runs = []
    for (name, (controller, test)), factor in zip(TESTS.items(), factors or [1.0] * len(TESTS), strict=True):
        test = {**test, "amplitude": float(round_half_up(test["amplitude"] * factor))}
        reference = reference_from_test(test, rig.sample_rate)
        command = np.clip(reference, -rig.command_limit, rig.command_limit)
        still = np.zeros(len(reference))
        metadata = RunMetadata(rig=rig.name, controller=NAMED[controller], test=test, command_row=-1, zero_id="bench")
        runs.append(Run(name, np.arange(len(reference)) * rig.period, reference, command, still, still, metadata))
    return runs


def suited(rig: Rig) -> list[str]:
    """Names of the tests whose compensators hold this rig; UsageError where they are too few to learn from."""
    model, names = build(rig.meshed()), []
    for run in planned(rig):
        encoder = simulate_model(model, run).encoder
        far = np.max(np.abs(encoder))
        closed = run.metadata.controller["kind"] != "open"
        if np.isfinite(far) and far >= 1.0 and (not closed or far <= STRAYS * run.metadata.test["amplitude"]):
            names.append(run.name)
    if len(names) < LEAST_TESTS:
        raise UsageError(f"rig {rig.name}: of the station's {len(TESTS)} tests only {len(names)} suit it, "
                         f"{LEAST_TESTS} are wanted")
    return names


def measured(rig: Rig, test: Run, rng: np.random.Generator, offset: float, start_angle: float) -> Run:
    """A test on a rig, whole counts, with the accelerometer's noise and offset; its noise may not enter a loop."""
    made = simulate_model(build(rig.meshed()), test, rounding="inside", start_angle=start_angle, accel_offset=offset)
    accel = made.accel
    if accel is not None:
        limit = min([effect.values()["limit"] for effect in rig.effects if effect.name == "accelerometer_saturation"],
                    default=np.inf)
        accel = _whole(np.clip(accel + rng.normal(0.0, NOISE, len(accel)), -limit, limit))
    return replace(test, command=_whole(made.command), encoder=_whole(made.encoder), accel=accel)


def _whole(values: np.ndarray) -> np.ndarray:
    """Rounded half up."""
    return np.floor(values + 0.5)


def case(task: Task) -> Outcome:
    """A rig with the effects of the task hidden, five tests at most, all drawn by its seed."""
    begun, spec = time.perf_counter(), task.spec
    nominal = Rig.from_toml(spec["rig"], source=f"{task.label}: rig")
    rng = np.random.default_rng(spec["seed"])
    names = suited(nominal)
    factors = rng.uniform(*FACTORS, len(TESTS)) * rng.choice([-1.0, 1.0], len(TESTS))
    tests = [run for run in planned(nominal, list(factors)) if run.name in names]
    hidden = draw(nominal, tests, NOISE, rng, [(effect, at) for effect, at in spec["hidden"]])
    offset = rng.uniform(-OFFSET, OFFSET)
    runs = [measured(hidden, test, rng, offset, rng.normal(0.0, 0.5) * nominal.angle_per_count) for test in tests]
    truth = [{"effect": effect.name, "at": effect.at, **effect.values()}
             for effect in hidden.effects[len(nominal.effects):]]
    return diagnosed(task, nominal, runs, spec["effort"], hidden=truth, making=time.perf_counter() - begun)

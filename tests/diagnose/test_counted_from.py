"""What a diagnosis says does not hang on the count at which a run begins, nor on where the encoder's zero lies."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from station.diagnose.diagnose import diagnose
from station.diagnose.refits import THOROUGH
from station.diagnose.result import RunComparison
from station.diagnose.starts import arrived, attempted
from station.diagnose.trials import OPEN, Trial
from station.diagnose.wrong import wrong
from station.estimation.constants import unknown
from station.estimation.least_squares import fit
from station.estimation.parameters import Hypothesis, parameters
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.runs.run import Run
from tests.estimation.made import AXIS, predictions, run_of

TESTS = ((90.0, "p2"), (-120.0, "p1"), (150.0, "p2"), (-60.0, "open"))
ZEROS = (0.0, 1.5, 3.0, -1.5)


@cache
def tilted() -> tuple[Run, ...]:
    """An axis that gravity pulls, its encoder's zero elsewhere in every test."""
    most = AXIS.motor.gain * AXIS.amplifier.limit
    rig = AXIS.with_effects([effect_class("gravity_tilt")(at="base", torque=0.1 * most, angle=0.3)])
    found = []
    for zero, (amplitude, controller) in zip(ZEROS, TESTS, strict=True):
        run = run_of(AXIS, amplitude, controller, f"zero {zero:g}", 2.0)
        meta = run.metadata.model_copy(update={"zero_id": run.name})
        planned = replace(run, command=run.reference, encoder=np.zeros(len(run)), metadata=meta)
        made = simulate(rig, planned, zero=zero, start_angle=0.0)
        found.append(replace(planned, command=made.command, encoder=made.encoder))
    return tuple(found)


def test_the_disturbance_goes_by_each_runs_own_zero() -> None:
    found = diagnose(AXIS, tilted(), effort="quick").diagnosis
    assert "gravity_tilt" in {cause.effect for cause in found.causes}
    assert found.disturbance.extended < 0.2 * found.disturbance.nominal


@pytest.mark.parametrize("wrong_run", range(1, 4))
def test_a_zero_that_a_run_shows_in_two_places_is_found_in_the_right_one(wrong_run: int) -> None:
    """A run that moves little shows where a sine stands, and that it does twice in a turn."""
    predictor = predictions(AXIS, tilted())
    runs, tilt, torque = predictor.data.runs, ("gravity_tilt", "base"), 0.1 * AXIS.motor.gain * AXIS.amplifier.limit
    true = np.array([float(run.name.split()[1]) for run in runs])
    space = parameters(predictor.data, Hypothesis(((effect_class("gravity_tilt"), "base"),)),
                       {tilt: {"torque": torque, "angle": math.remainder(0.3 - true[0], 2.0 * np.pi)}})
    x, zeros = space.mean.copy(), space.parts["zeros"]
    x[zeros] = true[1:] - true[0]
    whole = fit(predictor, space, unknown(predictor), x, **THOROUGH)
    assert np.allclose(np.exp(1j * whole.x[zeros]), np.exp(1j * (true[1:] - true[0])), atol=0.03)
    x[zeros.start + wrong_run - 1] += np.pi - 0.6
    stuck, found = (way(predictor, space, unknown(predictor), x, predictor.data.own, **THOROUGH)
                    for way in (attempted, arrived))
    assert np.allclose(np.exp(1j * found.x[zeros]), np.exp(1j * (true[1:] - true[0])), atol=0.1)
    assert found.objective <= stuck.objective


def test_a_peak_is_counted_from_where_the_run_began() -> None:
    run = run_of(AXIS, 60.0, "open", "pulses")
    told = []
    for start in (0.0, 400.0):
        moved = replace(run, encoder=run.encoder + start)
        made = simulate(AXIS.with_constants({"motor.gain": 0.5 * AXIS.motor.gain}), moved)
        (peak,) = [w for w in wrong([RunComparison(moved, made, made, made)], (0.0, 0.0)) if w.measure == "peak_counts"]
        told.append((peak.measured, peak.simulated))
    assert told[0] == told[1] and told[0][1] < told[0][0]


@pytest.mark.parametrize(("wanted", "most", "given"), [(2.5, 200.0, 3.0), (24.5, 200.0, 25.0), (300.0, 199.7, 199.0),
                                                       (0.2, 200.0, 1.0)])
def test_a_planned_amplitude_is_rounded_half_up_and_within_the_limit(wanted: float, most: float, given: float) -> None:
    assert Trial({"kind": "pulse", "amplitude": wanted}, OPEN).sized(1.0, most).amplitude == given

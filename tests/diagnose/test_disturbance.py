"""The torque that a fit misses: how often per turn it repeats itself is read off it, and named by the diagnosis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from station.diagnose.disturbance import LONGEST, waves
from station.estimation.constants import base_fit
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.parameters import Hypothesis, parameters
from station.model.effects.torque_ripple import TorqueRipple
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import predictions
from tests.truth.simulate import Truth

NOMINAL = {
    "name": "linear", "sample_rate": 1000.0, "amplifier": {"limit": 2000.0},
    "motor": {"inertia": 2.4, "damping": 30.0, "gain": 0.1},
    "encoder": {"counts_per_revolution": 2e5 * math.tau}, "uncertainty": {"default": 0.05}}
LINEAR = Rig.model_validate(NOMINAL)
"""A linear motor, m for rad, whose scale reads 5 um."""
PITCH, PHASE = 0.0317, 0.7
"""m, of no ball screw's lead; rad."""


def runs_of(amplitude: float, friction: float) -> list[Run]:
    """Moves by the independent generator, under a controller that the log does not name, of an axis 4 % too heavy; N.
    """
    heavy = {"effect": "parameter:motor.inertia", "value": 1.04 * LINEAR.motor.inertia}
    ripple = {"effect": "torque_ripple", "at": "motor", "amplitude": amplitude, "cycles": math.tau / PITCH,
              "phase": PHASE}
    truth = Truth(NOMINAL, [heavy, ripple, {"effect": "coulomb_friction", "at": "motor", "torque": friction}])
    t = np.arange(3000) / LINEAR.sample_rate
    runs = []
    for name, size, rate in (("slow", 0.10, 0.35), ("middle", 0.12, 0.7), ("fast", 0.15, 1.3)):
        reference = np.round(2e5 * size * np.sin(math.tau * rate * np.maximum(t - 0.2, 0.0)))
        made = truth.run(reference, {"kind": "cascade", "position_gain": 30.0, "speed_gain": 0.005})
        runs.append(Run(name, t, reference, made.command, made.encoder, None, RunMetadata(zero_id="scale")))
    return runs


@pytest.mark.parametrize("friction", [1e-6, 4.0])
def test_a_ripples_waves_stand_out_of_the_missing_torque(friction: float) -> None:
    predictor = predictions(LINEAR, runs_of(4.0, friction))
    found = waves(predictor, base_fit(predictor), 3)
    travel = 0.3
    assert len(found) == 3 and found[0] == pytest.approx(math.tau / PITCH, abs=0.5 * math.pi / travel)
    assert min(found) >= math.tau * LONGEST / travel


def test_a_run_that_never_moves_has_no_waves() -> None:
    t = np.arange(500) / LINEAR.sample_rate
    rest = [Run(name, t, 0.0 * t, 0.0 * t, 0.0 * t, None, RunMetadata()) for name in "ab"]
    predictor = predictions(LINEAR, rest)
    space = parameters(predictor.data, Hypothesis(), {})
    nothing = fit(predictor, space, Weighing(np.ones((2, len(predictor.channel))), 1.0), space.mean)
    assert waves(predictor, nothing, 3) == []


def test_waves_that_the_encoder_does_not_show_are_none() -> None:
    """Ten counts to each: below that it shows its own counts."""
    coarse = LINEAR.with_constants({"encoder.counts_per_revolution": 500.0 * math.tau})
    runs = [replace(run, encoder=np.floor(run.encoder / 400.0 + 0.5), reference=run.reference / 400.0)
            for run in runs_of(4.0, 4.0)]
    predictor = predictions(coarse, runs)
    found = waves(predictor, base_fit(predictor), 50)
    assert found and max(found) <= 50.0 * math.tau


def test_guesses_of_waves_stay_within_the_law() -> None:
    [ripple] = [one for one in candidates(LINEAR) if one.effect is TorqueRipple]
    guessed = ripple.repeating([0.5, 198.0, 20000.0])
    assert [guess["cycles"] for guess in guessed.guesses] == [198.0] and guessed.by_torque
    assert guessed.key == ripple.key and not ripple.by_torque


def test_cogging_of_any_pitch_is_named_beside_friction() -> None:
    found = diagnose(LINEAR, runs_of(4.0, 4.0), effort="quick").diagnosis
    causes = {cause.effect: cause.parameters for cause in found.causes}
    assert set(causes) == {"torque_ripple", "coulomb_friction"}
    ripple = causes["torque_ripple"]
    assert ripple["cycles"].value == pytest.approx(math.tau / PITCH, rel=0.01)
    assert ripple["amplitude"].value == pytest.approx(4.0, rel=0.1)
    assert ripple["phase"].value == pytest.approx(PHASE, abs=0.3)
    assert causes["coulomb_friction"]["torque"].value == pytest.approx(4.0, rel=0.15)

"""A sensor that is read the wrong way round or in another unit is told before anything is fitted, and no other is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from station.errors import WorkError
from station.estimation.answers import CORRELATED, SUSPECT, Answer, answers, refuse_wrong_signs_and_units, unlikely
from station.fit import fit
from station.model.effects.command_bias import CommandBias
from station.model.effects.coulomb_friction import CoulombFriction
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import AXIS, predictions, run_of
from tests.truth import RIGID_AXIS, SERVO, SFLR, TWO_MASS
from tests.truth.cases import make_case

RIGS = {"axis": RIGID_AXIS, "two-mass": TWO_MASS, "sflr": SFLR, "servo": SERVO}


@cache
def made(shape: str) -> tuple[Rig, tuple[Run, ...]]:
    """A rig as its file says, and tests of one that is wrong by its uncertainty and rubs."""
    case = make_case(9100, [("coulomb_friction", "motor")], nominal=RIGS[shape], count=4, disturbance=0.02)
    return Rig.model_validate(RIGS[shape]), tuple(case.runs)


def one_line(error: WorkError, *words: str) -> None:
    """A message for people."""
    assert "\n" not in str(error) and all(word in str(error) for word in words), str(error)


def altered(runs: tuple[Run, ...], **by: float) -> list[Run]:
    """Columns times a factor."""
    return [replace(run, **{column: factor * getattr(run, column) for column, factor in by.items()}) for run in runs]


@pytest.mark.parametrize("shape", RIGS)
def test_of_a_rig_that_is_as_its_file_says_nothing_is_told(shape: str) -> None:
    rig, runs = made(shape)
    found = answers(predictions(rig, runs))
    assert {one.run for one in found} == {run.name for run in runs}
    assert {one.reading for one in found} == ({"angle", "acceleration"} if rig.accelerometer else {"angle"})
    assert all(one.sureness > 0.0 for one in found) and np.median([one.sureness for one in found]) > CORRELATED
    assert all(1.0 / SUSPECT < one.gain < SUSPECT for one in found if one.sureness > CORRELATED)
    refuse_wrong_signs_and_units(found)
    assert unlikely(found) == []


@pytest.mark.parametrize(("shape", "by", "words"), [
    ("axis", {"encoder": -1.0}, ("angle moves the other way", "encoder")),
    ("servo", {"command": -1.0}, ("angle moves the other way", "motor.gain")),
    ("sflr", {"accel": -1.0}, ("acceleration moves the other way", "accelerometer has the wrong sign")),
    ("sflr", {"encoder": -1.0}, ("angle moves the other way", "encoder")),
    ("sflr", {"command": -1.0}, ("angle and acceleration both", "command or motor.gain")),
    ("two-mass", {"encoder": 2.0 * np.pi / 4096.0}, ("angle", "unit is wrong", "counts and not rad")),
    ("servo", {"command": 1000.0}, ("angle", "unit is wrong", "motor.gain")),
    ("sflr", {"accel": 1000.0}, ("acceleration", "times as much", "unit is wrong", "accelerometer.gain"))])
def test_a_wrong_sign_or_unit_is_one_line_that_names_run_and_column(shape: str, by: dict[str, float],
                                                                    words: tuple[str, ...]) -> None:
    rig, runs = made(shape)
    given = altered(runs, **by)
    with pytest.raises(WorkError) as refused:
        refuse_wrong_signs_and_units(answers(predictions(rig, given)))
    one_line(refused.value, *words)
    assert any(str(refused.value).startswith(f"{run.name}: ") for run in runs)
    with pytest.raises(WorkError) as refused:
        fit(rig, given, starts=1, threads=1)
    one_line(refused.value, *words)


def test_a_rig_file_with_inertia_in_another_unit_is_no_wrong_sign() -> None:
    rig, runs = made("axis")
    heavy = rig.with_constants({"motor.inertia": 1e7 * rig.motor.inertia})     # g cm^2 for kg m^2
    with pytest.raises(WorkError, match="unit is wrong"):
        refuse_wrong_signs_and_units(answers(predictions(heavy, runs)))


def test_four_times_the_counts_are_told_and_not_refused() -> None:
    """Lines of an encoder's disc for quadrature counts: a rig could be so."""
    rig, runs = made("axis")
    found = answers(predictions(rig, altered(runs, encoder=4.0)))
    refuse_wrong_signs_and_units(found)
    (sentence,) = unlikely(found)
    assert "angle" in sentence and "counts_per_revolution" in sentence


@pytest.mark.parametrize(("gain", "sureness", "doubted"), [
    (0.32, 0.97, False), (0.32, 0.99, True), (0.25, 0.8, False), (3.1, 0.6, True), (2.9, 0.6, False), (0.1, 0.6, True)])
def test_a_unit_is_doubted_where_no_gain_between_both_regressions_is_a_rigs(gain: float, sureness: float,
                                                                            doubted: bool) -> None:
    """A prediction that errs makes the regression of readings on it too flat: by 1/r^2 at most."""
    assert Answer("run", "angle", gain, sureness).suspect is doubted
    assert bool(unlikely([Answer("run", "angle", gain, sureness)])) is doubted


def test_one_log_of_another_unit_is_told_by_its_name() -> None:
    rig, runs = made("axis")
    given = [*runs[:-1], *altered(runs[-1:], encoder=1.0 / 11.0)]
    (sentence,) = unlikely(answers(predictions(rig, given)))
    assert sentence.startswith(f"{runs[-1].name}: the angle") and "of the other runs" in sentence


def test_what_friction_explains_is_no_unit() -> None:
    """Weak pulses move an axis that rubs by a sixth, but not one of another unit."""
    rubbing = AXIS.with_effects([CoulombFriction(at="motor", torque=0.85 * 40.0 * AXIS.motor.gain)])
    runs = [run_of(rubbing, 40.0, "open", "slow"), *(run_of(rubbing, size, "p2", f"{size}") for size in (300.0, 200.0))]
    (sentence,) = unlikely(answers(predictions(AXIS, runs)))
    assert sentence.startswith("slow: the angle")
    assert unlikely(answers(predictions(AXIS, runs)), answers(predictions(rubbing, runs))) == []
    given = [*runs[:-1], *altered(runs[-1:], encoder=1.0 / 11.0)]
    told = unlikely(answers(predictions(AXIS, given)), answers(predictions(rubbing, given)))
    assert len(told) == 1 and told[0].startswith(f"{runs[-1].name}: the angle")


@pytest.mark.parametrize("offset", [-30.0, 30.0])
def test_a_command_that_holds_against_a_bias_tells_no_sign(offset: float) -> None:
    """Of a slow test the loop's command is for the most part what the bias takes, and that moves nothing."""
    biased = AXIS.with_effects([CommandBias(at="amplifier", offset=offset)])
    runs = [run_of(biased, size, loop, f"{size:g}") for size, loop in ((10.0, "p1"), (-10.0, "p1"), (300.0, "p2"))]
    found = answers(predictions(AXIS, runs))
    assert len(found) == 3 and all(one.gain == pytest.approx(1.0, abs=0.3) for one in found)
    refuse_wrong_signs_and_units(found)
    turned = answers(predictions(AXIS, altered(tuple(runs), encoder=-1.0)))
    with pytest.raises(WorkError, match="angle moves the other way"):
        refuse_wrong_signs_and_units(turned)


def test_a_loop_that_holds_a_still_reference_answers_for_nothing() -> None:
    rig, runs = made("axis")
    held = [replace(run, reference=np.zeros_like(run.reference)) for run in runs if not run.open_loop]
    assert held and answers(predictions(rig, held)) == []


def test_a_log_whose_test_was_over_before_its_state_was_found_answers_for_nothing() -> None:
    """It begins amid a pulse: the second after that does not count, and then it swings by itself."""
    rig, rows = Rig.model_validate(SFLR), np.arange(2000)
    command = np.where((rows >= 50) & (rows < 300), 100.0, 0.0)
    asked = Run("pulse", rows / rig.sample_rate, command, command, 0.0 * command, 0.0 * command,
                RunMetadata(controller={"kind": "open"}))
    made_of = simulate(rig, asked)
    pulse = replace(asked, encoder=made_of.encoder, accel=made_of.accel)
    cut = replace(pulse.slice(100, len(pulse)), name="cut")
    found = answers(predictions(rig, [pulse, cut]))
    assert {one.run for one in found} == {pulse.name}


def test_one_log_with_the_other_sign_is_refused_by_its_name() -> None:
    rig, runs = made("sflr")
    with pytest.raises(WorkError) as refused:
        refuse_wrong_signs_and_units(answers(predictions(rig, [*runs[:-1], *altered(runs[-1:], accel=-1.0)])))
    one_line(refused.value, runs[-1].name, "acceleration moves the other way")


def test_where_runs_contradict_each_other_no_sign_is_wrong() -> None:
    """A beam of 76 mm in place of 414: what the acceleration of six tests of such an arm was seen to do."""
    said = [(-0.09, -0.29), (-0.11, -0.33), (0.03, 0.11), (-0.15, -0.40), (-0.05, -0.10), (-0.38, -0.61)]
    found = [Answer(f"run {k}", "acceleration", *one) for k, one in enumerate(said)]
    refuse_wrong_signs_and_units(found)
    with pytest.raises(WorkError, match="run 5: the acceleration moves the other way"):
        refuse_wrong_signs_and_units([found[-1]])


@pytest.mark.parametrize(("gain", "sureness", "against", "off"), [
    (-0.9, -0.9, True, False), (-0.9, -0.4, False, False), (-1e3, -0.9, False, True), (1e3, 0.4, False, False)])
def test_what_is_not_sure_says_nothing(gain: float, sureness: float, against: bool, off: bool) -> None:
    one = Answer("run", "angle", gain, sureness)
    assert (one.against, one.off_by(30.0)) == (against, off)

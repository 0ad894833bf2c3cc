"""Constants far from nominal: found from profiles over stretches too short for a beam to fall out of step."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from station.diagnose.refits import THOROUGH
from station.diagnose.starts import JOINTS, Start, arrived, attempted, far_starts, rigid_starts
from station.estimation.constants import base_fit, in_step, unknown
from station.estimation.least_squares import fit
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.prediction import Predictor
from station.model.effects.actuator_lag import ActuatorLag
from station.model.effects.backlash import Backlash
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import predictions
from tests.truth import SFLR, make_case

ARM = Rig.model_validate(SFLR)


def runs_of(seed: int, table: str, key: str, factor: float) -> list[Run]:
    """Of a rig by the independent generator whose file is wrong by a factor in one constant."""
    true: dict[str, Any] = copy.deepcopy(SFLR)
    true[table][key] *= factor
    return list(make_case(seed, nominal=true, count=4).runs)


def starting(predictor: Predictor, most: int) -> list[Start]:
    space = parameters(predictor.data, Hypothesis(), {})
    return far_starts(predictor, candidates(predictor.data.rig), most, in_step(predictor, space, space.mean))


@pytest.mark.parametrize(("table", "key", "factor"), [
    pytest.param("beam", "length", 0.2, marks=pytest.mark.long), ("beam", "flexural_rigidity", 0.04),
    ("base", "inertia", 8.0)])
def test_the_constant_that_is_far_off_is_begun_where_it_is(table: str, key: str, factor: float) -> None:
    predictor = predictions(ARM, runs_of(8300, table, key, factor))
    starts = starting(predictor, 4)
    assert len(starts) <= 6
    (begun,) = [start for start in starts if start.candidate.constant == f"{table}.{key}"]
    log = begun.space.logs(begun.x)[begun.space.paths.index(f"{table}.{key}")]
    assert abs(log - math.log(factor)) < math.log(2.0)


def test_a_constant_with_which_others_must_move_is_begun_where_they_do() -> None:
    """Along the base's inertia alone nothing is better than nominal, while the torque's scale is another."""
    true: dict[str, Any] = copy.deepcopy(SFLR)
    for key, factor in (("motor.inertia", 2.6), ("motor.damping", 2.0), ("motor.gain", 2.3), ("base.inertia", 0.18),
                        ("beam.flexural_rigidity", 0.66), ("drive.stiffness", 0.76)):
        table, name = key.split(".")
        true[table][name] *= factor
    predictor = predictions(ARM, list(make_case(8304, nominal=true, count=4).runs))
    found = {start.candidate.constant: start for start in starting(predictor, 2)}
    assert "base.inertia" in found
    begun = found["base.inertia"]
    log = begun.space.logs(begun.x)[begun.space.paths.index("base.inertia")]
    assert abs(log - math.log(0.18)) < math.log(2.0)


def test_where_every_constant_is_about_right_no_fit_begins_elsewhere() -> None:
    predictor = predictions(ARM, runs_of(8301, "base", "inertia", 1.0))
    assert starting(predictor, 4) == []


@pytest.mark.parametrize(("factor", "joint"), [
    (15.0, "drive.stiffness"), *(pytest.param(*one, marks=pytest.mark.long) for one in (
        (15.0, "clamp.stiffness"), (90.0, "drive.stiffness"), (90.0, "clamp.stiffness")))])
def test_a_joint_that_hardly_yields_is_begun_where_the_fit_ends_as_from_the_truth(joint: str, factor: float) -> None:
    """Freed at once from nominal it slides back, and the fit ends in a side valley."""
    table, key = joint.split(".")
    true = copy.deepcopy(SFLR)
    true[table][key] *= factor
    case = make_case(8306, nominal=true, count=4)
    predictor = predictions(ARM, list(case.runs))
    parent = base_fit(predictor)
    starts, _ = rigid_starts(predictor, parent, candidates(predictor.data.rig), {})
    (begun,) = [start for start in starts if start.candidate.constant == joint]
    drawn, nominal = Rig.model_validate(case.rig).constants(), ARM.constants()
    logs = [math.log(drawn[path] / nominal[path]) if path in drawn else 0.0 for path in begun.space.paths]
    x = begun.space.mean.copy()
    x[begun.space.parts["constants"]] = np.linalg.solve(begun.space.root, logs)
    wanted, found = (attempted(predictor, begun.space, parent.weighing, *start)
                     for start in ((x, predictor.data.own), (begun.x, begun.own)))
    assert wanted is not None and found is not None
    assert found.objective < wanted.objective + 0.1 * (parent.objective - wanted.objective)
    assert parent.objective > wanted.objective + 100.0


def test_a_joint_that_yields_as_the_rig_file_says_is_not_held_against_the_runs() -> None:
    """What meets the beginnings worse than the rig does where it stands is given up before whole runs are fitted."""
    predictor = predictions(ARM, runs_of(8301, "base", "inertia", 1.0))
    starts, _ = rigid_starts(predictor, base_fit(predictor), candidates(predictor.data.rig), {})
    assert "clamp.stiffness" not in [start.candidate.constant for start in starts]


@pytest.mark.long
@pytest.mark.parametrize("joint", JOINTS)
def test_a_joint_that_hardly_yields_is_named(joint: str) -> None:
    table, key = joint.split(".")
    found = diagnose(ARM, runs_of(8308, table, key, 90.0), effort="quick").diagnosis
    assert found.verdict == "explained"
    assert [cause.effect for cause in found.causes] == [f"parameter:{joint}"]


@pytest.mark.long
@pytest.mark.parametrize(("key", "factor"), [("length", 0.2), ("flexural_rigidity", 0.04)])
def test_a_beam_that_is_quite_another_than_the_rig_file_says_is_named(key: str, factor: float) -> None:
    """From nominal the way ends in side valleys, where other causes make up for it."""
    found = diagnose(ARM, runs_of(8302, "beam", key, factor), effort="quick").diagnosis
    assert [cause.effect for cause in found.causes] == [f"parameter:beam.{key}"]
    ratio = found.causes[0].parameters["value"].value / (SFLR["beam"][key] * factor)
    assert 0.75 < ratio < 1.33


def test_a_cause_is_not_sought_from_constants_alone_that_were_bent_to_make_up_for_it() -> None:
    hidden = ("actuator_lag", "amplifier")
    case = make_case(1068000, [hidden], count=4)
    predictor = predictions(ARM, case.runs)
    rig_alone, guess = parameters(predictor.data, Hypothesis(), {}), {hidden: {"time_constant": 0.002}}
    bent = fit(predictor, rig_alone, unknown(predictor), rig_alone.mean, predictor.data.own, **THOROUGH)
    assert np.abs(rig_alone.logs(bent.x)).max() > 1.0, "a motor twice to five times as strong, and as heavy"
    space = parameters(predictor.data, Hypothesis(((ActuatorLag, "amplifier"),)), guess)
    begun = space.carried(rig_alone, bent.x, guess)
    ends = [way(predictor, space, unknown(predictor), begun, bent.own, **THOROUGH) for way in (attempted, arrived)]
    stuck, found = (space.values(one.x)[hidden]["time_constant"] / case.truth["causes"][0]["time_constant"]
                    for one in ends)
    assert abs(found - 1.0) < min(0.1, abs(stuck - 1.0))
    assert ends[1].objective < ends[0].objective - 10.0


@pytest.mark.long
def test_a_lag_that_a_bent_rig_hides_is_named_alone() -> None:
    """Begun from the bent rig alone three causes stood beside it, and it had a third of its size."""
    case = make_case(1068000, [("actuator_lag", "amplifier")], band="clear", count=None)
    cause, = diagnose(ARM, case.runs, effort="quick").diagnosis.causes
    assert (cause.effect, cause.at) == ("actuator_lag", "amplifier")
    size = cause.parameters["time_constant"]
    assert size.low <= case.truth["causes"][0]["time_constant"] <= size.high


LIGHT = Rig.model_validate({
    "name": "light", "sample_rate": 1000.0, "amplifier": {"limit": 400.0},
    "motor": {"inertia": 0.0009, "damping": 0.008, "gain": 0.0012}, "drive": {"stiffness": 12.0, "damping": 0.006},
    "base": {"inertia": 0.0015}, "encoder": {"counts_per_revolution": 8000}, "uncertainty": {"default": 0.1}})
"""Two light masses on a soft shaft: with play in it they come to blows at 20 to 50 Hz."""


@pytest.mark.parametrize("wrong", [0.01, 0.0169, 0.0185, 0.03])
def test_a_gap_is_found_by_longer_and_longer_horizons_where_whole_runs_have_a_valley_at_another_size(
        wrong: float) -> None:
    loose = LIGHT.with_effects([Backlash(at="drive", gap=0.02)])
    t = np.arange(3000) / LIGHT.sample_rate
    zero, runs = np.zeros(len(t)), []
    for name, command in (("chirp", 120.0 * np.sin(2.0 * np.pi * (0.5 * t + 2.5 * t**2))),
                          ("square", 90.0 * np.sign(np.sin(2.0 * np.pi * 1.7 * t))),
                          ("noise", 100.0 * np.sign(np.repeat(np.random.default_rng(3).normal(size=60), 50)))):
        command = np.round(command)
        asked = Run(name, t, command, command, zero, None, RunMetadata(controller={"kind": "open"}, command_row=0))
        runs.append(replace(asked, encoder=simulate(loose, asked).encoder))
    predictor = predictions(LIGHT, runs)
    space = parameters(predictor.data, Hypothesis(((Backlash, "drive"),)), {("backlash", "drive"): {"gap": wrong}})
    stuck, found = (way(predictor, space, unknown(predictor), space.mean, predictor.data.own, **THOROUGH)
                    for way in (attempted, arrived))
    assert space.values(found.x)["backlash", "drive"]["gap"] == pytest.approx(0.02, rel=0.01)
    assert found.objective <= stuck.objective, "which is stuck by as much as rounding has it: by 130 to thousands"
    whole = np.sqrt(found.squares / found.counts)[:, predictor.longest]
    assert np.all(whole < 2.0), "of some counts when the fit is stuck; 1 is rounding"

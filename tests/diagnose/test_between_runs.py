"""A motor whose supply differs from test to test is told as that, and no cause has to stand for it.

The motor's torque per count is proportional to the supply's voltage, its damping is not: runs of the independent
generator, each on a rig with a motor gain of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.diagnose import finding
from station.diagnose.diagnose import diagnose
from station.diagnose.estimates import common_gain, estimates, rig_of
from station.diagnose.result import Diagnosis
from station.diagnose.verdict import Stated
from station.model.effects import effect_class
from station.rig import Rig
from station.view import wording
from tests.estimation.made import AXIS, run_of
from tests.estimation.test_between_runs import fitted
from tests.truth import RIGID_AXIS, make_case
from tests.truth.cases import Case, simulate_case
from tests.truth.rigs import with_constants

SHARES = (0.14, -0.12, 0.10, -0.15, 0.03)
"""By which each run's motor does more than the rig's."""


def supplied(case: Case) -> Diagnosis:
    """What is said of a case's tests, each at a voltage of its own."""
    runs = []
    for run, test, conditions, share in zip(case.runs, case.tests, case.conditions, SHARES, strict=True):
        rig = with_constants(case.rig, {"motor.gain": case.rig["motor"]["gain"] * (1.0 + share)})
        made = simulate_case(rig, case.effects, [test], [conditions])[0]
        runs.append(replace(run, command=made.command, encoder=made.encoder))
    return diagnose(Rig.model_validate(RIGID_AXIS), runs, effort="quick").diagnosis


@pytest.mark.parametrize("hidden", [pytest.param([], marks=pytest.mark.long), [("coulomb_friction", "motor")]])
def test_a_supply_that_differs_is_told_run_by_run_and_nothing_is_named_for_it(hidden: list[tuple[str, str]]) -> None:
    said = supplied(make_case(8010, hidden, nominal=RIGID_AXIS, count=len(SHARES)))
    assert [(cause.effect, cause.at) for cause in said.causes] == hidden
    between = said.between_runs
    assert between is not None and between.share == pytest.approx(np.std(SHARES), rel=0.3)
    assert between.probability["share"] > 0.8 and between.stability["share"] > 0.8
    own = np.array([row.share for row in between.runs])
    assert between.share >= np.sqrt(np.mean(own**2)), "the size and what each run has are of one fit"
    told, true = 1.0 + own, 1.0 + np.array(SHARES)
    assert told / told.mean() == pytest.approx(true / true.mean(), abs=0.03)
    assert said.disturbance is not None and said.disturbance.extended < 0.03 < said.disturbance.nominal
    assert all(row.ahead["1 s"].nrmse_after < 0.25 * row.ahead["1 s"].nrmse_before for row in said.gain.runs)
    words = wording.between_runs(said)
    assert between.runs[3].run in words and between.runs[0].run in words


def test_runs_of_one_supply_show_no_difference() -> None:
    case = make_case(8010, [("coulomb_friction", "motor")], nominal=RIGID_AXIS, count=len(SHARES))
    said = diagnose(Rig.model_validate(RIGID_AXIS), case.runs, effort="quick").diagnosis
    assert said.between_runs is not None and said.between_runs.share is None and said.between_runs.runs == []
    assert said.between_runs.probability == said.between_runs.stability == {}


@pytest.mark.parametrize(("seed", "hidden"), [
    pytest.param(8014, ("encoder_eccentricity", "encoder"), marks=pytest.mark.long),
    (8015, ("command_bias", "amplifier"))])
def test_where_a_cause_leaves_only_noise_no_difference_between_runs_stands_for_it(seed: int, hidden: tuple[str, str],
                                                                                 ) -> None:
    """A gain or a bias of each run's own does much the same to each run, and costs what any one cause does."""
    case = make_case(seed, [hidden], nominal=RIGID_AXIS, count=6, band=(170.0, 400.0))
    found = diagnose(Rig.model_validate(RIGID_AXIS), case.runs, effort="quick")
    said, alike = found.diagnosis, effect_class(hidden[0]).alike
    assert said.verdict == "explained" and [(c.effect, c.at) for c in said.causes] == [hidden]
    assert said.between_runs is not None and not said.between_runs.runs
    assert found.equivalences == ([alike] if alike else []) and bool(alike) is (hidden[0] == "command_bias")


@pytest.mark.parametrize("shares", [(0.5, 1.6, 0.7, 1.3, 0.9), pytest.param((1.0,) * 5, marks=pytest.mark.long)])
def test_friction_that_differs_from_run_to_run_is_told_with_its_spread(shares: tuple[float, ...]) -> None:
    """Each run of the independent generator with its own friction: told are the value and by how much it differs."""
    case = make_case(8010, [("coulomb_friction", "motor")], nominal=RIGID_AXIS, count=len(shares))
    runs = []
    for run, test, conditions, share in zip(case.runs, case.tests, case.conditions, shares, strict=True):
        effects = [{**effect, "torque": share * effect["torque"]} for effect in case.effects]
        made = simulate_case(case.rig, effects, [test], [conditions])[0]
        runs.append(replace(run, command=made.command, encoder=made.encoder))
    said = diagnose(Rig.model_validate(RIGID_AXIS), runs, effort="quick").diagnosis
    assert [(cause.effect, cause.at) for cause in said.causes][:1] == [("coulomb_friction", "motor")]
    told, true = said.causes[0].parameters["torque"], case.effects[0]["torque"]
    assert told.low < np.mean(shares) * true < told.high
    if np.std(shares) > 0.0:
        assert told.spread == pytest.approx(true * np.std(shares, ddof=1), rel=0.6)
    else:
        assert told.spread is None


@pytest.mark.parametrize(("shares", "common"), [([0.25, 0.24, 0.26, 0.25, 0.23, 0.26], 1.25),
                                                ([0.2, -0.2, 0.1, -0.1, 0.2, -0.2], 1.0)])
def test_what_the_motor_does_more_in_all_runs_alike_is_the_rigs(shares: list[float], common: float) -> None:
    """Of a gain that the file calls certain each run is given its own; the rig that is handed back has what all share,
    and so has the value that is stated."""
    certain = AXIS.model_copy(update={"uncertainty": {"default": 0.001, "motor.gain": 0.02}})
    found = fitted(np.zeros(6), shares, rig=certain, begun=(0.3, 0.0))
    assert common_gain(found) == pytest.approx(common, abs=0.03) and (common > 1.0 or common_gain(found) == 1.0)
    gain = rig_of(found).motor.gain
    assert gain == pytest.approx(common_gain(found) * found.space.rig_at(found.x).motor.gain)
    assert estimates(found, found, [])[1]["motor.gain"].value == pytest.approx(gain)
    exact = certain.model_copy(update={"uncertainty": {"default": 0.001, "motor.gain": 0.0}})
    assert common_gain(fitted(np.zeros(6), shares, rig=exact, begun=(0.3, 0.0))) == 1.0


@pytest.mark.parametrize(("offset", "told"), [(4.0, True), (0.0, False)])
def test_a_constant_that_all_runs_share_is_told_where_no_bias_is_stated(monkeypatch: pytest.MonkeyPatch, offset: float,
                                                                        told: bool) -> None:
    monkeypatch.setattr(finding, "stated", lambda *given: Stated(frozenset()))
    biased = AXIS.with_effects([effect_class("command_bias")(at="amplifier", offset=offset)] if offset else [])
    runs = [run_of(biased, size, "p2", f"{size:g}") for size in (90.0, -60.0, 120.0)]
    notes = [note for note in diagnose(AXIS, runs, effort="quick").notes if "all runs share a constant" in note]
    assert len(notes) == told
    assert not told or float(notes[0].split("constant of ")[1].split()[0]) == pytest.approx(offset, abs=0.3)

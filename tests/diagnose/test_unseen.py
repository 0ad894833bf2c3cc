"""What is shown of runs left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.diagnose import unseen
from station.diagnose.diagnose import diagnose
from station.diagnose.disturbance import disturbance
from station.diagnose.measures import nrmse
from station.diagnose.result import Estimate
from station.diagnose.validation import nominal
from station.estimation.fitted import Fit
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.parameters import Hypothesis, parameters
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.diagnose.blind import RIGS, blind_task, made
from tests.estimation.made import AXIS, predictions, run_of


@pytest.mark.parametrize("against", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_gain_is_that_of_the_rig_that_is_handed_back(monkeypatch: pytest.MonkeyPatch, against: bool) -> None:
    """Causes that runs left out speak against are not stated, and nothing that is shown holds them."""
    monkeypatch.setattr(unseen, "contradicted", lambda gains, informed, relieved: against)
    case = made(blind_task(1, [("coulomb_friction", "motor")], disturbance=0.02, sized_in_world=True, rig="axis"))
    found = diagnose(Rig.model_validate(RIGS["axis"]), case.runs, effort="quick")
    diagnosis = found.diagnosis
    assert diagnosis.verdict == ("unexplained" if against else "partly_explained")
    assert bool(found.extended_rig.effects) is not against and bool(diagnosis.causes) is not against
    for told, row in zip(diagnosis.gain.runs, found.comparisons, strict=True):
        shown = row.refit if against else row.after
        assert told.encoder is not None and shown is not None and (row.after is None) is against
        error = nrmse(row.run.encoder[row.part], shown.encoder[row.part])
        assert told.encoder.nrmse_after == pytest.approx(error)
        assert set(told.ahead) and all(one.nrmse_after > 0.0 for one in told.ahead.values())
    handed = found.extended_rig.constants()
    assert {path: estimate.value for path, estimate in found.constants.items()} == pytest.approx(handed)


def test_what_may_be_none_by_its_own_interval_is_not_stated_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """One at a time, the one that adds least first: what is left is fitted and judged without it."""
    asked = []

    def may_be_none(found: Fit, key: tuple[str, str], values: dict[str, Estimate]) -> bool:
        asked.append((found.key, set(values)))
        return key[0] == "input_delay"

    monkeypatch.setattr(unseen, "may_be_none", may_be_none)
    rig = AXIS.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.06),
                             effect_class("input_delay")(at="amplifier", time=0.2 * AXIS.period)])
    runs = [run_of(rig, size, loop, f"{size:g} {loop}") for size, loop in ((90.0, "p2"), (-60.0, "p1"), (60.0, "open"))]
    result = diagnose(AXIS, runs, effort="quick")
    friction, delay = ("coulomb_friction", "motor"), ("input_delay", "amplifier")
    assert asked == [(frozenset({friction, delay}), {"torque"}), (frozenset({friction, delay}), {"time"}),
                     (frozenset({friction}), {"torque"})]
    assert [(cause.effect, cause.at) for cause in result.diagnosis.causes] == [friction]
    assert {(effect.name, effect.at) for effect in result.extended_rig.effects} == {friction}
    [row] = [row for row in result.ranking if row.effect == "input_delay"]
    assert row.reason.kind == "may_be_none"
    [told] = [row for row in result.diagnosis.ranking if row.effect == "input_delay"]
    assert told.note == "its own 95 % interval holds that it is not there"
    assert any("intervals hold that they are not there: input_delay at amplifier" in note for note in result.notes)


def test_the_torque_missing_by_the_rig_file_is_the_same_of_a_run_that_begins_in_motion() -> None:
    """Whose first second only finds the state: by a rig whose inertia is wrong it is found with a wrong speed."""
    finer = 1024.0
    rig = AXIS.with_constants({"encoder.counts_per_revolution": finer * AXIS.encoder.counts_per_revolution})
    heavy = rig.with_constants({"motor.inertia": 1.7 * rig.motor.inertia})
    t = np.arange(round(4.0 * rig.sample_rate)) / rig.sample_rate
    zero = np.zeros(len(t))
    told = []
    for begun in (0.0, 0.4):
        runs = []
        for size in (300.0, 200.0):
            reference = finer * size * np.sin(2.0 * np.pi * 0.8 * t)
            asked = Run(f"{size:g}", t, reference, zero, zero, None,
                        RunMetadata(controller={"kind": "p", "gain": 2.0 / finer}))
            made = simulate(heavy, asked)
            run = replace(asked, command=made.command, encoder=made.encoder)
            cut = run.slice(round(begun * rig.sample_rate), len(t))
            runs.append(replace(cut, t=cut.t - cut.t[0]))
        predictor = predictions(rig, runs)
        data = predictor.data
        assert [one.in_motion for one in data.records] == [begun > 0.0] * 2
        space = parameters(data, Hypothesis(), {})
        nothing = fit(predictor, space, Weighing(np.ones((2, len(predictor.channel))), 1.0), space.mean)
        told.append(disturbance(predictor, [nominal(data, nothing)] * 3).nominal)
    assert told[1] == pytest.approx(told[0], rel=0.2)

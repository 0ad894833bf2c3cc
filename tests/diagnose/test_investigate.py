"""The loop that tests and diagnoses by turns: when it ends, and what it asks for."""

from __future__ import annotations

import numpy as np
import pytest

from station.control.named import NAMED
from station.diagnose.investigate import investigate
from station.diagnose.result import Cause, Choice, Diagnosis, DiagnosisResult, Gain, NextExperiment
from station.diagnose.thresholds import FEW, PATIENCE
from station.errors import UsageError, WorkError
from station.rig import load_rig
from station.runs.run import Run, RunMetadata

SFLR = load_rig("sflr")
STEP = {"kind": "step", "amplitude": 60.0, "controller": NAMED["p"]}
PULSE = {"kind": "pulse", "amplitude": 90.0, "controller": NAMED["open"]}
DEAD, DRAG = ("dead_zone", "amplifier"), ("quadratic_drag", "base")


def said(verdict: str, *causes: tuple[str, str], probability: float = 0.99, stuck: bool = False,
         unseen: int = 0) -> DiagnosisResult:
    """A diagnosis that plans a pulse, to show ``unseen`` effects; ``stuck``: and says that no test would decide."""
    asked = NextExperiment(test=None, why="they are the same") if stuck else None
    found = Diagnosis(verdict=verdict, gain=Gain(held_out=[]), next_experiment=asked, causes=[
        Cause(effect=effect, at=at, probability=probability, parameters={}) for effect, at in causes])
    plan = NextExperiment(test=PULSE, why="because")
    return DiagnosisResult(found, SFLR, SFLR, SFLR, [], choose=lambda: Choice(plan, None, plan, unseen))


def played(*diagnoses: DiagnosisResult, budget: int = 8):
    """An investigation whose diagnoses are these, the last one for ever."""
    asked = []

    def run_test(test, controller):
        asked.append({**test, "controller": controller})
        zeros = np.zeros(4)
        return Run(f"run {len(asked)}", np.arange(4) / 500.0, zeros, zeros, zeros, zeros, RunMetadata())

    def find(rig, runs):
        assert [run.name for run in runs] == [f"run {i + 1}" for i in range(len(runs))]
        return diagnoses[min(len(runs), len(diagnoses)) - 1]
    return investigate(SFLR, run_test, find, budget=budget, first=STEP), asked


FOUND, CLEAN = said("explained", DEAD), said("nothing_missing")


@pytest.mark.parametrize(("diagnoses", "runs", "outcome"), [
    ([FOUND], FEW, "decided"),
    ([CLEAN], FEW, "decided"),
    ([CLEAN, FOUND], FEW, "decided"),
    ([said("nothing_missing", unseen=2)] * 4 + [CLEAN], 5, "decided"),
    ([said("nothing_missing", unseen=1)], 8, "budget"),
    ([said("explained", DEAD, unseen=3)], FEW, "decided"),
    ([FOUND, FOUND, CLEAN, CLEAN], 4, "decided"),
    ([FOUND, said("explained", DRAG), FOUND, FOUND], 4, "decided"),
    ([said("explained", DEAD, DRAG), FOUND, said("explained", DEAD, DRAG), FOUND, FOUND], 5, "decided"),
    ([said("explained", DEAD, probability=0.9)] * 4 + [FOUND], 5, "decided"),
    ([said("ambiguous", DEAD)], 8, "budget"),
    ([said("not_enough_data")], 8, "budget"),
    ([said("ambiguous", DEAD, stuck=True)], FEW, "hopeless"),
    ([FOUND, FOUND, said("ambiguous", DEAD, stuck=True), FOUND], 4, "decided"),
    ([said("unexplained")], PATIENCE, "hopeless"),
    ([said("partly_explained", DEAD)], PATIENCE, "hopeless"),
    ([said("unexplained"), said("unexplained"), said("unexplained"), CLEAN], 5, "decided"),
    ([said("not_enough_data"), said("not_enough_data"), CLEAN], FEW, "decided"),
    ([said("ambiguous", DEAD), said("ambiguous", DEAD), FOUND], FEW, "decided"),
    ([said("partly_explained", DEAD), said("partly_explained", DRAG)] * 2 + [FOUND], 6, "decided"),
], ids=lambda value: None)
def test_it_ends_when_two_diagnoses_agree_and_nothing_is_open(diagnoses, runs, outcome):
    found, asked = played(*diagnoses)
    assert (len(found.steps), found.outcome) == (runs, outcome), [s.result.diagnosis.verdict for s in found.steps]
    assert asked == [STEP, *[PULSE] * (runs - 1)] and found.why
    assert found.result is found.steps[-1].result and len(found.runs) == runs


def test_the_budget_is_kept():
    assert len(played(said("ambiguous", DEAD), budget=2)[0].steps) == 2
    found, _ = played(FOUND, budget=1)
    assert (len(found.steps), found.outcome) == (1, "budget")
    with pytest.raises(UsageError, match="at least one run"):
        played(FOUND, budget=0)


def test_what_breaks_a_test_goes_through_and_the_steps_so_far_were_told():
    told = []

    def run_test(test, controller):
        if told:
            raise WorkError("the line is gone")
        zeros = np.zeros(4)
        return Run("one", np.arange(4) / 500.0, zeros, zeros, zeros, zeros, RunMetadata())
    with pytest.raises(WorkError, match="the line is gone"):
        investigate(SFLR, run_test, lambda rig, runs: CLEAN, first=STEP, on_step=lambda found: told.append(found))
    assert len(told) == 1 and len(told[0].steps) == 1

"""The loop closed: test, diagnose, choose the next test, until the cause is decided or no further test would help.

This knows of no serial line: whoever calls it says how a test is run.

When it ends (``ending``): not before FEW runs, since what one or two runs say, later ones overturn.  Then as soon as
two diagnoses in a row agree (the same causes, and the first of them did not find more wrong than the last) and the last
is settled: one that explains, every cause at least SETTLED probable; or one that misses nothing and knows of no test
that would show an effect which the runs so far could not have shown.  Or as soon as no test would tell the rivals
apart, twice in a row; or when two diagnoses in a row, from PATIENCE runs on, agree that something is wrong which the
catalogue does not describe.  Or when the budget is spent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from station.diagnose.experiment import first_test
from station.diagnose.result import DiagnosisResult, NextExperiment
from station.diagnose.thresholds import FEW, PATIENCE, SETTLED
from station.errors import UsageError, WorkError
from station.rig import Rig
from station.runs.run import Run

BUDGET = 8

Test = dict[str, Any]
RunTest = Callable[[Test, dict[str, Any]], Run]
"""run_test(test, controller): run one test on the rig and hand back the run."""
Find = Callable[[Rig, list[Run]], DiagnosisResult]
"""find(rig, runs): the diagnosis of all runs so far (``diagnose`` with its effort chosen)."""
Outcome = Literal["decided", "hopeless", "budget"]


@dataclass(frozen=True)
class Step:
    """One run, and the diagnosis of all runs up to it."""

    run: Run
    why: str
    """Why this test was chosen."""
    result: DiagnosisResult

    @property
    def accused(self) -> frozenset[tuple[str, str]]:
        """What the diagnosis names."""
        return frozenset((cause.effect, cause.at) for cause in self.result.diagnosis.causes)

    @property
    def settled(self) -> bool:
        """Whether this diagnosis, were it not for how few runs there are, would need no other."""
        found = self.result.diagnosis
        if found.verdict == "explained":
            return all(cause.probability >= SETTLED for cause in found.causes)
        return found.verdict == "nothing_missing" and self.result.choice.unseen == 0


@dataclass
class Investigation:
    """All that was done so far; ``outcome`` and ``why`` once it has ended."""

    steps: list[Step] = field(default_factory=list)
    outcome: Outcome | None = None
    why: str = ""

    @property
    def runs(self) -> list[Run]:
        """In the order in which they were made."""
        return [step.run for step in self.steps]

    @property
    def result(self) -> DiagnosisResult:
        """The last diagnosis."""
        return self.steps[-1].result


def ending(steps: list[Step], budget: int) -> tuple[Outcome, str] | None:
    """Whether an investigation is over: how it ended, and why in words; None while a further test is worth it."""
    last = steps[-1]
    verdict = last.result.diagnosis.verdict
    agree = len(steps) > 1 and steps[-2].accused == last.accused and (
        steps[-2].result.diagnosis.verdict in (verdict, "ambiguous", "not_enough_data"))
    if len(steps) >= FEW and agree:
        if last.settled:
            return "decided", "two diagnoses in a row agree, and nothing is left open"
        if verdict in ("unexplained", "partly_explained") and len(steps) >= PATIENCE:
            return "hopeless", "more is wrong than the catalogue describes, and further tests do not change that"
    if len(steps) >= FEW and _stuck(last) and _stuck(steps[-2]):
        return "hopeless", last.result.diagnosis.next_experiment.why
    if len(steps) >= budget:
        return "budget", f"{budget} run{'s are' if budget > 1 else ' is'} all that was allowed"
    return None


def _stuck(step: Step) -> bool:
    asked = step.result.diagnosis.next_experiment
    return asked is not None and asked.test is None


def investigate(rig: Rig, run_test: RunTest, find: Find, *, budget: int = BUDGET, first: Test | None = None,
                on_step: Callable[[Investigation], None] = lambda found: None) -> Investigation:
    """Run tests on a rig until the cause is decided, or hopeless, or ``budget`` runs are made.

    ``first``: the first test with its ``controller``, in place of the one that shows most of the catalogue.
    ``on_step`` is called after each diagnosis.  What ``run_test`` and ``find`` raise goes through.
    """
    if budget < 1:
        raise UsageError(f"budget: at least one run is wanted, not {budget}")
    asked = NextExperiment(test=first, why="asked for") if first is not None else first_test(rig).next
    test, why = asked.test, asked.why
    if test is None:
        raise WorkError(f"rig {rig.name}: {why}; say which test is to be the first")
    found = Investigation()
    while found.outcome is None:
        run = run_test({k: v for k, v in test.items() if k != "controller"}, dict(test["controller"]))
        result = find(rig, [*found.runs, run])
        found.steps.append(Step(run, why, result))
        found.outcome, found.why = ending(found.steps, budget) or (None, "")
        on_step(found)
        if found.outcome is None and result.choice.plan.test is None:
            found.outcome, found.why = "hopeless", "this station has no test that the rig could be put to"
        elif found.outcome is None:
            test, why = result.choice.plan.test, result.choice.plan.why
    return found

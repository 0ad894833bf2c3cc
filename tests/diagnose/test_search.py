"""The search: how it finds its way, on tables of made-up scores, and on rigs with constants that are far off."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose import search as module
from station.diagnose.candidates import candidates
from station.diagnose.estimate import fit
from station.diagnose.problem import Hypothesis, Problem
from station.diagnose.search import (
    EFFORTS,
    REACHED,
    Search,
    base_fit,
    begun_anew,
    child_layout,
    screen,
    started,
    swap,
)
from station.rig import load_rig
from tests.truth import make_case

A, B, C, D = (("coulomb_friction", "motor"), ("dead_zone", "amplifier"), ("gravity_tilt", "base"),
              ("quadratic_drag", "base"))
Causes = frozenset[tuple[str, str]]


class Table:
    """A search among sets of causes whose chi^2 is given; a set is noise at 100, each cause costs 5.

    ``late``: sets that only looking back finds.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, chi2: dict[Causes, float],
                 late: dict[Causes, float] | None = None) -> None:
        self.chi2, self.late, self.climbed = chi2, late or {}, []
        best = lambda search: min(search.fits.values(), key=lambda f: f.chi2 + 5.0 * len(f.causes))  # noqa: E731
        for name, fake in {"base_fit": lambda problem: self.fitted(frozenset()), "climb": self.climb,
                           "look_back": self.look_back, "candidates": lambda rig: [], "swap": lambda *_: None,
                           "remainder": lambda problem, f: SimpleNamespace(is_noise=f.chi2 <= 100.0)}.items():
            monkeypatch.setattr(module, name, fake)
        monkeypatch.setattr(Search, "best", best)
        monkeypatch.setattr(Search, "keep", lambda search, f: search.fits.setdefault(f.causes, f))
        monkeypatch.setattr(Search, "temperature", lambda search: 1.0)

    def fitted(self, causes: Causes) -> SimpleNamespace:
        hypothesis = SimpleNamespace(causes=lambda: causes)
        chi2 = {**self.chi2, **self.late}[causes]
        return SimpleNamespace(causes=causes, chi2=chi2, objective=chi2, strain=0.0,
                               layout=SimpleNamespace(hypothesis=hypothesis))

    def climb(self, search: Search, parent: SimpleNamespace, *_: object) -> SimpleNamespace:
        """Fits every set with one cause more."""
        self.climbed.append(parent.causes)
        children = [self.fitted(k) for k in self.chi2 if parent.causes < k and len(k) == len(parent.causes) + 1]
        for child in children:
            search.keep(child)
        return min([parent, *children], key=lambda f: f.chi2 + 5.0 * len(f.causes))

    def look_back(self, search: Search, found: SimpleNamespace) -> None:
        """Fits every set with one cause less."""
        for cause in found.causes:
            search.keep(self.fitted(found.causes - {cause}))

    def ladder(self, effort: str = "full") -> Causes:
        """The best set that the search ends with."""
        problem = SimpleNamespace(by_command=True, rig=None, clock=None, zero_group=[0])
        return module._ladder(problem, EFFORTS[effort], lambda text, share: None).best().causes


def sets(*causes: tuple[str, str]) -> Causes:
    return frozenset(causes)


def test_a_set_that_looking_back_finds_is_climbed_from(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, {sets(): 1000.0, sets(A): 500.0, sets(C): 900.0, sets(A, B): 200.0, sets(B, C): 100.0},
                  late={sets(B): 200.0})
    assert table.ladder() == sets(B, C)
    assert table.climbed[:3] == [sets(), sets(A), sets(B)]


def test_a_search_that_ends_with_more_than_noise_goes_back_to_the_set_it_passed_over(
        monkeypatch: pytest.MonkeyPatch) -> None:
    chi2 = {sets(): 1000.0, sets(A): 400.0, sets(C): 410.0, sets(A, B): 300.0, sets(B): 990.0, sets(C, D): 100.0,
            sets(D): 980.0}
    table = Table(monkeypatch, dict(chi2))
    assert table.ladder() == sets(C, D)
    assert table.climbed[-2:] == [sets(C), sets(C, D)]
    quick = Table(monkeypatch, dict(chi2))
    assert quick.ladder("quick") == sets(A, B)
    assert sets(C) not in quick.climbed


def test_a_set_that_is_far_worse_is_not_gone_back_to(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, {sets(): 1000.0, sets(A): 400.0, sets(C): 600.0, sets(A, B): 300.0, sets(B): 990.0,
                                sets(C, D): 100.0, sets(D): 980.0})
    assert table.ladder() == sets(A, B)


def test_a_search_that_reached_the_noise_does_not_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, {sets(): 1000.0, sets(A): 100.0, sets(C): 110.0, sets(A, B): 99.0, sets(B): 990.0})
    assert table.ladder() == sets(A)
    assert table.climbed == [sets(), sets(A)]


@pytest.mark.parametrize(("seed", "path"), [(703, "drive.stiffness"), (704, "drive.damping")])
def test_a_constant_many_sigma_off_is_found_from_the_start_of_the_runs(seed: int, path: str) -> None:
    case = make_case(seed, [f"parameter:{path}"], band="clear")
    problem = Problem(load_rig("sflr"), case.runs)
    found = Search(problem, EFFORTS["full"])
    found.keep(base_fit(problem))
    begun_anew(found, candidates(problem.rig))
    right = found.fits[frozenset({(f"parameter:{path}", "")})]
    assert right is min(found.fits.values(), key=lambda f: f.objective)
    assert right.chi2 < REACHED * problem.samples.sum()
    assert right.strain < 40.0                                      # the others are where the rig file says


def test_an_effect_far_smaller_than_its_guesses_is_promised_and_begun_at_its_size() -> None:
    hidden = {"effect": "torque_ripple", "at": "motor", "amplitude": 1.1e-4, "cycles": 8.0, "phase": 0.2}
    case = make_case(801, [hidden])
    problem = Problem(load_rig("sflr"), case.runs)
    nothing = base_fit(problem)
    ripples = [p for p in screen(problem, nothing, candidates(problem.rig)) if p.candidate.key[0] == "torque_ripple"]
    first = next(p for p in ripples[:4] if p.guess["cycles"] == 8.0)       # fits begin from four
    centred, begun = started(first)
    assert centred["amplitude"] == pytest.approx(0.2 * first.guess["amplitude"])
    usual = first.candidate.guesses[0]["amplitude"]
    assert 1.1e-4 / 3.0 < begun["amplitude"] < 1.1e-4 * 3.0 < usual / 10.0
    layout, x = child_layout(problem, nothing, first.candidate, centred, begun)
    outputs = problem.outputs(layout, x, nothing.start, nothing.offset)
    left = sum(float(np.sum((m * s - y) ** 2))
               for m, s, y in zip(problem.measured, problem.scale, outputs, strict=True))
    assert left < nothing.costs.sum() + 0.5 * first.gain            # the constants have yet to follow


def test_a_cause_is_held_against_its_rival_in_its_place() -> None:
    hidden = [{"effect": "coulomb_friction", "at": "motor", "torque": 2e-3},
              {"effect": "gain_curve", "at": "amplifier", "exponent": -0.02}]
    problem = Problem(load_rig("sflr"), make_case(802, hidden).runs)
    pool = candidates(problem.rig)
    found = Search(problem, EFFORTS["full"])
    found.keep(base_fit(problem))

    def add(before: Causes, name: str) -> Causes:
        candidate = next(c for c in pool if c.key[0] == name and c.at != "base")
        parent = found.fits[before]
        layout, x = child_layout(problem, parent, candidate, *started(screen(problem, parent, [candidate])[0]))
        found.keep(fit(problem, layout, x, parent.start, parent.offset, iterations=40))
        return before | {candidate.key}

    for name in ("coulomb_friction", "gain_curve"):
        add(sets(), name)
    stribeck = add(sets(), "stribeck_friction")
    stands_in = add(stribeck, "gain_curve")
    true = frozenset({("coulomb_friction", "motor"), ("gain_curve", "amplifier")})
    assert frozenset(found.best().layout.hypothesis.causes()) == stands_in and true not in found.fits
    swap(found, pool, {sets(), stribeck})
    assert frozenset(found.best().layout.hypothesis.causes()) == true


def test_the_start_of_the_runs_is_the_same_problem_cut_short() -> None:
    case = make_case(300, [], count=2)
    problem = Problem(load_rig("sflr"), case.runs)
    short = problem.beginning(0.3)
    for whole, cut in zip(problem.runs, short.runs, strict=True):
        first = int((whole.command != 0.0).argmax())
        assert len(cut) == first + 150
        assert (cut.encoder == whole.encoder[: len(cut)]).all()
    assert [s.shape[1] for s in short.scale] == [len(run) for run in short.runs]
    assert (short.start == problem.start).all() and (short.offset == problem.offset).all()


def test_a_loop_that_rounding_makes_run_away_keeps_its_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Problem(load_rig("sflr"), make_case(5, [], count=5).runs)
    problem.by_command = False
    closed = [r for r, run in enumerate(problem.runs) if run.metadata.controller["kind"] != "open"]
    gone, others = closed[0], closed[1:]
    layout, plain, before = problem.layout(Hypothesis(), {}), problem.simulate_run, [s.copy() for s in problem.scale]

    def simulate_run(model, layout, x, index, *given, rounding=False, **named):
        made = plain(model, layout, x, index, *given, rounding=rounding, **named)
        return replace(made, encoder=made.encoder * np.inf) if index == gone and rounding == "inside" else made

    monkeypatch.setattr(problem, "simulate_run", simulate_run)
    with np.errstate(invalid="ignore"):
        problem.calibrate(layout, layout.prior_mean, problem.start, problem.offset)
    assert others
    assert np.array_equal(problem.scale[gone], before[gone])
    assert not problem.chatter[gone].any()
    for r in others:
        assert not np.array_equal(problem.scale[r], before[r])
    assert np.isfinite(base_fit(problem).objective)

"""What is said of runs left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose import densities, validation
from station.diagnose.densities import (
    contradicted,
    differing,
    information,
    predicted,
    relief,
    standard_error,
    unseen_gain,
)
from station.diagnose.validation import leave_each_out, missed_by_more
from station.diagnose.whole_run import UNKNOWN_AHEAD, not_closed, seconds_ahead
from station.estimation.dataset import dataset
from station.estimation.pool import Pool
from station.runs.run import Run
from tests.estimation.made import AXIS, run_of
from tests.estimation.test_spread import USUAL, fitted

ROWS = 200
PRIOR = np.array([1e6, 0.04, 4.0, 0.25])
"""Precisions of what a run has of its own: starting angle (known), offset, share, constant."""


def predictor(errors: np.ndarray, columns: np.ndarray) -> SimpleNamespace:
    """Of a run with one channel that misses ``errors`` (n), less what the run has of its own (4) times ``columns``
    (4, n)."""
    data = SimpleNamespace(own=np.zeros((1, 4)), free=np.arange(4), rms_command=1.0,
                           rig=SimpleNamespace(angle_per_count=1.0, amplifier=SimpleNamespace(limit=200.0)))
    return SimpleNamespace(data=data, counts=np.array([[float(errors.size)]]), pool=None,
                           scale=lambda run: np.ones((1, errors.size)), measured=lambda run: errors[None],
                           model=lambda space, x: None,
                           some=lambda model, space, x, runs, own: [(own[0] @ columns[:4] + x @ columns[4:])[None]])


def left_out(own: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0), parameters: int = 0) -> SimpleNamespace:
    """A fit that left the run out, with so many parameters."""
    space = SimpleNamespace(size=parameters, precision=np.ones(parameters), parts={"effects": slice(0, 0)},
                            hypothesis=SimpleNamespace(constants=()))
    return SimpleNamespace(space=space, x=np.zeros(parameters), own=np.array([own]), owner=np.zeros(1),
                           weighing=SimpleNamespace(differ=(0.5, 2.0)), own_precision=lambda differ: PRIOR[None],
                           normal=lambda weighing, drawn: (np.zeros((parameters, parameters)), np.zeros(parameters)))


def counted(independent: float, temperature: float = 1.0) -> SimpleNamespace:
    return SimpleNamespace(independent=np.array([[independent]]), temperature=temperature)


def log_density(*args) -> float:
    return predicted(*args).log_density


def waves(count: int, scale: float, seed: int) -> np.ndarray:
    return scale * np.random.default_rng(seed).standard_normal((count, ROWS))


def test_what_a_run_has_of_its_own_is_integrated_out_of_the_density_of_a_run_left_out() -> None:
    """Within the noise the density is a normal one: errors e of unit variance plus own values of precision P times
    columns C: N(0, I + C' P^-1 C)."""
    columns = waves(4, 0.05, 1)
    columns[0] = 0.0
    errors = 0.8 * waves(1, 1.0, 2)[0] + np.array([0.0, 2.0, 0.3, -1.0]) @ columns
    spread = np.eye(ROWS) + (columns.T / PRIOR) @ columns
    wanted = -0.5 * float(errors @ np.linalg.solve(spread, errors) + np.linalg.slogdet(spread)[1])
    found = log_density(predictor(errors, columns), counted(ROWS), left_out(), 0)
    assert found == pytest.approx(wanted, abs=1e-3)
    elsewhere = left_out((0.0, 1.0, 1.0, 1.0))
    begun_elsewhere = log_density(predictor(errors, columns), counted(ROWS), elsewhere, 0)
    assert begun_elsewhere == pytest.approx(wanted, abs=0.1)


def test_so_is_what_the_other_runs_leave_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same with two more columns D, per standard deviation of as many parameters: N(0, ... + D' D)."""
    columns = waves(6, 0.05, 1)
    columns[0] = 0.0
    errors = 0.8 * waves(1, 1.0, 2)[0] + 0.7 * columns[4] - 0.2 * columns[5]
    along = np.array([[0.4, 0.1], [0.0, 0.3]])
    open_ = along @ columns[4:]
    spread = np.eye(ROWS) + (columns[:4].T / PRIOR) @ columns[:4] + open_.T @ open_
    wanted = -0.5 * float(errors @ np.linalg.solve(spread, errors) + np.linalg.slogdet(spread)[1])
    monkeypatch.setattr(densities, "differing", lambda left, run: along)
    found = log_density(predictor(errors, columns), counted(ROWS), left_out(parameters=2), 0)
    assert found == pytest.approx(wanted, abs=1e-3)


def test_a_run_left_out_may_differ_by_what_the_others_do_whatever_it_says_itself() -> None:
    """Six runs, of which the first alone has a bias of its own: without it the others are alike, and the bias is known
    as well as they say; without another they are not."""
    found = fitted([9.0, 1.0, 1.0, 1.0, 1.0, 1.0], [USUAL] * 6)
    bias = found.space.parts["effects"].start
    alike, unlike = (float(np.linalg.norm(differing(found, run)[:, bias])) * found.space.coordinates[0].scale
                     for run in (0, 1))
    without_first = found.normal(found.weighing, np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])[found.owner])[0]
    known = np.linalg.inv(without_first + np.diag(found.space.precision))[bias, bias]
    assert alike == pytest.approx(np.sqrt(known) * found.space.coordinates[0].scale, rel=0.2)
    assert alike < 0.3
    assert unlike == pytest.approx(np.std([9.0, 1.0, 1.0, 1.0, 1.0], ddof=1), rel=0.5)


def test_a_bias_of_its_own_does_not_speak_against_what_meets_a_run_but_for_it() -> None:
    """A bias that is a thousand times the noise, of a size that runs may have: of two models the one is better that
    meets what is left, though both miss the run as it stands by the bias."""
    columns = np.zeros((4, ROWS))
    columns[3] = np.linspace(0.0, 60.0, ROWS)
    left = waves(1, 1.0, 3)[0]
    close, far = (log_density(predictor(2.0 * columns[3] + size * left, columns), counted(50.0), left_out(), 0)
                  for size in (1.0, 4.0))
    assert close - far == pytest.approx(0.5 * 50.0 * np.log(16.0), rel=0.1)


def test_a_run_that_does_not_simulate_is_met_by_no_density_at_all() -> None:
    assert log_density(predictor(np.full(ROWS, np.inf), np.zeros((4, ROWS))), counted(50.0), left_out(), 0) == -np.inf


def test_temperature_tones_a_density_down() -> None:
    columns = np.zeros((4, ROWS))
    before, after = (log_density(predictor(size * waves(1, 1.0, 4)[0], columns), counted(50.0, 2.0), left_out(), 0)
                     for size in (8.0, 2.0))
    assert after - before == pytest.approx(0.5 * 25.0 * np.log(16.0), rel=1e-6)
    assert unseen_gain(counted(50.0, 2.0), np.array([after - before])) == pytest.approx(0.75)


@pytest.mark.parametrize(("gains", "relieved", "wanted"), [
    ([-3.0, -3.1, -2.9], 0.0, True), ([-9.0, 4.0, 3.0], 0.0, True), ([-9.0, 4.0, 6.0], 0.0, True),
    ([9.0, 4.0, -6.0], 0.0, True), ([9.0, 4.0, 3.0], 0.0, False), ([3.0, 4.0], 0.0, False),
    ([-0.2, 0.1, 0.0], 12.0, False), ([1.0, 1.0, 0.0], -2.7, True),
    ([5.0, np.nan, 5.0], 0.0, True), ([5.0, -np.inf, 5.0], 0.0, True)])
def test_unseen_runs_speak_against_causes_that_do_not_help_by_more_than_the_error_of_the_comparison(
        gains: list[float], relieved: float, wanted: bool) -> None:
    """Of runs that could all say as much."""
    assert contradicted(np.array(gains), np.full(len(gains), 5.0), relieved) is wanted


def test_a_run_that_could_say_nothing_does_not_speak_against_a_cause() -> None:
    """That one run gains 24 and another, in which the cause does nothing, none, is no sign of chance; that it should
    have gained as much is."""
    gains = np.array([24.0, -0.2])
    assert not contradicted(gains, np.array([28.0, 0.1]), 0.0)
    assert contradicted(gains, np.array([28.0, 28.0]), 0.0)


@pytest.mark.parametrize("dispersion", [2.0, 12.0])
def test_the_standard_error_is_that_of_the_sum_however_unlike_runs_are(dispersion: float) -> None:
    """Gains that scatter with the variance of a log likelihood ratio, twice its mean, or six times as much, about what
    runs from hardly anything to 200 could say."""
    rng, informed = np.random.default_rng(5), np.array([0.1, 1.0, 3.0, 20.0, 200.0, 60.0, 100.0, 40.0])
    drawn = informed + np.sqrt(dispersion * informed) * rng.standard_normal((4000, informed.size))
    found = np.sqrt(np.mean([standard_error(gains, informed) ** 2 for gains in drawn]))
    assert found == pytest.approx(np.std(drawn.sum(axis=1)), rel=0.2)


def test_what_a_run_could_say_is_what_causes_change_in_it_whatever_was_measured() -> None:
    """Within the noise half the squared change; beyond it as errors of unknown size are counted."""
    change = 0.3 * waves(1, 1.0, 6)
    size = float(np.sum(change**2))

    def informed(errors: np.ndarray, independent: float, temperature: float = 1.0) -> float:
        without, found = (densities.Predicted(0.0, e) for e in (errors + change, errors))
        [value] = information(predictor(errors[0], np.zeros((4, ROWS))), counted(independent, temperature), [without],
                              [found])
        return value
    quiet = np.zeros((1, ROWS))
    assert informed(quiet, ROWS) == pytest.approx(0.5 * size)
    assert informed(quiet, ROWS, 2.0) == pytest.approx(0.25 * size)
    loud = 3.0 * waves(1, 1.0, 7)
    wanted = 0.5 * 50.0 * np.log1p(size / float(np.sum(loud**2)))
    assert informed(loud, 50.0) == pytest.approx(wanted) == informed(-loud, 50.0)


def test_a_cause_that_leaves_constants_where_the_rig_file_has_them_relieves_a_refit_that_strains_them() -> None:
    strained, relieved = [SimpleNamespace(log_constants=-14.0)] * 2, [SimpleNamespace(log_constants=-3.0)] * 2
    assert relief(strained, relieved) == 11.0 and relief(relieved, strained) == -11.0


@dataclass(frozen=True)
class Left:
    """A fit that left a run out."""

    light: Left | None
    x: str


def test_every_run_is_left_out_once_from_where_the_fit_of_all_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fit(predictor, space, weighing, x, own, *, runs, **how):
        asked.append((list(runs), x, how["jacobian"]))
        if not runs[2]:
            raise ArithmeticError("lost")
        return Left(Left(None, f"without {int(np.argmin(runs))}"), "")

    monkeypatch.setattr(validation, "fit", fit)
    space = SimpleNamespace(with_own_of=lambda x, other, run, zero_group: f"{x}, {other}'s own of {run}")
    found = SimpleNamespace(space=space, x="here", own=None, jacobian="known", light="of all")
    predictor = SimpleNamespace(data=SimpleNamespace(runs=[None] * 3, zero_groups=(0,) * 3), pool=Pool())
    left = leave_each_out(predictor, None, found, far=True)
    assert [one.x for one in left[:2]] == ["without 0, here's own of 0", "without 1, here's own of 1"]
    assert left[2] == "of all"
    assert [row[0] for row in asked] == [[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]
    assert {row[1:] for row in asked} == {("here", "known")}


@pytest.mark.parametrize(("kind", "first", "lost", "why"), [
    ("p1", 0, 0, ""), ("p1", 90, 0, "begins in motion"), ("unknown", 0, 0, "does not say what closed"),
    ("open", 0, 0, ""), ("open", 150, 0, ""), ("p1", 0, 160, ""), ("p1", 0, 80, "gap")])
def test_a_loop_that_cannot_be_closed_again_is_predicted_half_a_second_ahead(kind: str, first: int, lost: int,
                                                                             why: str) -> None:
    """One that is cut at its beginning, or has a gap: after the reference moved, or while it did."""
    run = run_of(AXIS, 60.0, "open" if kind == "open" else "p1", "run", 3.0)
    if kind == "unknown":
        run = replace(run, metadata=run.metadata.model_copy(update={"controller": {"kind": "unknown"}}))
    rows = np.delete(np.arange(len(run)), slice(lost - 40, lost)) if lost else np.arange(first, len(run))
    cut = Run.from_columns("cut", "cut", {name: values[rows] for name, values in run.columns().items()}
                           | ({"n": rows} if lost else {}), run.metadata)
    told = not_closed(dataset(AXIS, [cut]), 0)
    assert why in told and bool(why) == bool(told)
    assert seconds_ahead(dataset(AXIS, [cut]), 0) == (UNKNOWN_AHEAD if why else None)


@pytest.mark.parametrize(("before", "after", "is_worse"), [(2.0, 1.0, False), (1.0, 1.0, False), (1.0, 2.0, True),
                                                           (1.0, np.nan, True), (1.0, np.inf, True)])
def test_a_rig_that_goes_further_astray_than_its_file_is_no_better(before: float, after: float, is_worse: bool) -> None:
    """By the rows that count alone."""
    rows = np.arange(10)
    record = SimpleNamespace(measured=[np.zeros(10)], window=rows > 0)

    def away(size: float) -> list[SimpleNamespace]:
        return [SimpleNamespace(encoder=np.where(rows > 0, size, 1e9 if size == after else 0.0))] * 2
    data = SimpleNamespace(records=[record] * 2, sigma=np.array([0.3]))
    assert missed_by_more(data, away(before), away(before), away(after)) == is_worse


@pytest.mark.parametrize(("after", "is_worse"), [((1.0, 1.0, 90.0), False), ((9.0, 9.0, 90.0), True)])
def test_one_run_that_asks_more_of_a_model_does_not_decide_alone(after: tuple[float, ...], is_worse: bool) -> None:
    record = SimpleNamespace(measured=[np.zeros(10)], window=np.full(10, True))
    before, made = ([SimpleNamespace(encoder=np.full(10, size)) for size in sizes] for sizes in ((10.0,) * 3, after))
    assert missed_by_more(SimpleNamespace(records=[record] * 3, sigma=np.array([0.3])), before, before,
                          made) == is_worse


@pytest.mark.parametrize(("after", "is_worse"), [((4.0, 6.0, 3.0, 5.0), True), ((1.4, 0.7, 1.2, 0.9), False),
                                                 ((0.4, 0.5, 0.6, 40.0), False), ((0.5, 0.4, 0.6, 0.3), False)])
def test_causes_that_miss_run_after_run_by_more_than_a_refit_are_none(after: tuple[float, ...], is_worse: bool) -> None:
    """Though by less than the rig's file: it missed by a hundred, the re-fitted rig by one; of one run nothing is said.
    """
    record = SimpleNamespace(measured=[np.zeros(10)], window=np.full(10, True))
    file, refit, made = ([SimpleNamespace(encoder=np.full(10, size)) for size in sizes]
                         for sizes in ((100.0,) * 4, (1.0,) * 4, after))
    data = SimpleNamespace(records=[record] * 4, sigma=np.array([0.01]))
    assert missed_by_more(data, file, refit, made) == is_worse
    one = SimpleNamespace(records=[record], sigma=np.array([0.01]))
    assert not missed_by_more(one, file[:1], refit[:1], made[:1])

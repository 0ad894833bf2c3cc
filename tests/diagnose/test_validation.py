"""What is said of runs left out."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose import validation as module
from station.diagnose.validation import contradicted, leave_each_out, relief, unseen_gain, unseen_gains

EVEN = SimpleNamespace(independent=np.ones((2, 2)))
"""One independent error in each block of two runs."""


def fits(*squares: list[list[float]]) -> list[SimpleNamespace]:
    """Fits that leave one run after the other out; the noise alone would leave 1 in each block."""
    return [SimpleNamespace(squares=np.array(rows), counts=np.ones((2, 2))) for rows in squares]


def test_a_gain_is_the_mean_over_blocks_of_errors_on_the_run_that_each_fit_left_out() -> None:
    """Half the error in one run and the same in the other: 1 - 2^(-1/2); what the fits saw does not count."""
    before = fits([[4.0, 4.0], [0.0, 0.0]], [[0.0, 0.0], [9.0, 9.0]])
    after = fits([[1.0, 1.0], [77.0, 77.0]], [[77.0, 77.0], [9.0, 9.0]])
    assert unseen_gain(EVEN, unseen_gains(EVEN, before, after)) == pytest.approx(1.0 - 0.5**0.5)
    assert unseen_gain(EVEN, unseen_gains(EVEN, after, before)) == pytest.approx(1.0 - 2.0**0.5)
    assert unseen_gain(EVEN, unseen_gains(EVEN, before, before)) == 0.0


def test_a_block_counts_for_the_independent_errors_that_it_holds() -> None:
    """An error that is halved in ninety independent readings outweighs one that doubles in ten."""
    weighing = SimpleNamespace(independent=np.array([[90.0, 10.0], [0.0, 0.0]]))
    before = fits([[4.0, 4.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]])
    after = fits([[1.0, 16.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]])
    assert unseen_gain(weighing, unseen_gains(weighing, before, after)) == pytest.approx(1.0 - 2.0**-0.8)


@pytest.mark.parametrize(("gains", "relieved", "wanted"), [
    ([-3.0, -3.1, -2.9], 0.0, True), ([-9.0, 4.0, 3.0], 0.0, True), ([-9.0, 4.0, 6.0], 0.0, False),
    ([1.0, 2.0], 0.0, False), ([-0.2, 0.1, 0.0], 12.0, False), ([1.0, 1.0, 0.0], -2.7, True)])
def test_unseen_runs_speak_against_causes_where_they_are_met_worse_on_the_whole(gains: list[float], relieved: float,
                                                                                wanted: bool) -> None:
    assert contradicted(np.array(gains), relieved) is wanted


def test_a_cause_that_leaves_constants_where_the_rig_file_has_them_relieves_a_refit_that_strains_them() -> None:
    strained, relieved = [SimpleNamespace(log_constants=-14.0)] * 2, [SimpleNamespace(log_constants=-3.0)] * 2
    assert relief(strained, relieved) == 11.0 and relief(relieved, strained) == -11.0


def test_every_run_is_left_out_once_from_where_the_fit_of_all_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fit(predictor, space, weighing, x, own, *, runs, **how):
        asked.append((list(runs), x, how["jacobian"]))
        if not runs[2]:
            raise ArithmeticError("lost")
        return SimpleNamespace(light=f"without {int(np.argmin(runs))}")

    monkeypatch.setattr(module, "fit", fit)
    found = SimpleNamespace(space=None, x="here", own=None, jacobian="known", light="of all")
    with ThreadPoolExecutor(1) as pool:
        predictor = SimpleNamespace(data=SimpleNamespace(runs=[None] * 3), pool=pool)
        assert leave_each_out(predictor, None, found) == ["without 0", "without 1", "of all"]
    assert [row[0] for row in asked] == [[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]
    assert {row[1:] for row in asked} == {("here", "known")}

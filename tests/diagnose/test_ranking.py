"""What each candidate adds to its set, and why it is not named, on evidences made up."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.odds import Odds
from station.diagnose.ranking import ranking
from station.diagnose.result import RankedCause
from station.diagnose.selection import Selection
from station.diagnose.thresholds import LOG_PRIOR
from station.model.effects import effect_class
from station.view.wording import why
from tests.diagnose.test_selection import found, searching

PLAY, RUBS, LATE, INPUT, LAG, DRAG = ((effect_class(name), at) for name, at in (
    ("backlash", "drive"), ("coulomb_friction", "base"), ("encoder_delay", "encoder"), ("input_delay", "amplifier"),
    ("actuator_lag", "amplifier"), ("quadratic_drag", "base")))
EVIDENCES = [(0.0, ()), (2000.0, (PLAY,)), (100.0, (RUBS,)), (-5.0, (LATE,)), (4000.0, (PLAY, RUBS)),
             (4020.0, (PLAY, RUBS, LATE)), (4019.5, (PLAY, RUBS, INPUT)), (2010.0, (PLAY, LATE)), (70.0, (RUBS, LAG)),
             (4020.2, (PLAY, RUBS, LATE, DRAG))]


def key(cause: tuple) -> tuple[str, str]:
    return cause[0].name, cause[1]


def fitted(evidences: list[tuple[float, tuple]]) -> Selection:
    """A search that found these log evidences of these sets."""
    search = searching()
    for evidence, causes in evidences:
        one = found(evidence, *causes)
        search.fits[one.key] = one
    return search


def finding(*none: tuple) -> SimpleNamespace:
    """What is known of causes that may be ``none`` by their own intervals."""
    return SimpleNamespace(may_be_none=frozenset(map(key, none)))


def ranked(named: tuple, against: bool = False, none: tuple = ()) -> dict[str, RankedCause]:
    """The rows by their effect, where ``named`` are said; ``against``: and runs left out speak against them; ``none``:
    those that may be none."""
    search, keys = fitted(EVIDENCES), frozenset(map(key, named))
    likely = {PLAY: 0.99, RUBS: 0.99, LATE: 0.5, INPUT: 0.4, LAG: 0.1, DRAG: 0.05}
    said = Odds([(frozenset(map(key, (PLAY, RUBS, LATE))), 0.6)], {key(c): p for c, p in likely.items()}, 0.0,
                {key(PLAY): 1.0, key(RUBS): 1.0, key(LATE): 0.55})
    unseen = SimpleNamespace(densities={keys: 0.0, frozenset(): 0.0},
                             left_out=[SimpleNamespace(key=frozenset() if against else keys)])
    return {row.effect: row for row in ranking(search, said, finding(*none), unseen)}


def told(rows: dict[str, RankedCause], cause: tuple) -> str:
    return why(rows[cause[0].name].reason)


def test_what_a_cause_adds_is_over_the_same_set_without_it() -> None:
    named = (PLAY, RUBS, LATE)
    rows = ranked(named)
    assert rows["encoder_delay"].reason.adds == pytest.approx(40.0) and rows["encoder_delay"].delta_chi2 == -10.0
    assert rows["input_delay"].reason.adds == pytest.approx(39.0) and rows["input_delay"].delta_chi2 == 8039.0
    assert rows["actuator_lag"].reason.adds == pytest.approx(-60.0)
    assert rows["coulomb_friction"].reason.adds == pytest.approx(2.0 * (4020.0 - 2010.0))
    assert rows["backlash"].reason.adds is None, "what is named without it was not fitted"
    assert rows["quadratic_drag"].reason.value == pytest.approx(-2.0 * LOG_PRIOR)


def test_nothing_is_too_little_that_is_more_than_a_cause_must_add() -> None:
    named = (PLAY, RUBS, LATE)
    rows = ranked(named)
    assert told(rows, LATE) == "named as a cause: adds 40.0 to 2 Δln L of the others that are named"
    assert told(rows, PLAY) == "named as a cause"
    assert told(rows, INPUT) == ("as part of backlash in the drive + Coulomb friction at the base + input delay in the "
                                 "amplifier: adds 39.0 to 2 Δln L; encoder delay in its place does as well")
    assert told(rows, LAG).endswith("+ actuator lag in the amplifier: adds nothing to 2 Δln L")
    assert told(rows, DRAG) == "beside the causes named: adds nothing to 2 Δln L"


def test_what_few_resamples_name_or_runs_left_out_contradict_says_so() -> None:
    named = (PLAY, RUBS)
    assert told(ranked(named), LATE) == \
        "beside the causes named: adds 40.0 to 2 Δln L; named in 55 % of the resamples, too few"
    assert told(ranked(named, against=True), RUBS) == "does not help on unseen runs"
    assert told(ranked(named, none=(LATE,)), LATE) == \
        "beside the causes named: adds 40.0 to 2 Δln L; its own 95 % interval holds that it is not there"


def standing(evidences: list[tuple[float, tuple]], likely: dict[tuple[str, str], float], named: tuple = (),
             ) -> list[str]:
    """Why each cause stands where it does, in the ranking's order; the best set is the one named."""
    keys = frozenset(map(key, named))
    unseen = SimpleNamespace(densities={keys: np.zeros(1), frozenset(): np.zeros(1)},
                             left_out=[SimpleNamespace(key=keys)])
    said = Odds([(keys, 0.6)], likely, 0.0, {})
    return [why(row.reason) for row in ranking(fitted(evidences), said, finding(), unseen)]


def test_where_none_is_named_candidates_stand_by_what_they_buy() -> None:
    evidences = [(0.0, ()), (3.0, (RUBS,)), (-2.0, (INPUT,)), (2.9, (DRAG,)), (0.5, (LATE,))]
    likely = {key(RUBS): 0.6, key(INPUT): 0.55, key(DRAG): 0.3, key(LATE): 0.01, ("accelerometer_delay", "base"): 0.005}
    assert standing(evidences, likely) == [
        "most probable, but too few resamples name it or it does not help on unseen runs",
        "may be there as well, but too few resamples name it", "adds 5.80 to 2 Δln L, too little (it must add 8.8)",
        "explains less: 2 Δln L is 5.00 below the first's", "by an equivalence"]


@pytest.mark.parametrize(("probability", "words"), [(0.2, "as good as the first on these runs"),
                                                    (0.02, "no better than the first")])
def test_a_candidate_in_whose_place_several_stand_is_told_against_the_first(probability: float, words: str) -> None:
    evidences = [(0.0, ()), (10.0, (PLAY,)), (9.0, (RUBS,)), (30.0, (PLAY, RUBS)), (9.5, (LATE,))]
    likely = {key(PLAY): 0.99, key(RUBS): 0.98, key(LATE): probability}
    assert standing(evidences, likely, (PLAY, RUBS))[2] == words
    noted = [row for row in evidences if row[1] != (PLAY,)]
    assert standing(noted, likely, (PLAY, RUBS))[2] == \
        "backlash in the drive and Coulomb friction at the base in its place do better"

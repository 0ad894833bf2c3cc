"""Every way to a verdict, from odds and numbers made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from station.diagnose.odds import Odds
from station.diagnose.thresholds import STABLE, SURE, VISIBLE
from station.diagnose.verdict import Stated, stated, verdict

FRICTION, DEAD_ZONE, GAIN = ("coulomb_friction", "motor"), ("dead_zone", "amplifier"), ("parameter:motor.gain", "")
NONE: frozenset[tuple[str, str]] = frozenset()


def odds(*sets: tuple[set[tuple[str, str]], float], **stability: float) -> Odds:
    named = {"friction": FRICTION, "dead_zone": DEAD_ZONE, "gain": GAIN}
    rows = [(frozenset(keys), p) for keys, p in sets]
    causes: dict[tuple[str, str], float] = {}
    for keys, p in rows:
        for key in keys:
            causes[key] = causes.get(key, 0.0) + p
    return Odds(rows, causes, sum(p for keys, p in rows if not keys), {named[k]: s for k, s in stability.items()})


SURE_OF_FRICTION = odds(({FRICTION}, 0.99), (set(), 0.01), friction=1.0)
STATED = Stated(frozenset({FRICTION}))


def screened(*informations: float, candidate: tuple[str, str] | None = None, effect: object = object()) -> list:
    return [SimpleNamespace(candidate=SimpleNamespace(key=candidate or (f"effect {i}", "motor"), effect=effect),
                            information=information) for i, information in enumerate(informations)]


def judged(said: Stated = STATED, told: Odds = SURE_OF_FRICTION, *, noise: bool = True, against: bool = False,
           known: tuple = (), seen: list | None = None) -> str:
    return verdict(said, told, seen or [], noise, against, known)


def test_a_cause_that_enough_resamples_name_is_stated() -> None:
    assert stated(odds(({FRICTION}, 0.9), (set(), 0.1), friction=STABLE)) == Stated(frozenset({FRICTION}))


def test_of_the_best_set_only_what_is_stable_is_stated() -> None:
    found = stated(odds(({FRICTION, DEAD_ZONE}, 0.6), ({FRICTION}, 0.4), friction=1.0, dead_zone=0.6))
    assert found == Stated(frozenset({FRICTION}))


def test_a_cause_that_is_stable_but_not_in_the_best_set_is_not_stated() -> None:
    assert stated(odds((set(), 0.6), ({FRICTION}, 0.4), friction=0.9)) == Stated(NONE)


def test_rivals_that_share_the_resamples_are_stated_as_ambiguous_the_most_stable_first() -> None:
    found = stated(odds(({FRICTION}, 0.5), ({DEAD_ZONE}, 0.45), (set(), 0.05), friction=0.55, dead_zone=0.45))
    assert found == Stated(frozenset({FRICTION}), frozenset({FRICTION}))
    both = stated(odds(({FRICTION, DEAD_ZONE}, 0.5), ({GAIN}, 0.5), friction=0.4, dead_zone=0.6, gain=0.4))
    assert both == Stated(frozenset({DEAD_ZONE}), frozenset({DEAD_ZONE}))


LAG, DELAY = ("accelerometer_lag", "accelerometer"), ("accelerometer_delay", "accelerometer")


def test_a_cause_that_shares_its_resamples_with_one_rival_is_stated_beside_a_stable_one_as_one_of_both() -> None:
    drawn = [frozenset({FRICTION, LAG})] * 55 + [frozenset({FRICTION, DELAY})] * 40 + [frozenset({FRICTION})] * 5
    told = replace(odds(({FRICTION, LAG}, 0.55), ({FRICTION, DELAY}, 0.4), ({FRICTION}, 0.05), friction=1.0),
                   resampled=tuple(drawn))
    found = stated(told)
    assert found == Stated(frozenset({FRICTION, LAG}), frozenset({LAG}))
    assert judged(found, told) == judged(found, told, noise=False) == "ambiguous"
    fewer = replace(told, resampled=tuple(drawn[:75] + [frozenset({FRICTION})] * 25))
    assert stated(fewer) == Stated(frozenset({FRICTION}))
    without = replace(told, resampled=tuple(drawn[:55] + [frozenset({DELAY})] * 45))
    assert stated(without) == Stated(frozenset({FRICTION}))


def test_beside_more_than_noise_a_rival_counts_only_where_it_does_the_same_to_the_runs() -> None:
    drawn = [frozenset({FRICTION, LAG})] * 55 + [frozenset({FRICTION, DELAY})] * 40 + [frozenset({FRICTION})] * 5
    told = replace(odds(({FRICTION, LAG}, 0.55), ({FRICTION, DELAY}, 0.4), ({FRICTION}, 0.05), friction=1.0),
                   resampled=tuple(drawn))
    both = stated(told, lambda cause: frozenset({DELAY}) if cause == LAG else NONE)
    assert both == Stated(frozenset({FRICTION, LAG}), frozenset({LAG}))
    assert judged(both, told, noise=False, against=True) == "unexplained"
    assert stated(told, lambda cause: NONE) == Stated(frozenset({FRICTION}))
    shared = odds(({FRICTION}, 0.5), ({DEAD_ZONE}, 0.5), friction=0.5, dead_zone=0.5)
    assert stated(shared).one_of and not stated(shared, lambda cause: NONE).causes


def test_where_nothing_may_be_missing_no_unstable_cause_is_stated() -> None:
    assert stated(odds(({FRICTION}, 0.6), (set(), 0.4), friction=0.6)) == Stated(NONE)


def test_without_a_cause_what_is_more_than_noise_is_unexplained() -> None:
    assert judged(Stated(NONE), odds((set(), 1.0)), noise=False, seen=screened(1e6)) == "unexplained"


@pytest.mark.parametrize(("information", "wanted"), [
    ([2.0 * VISIBLE, 2.0 * VISIBLE, 0.0], "nothing_missing"), ([2.0 * VISIBLE, 0.0], "nothing_missing"),
    ([2.0 * VISIBLE, 0.0, 0.0], "not_enough_data"), ([VISIBLE, VISIBLE], "not_enough_data")])
def test_runs_that_would_not_show_half_of_the_effects_are_not_enough(information: list[float], wanted: str) -> None:
    assert judged(Stated(NONE), odds((set(), 1.0)), seen=screened(*information)) == wanted


def test_an_effect_shows_if_it_does_at_any_of_its_guesses_and_constants_do_not_count() -> None:
    said, told = Stated(NONE), odds((set(), 1.0))
    twice = screened(0.0, 2.0 * VISIBLE, candidate=FRICTION)
    assert judged(said, told, seen=twice) == "nothing_missing"
    constants = screened(*[2.0 * VISIBLE] * 9, candidate=GAIN, effect=None)
    assert judged(said, told, seen=[*constants, *screened(0.0)]) == "not_enough_data"


def test_a_sure_cause_that_leaves_noise_explains() -> None:
    assert judged() == "explained"


def test_a_cause_that_leaves_more_than_noise_explains_part() -> None:
    assert judged(noise=False) == "partly_explained"


def test_a_cause_that_leaves_more_than_noise_is_not_stated_where_runs_left_out_speak_against_it() -> None:
    assert judged(noise=False, against=True) == "unexplained"
    assert judged(Stated(frozenset({FRICTION}), frozenset({FRICTION})), noise=False, against=True) == "unexplained"


def test_what_the_resamples_cannot_tell_apart_is_ambiguous_whatever_is_left() -> None:
    torn = Stated(frozenset({FRICTION}), frozenset({FRICTION}))
    assert judged(torn, noise=True) == judged(torn, noise=False) == "ambiguous"


def test_a_cause_less_than_sure_is_ambiguous_and_one_sure_cause_is_enough() -> None:
    unsure = odds(({FRICTION}, SURE - 0.01), (set(), 1.01 - SURE), friction=1.0)
    assert judged(told=unsure) == "ambiguous"
    pair = odds(({FRICTION, DEAD_ZONE}, 0.7), ({FRICTION}, 0.3), friction=1.0, dead_zone=0.9)
    assert judged(Stated(frozenset({FRICTION, DEAD_ZONE})), pair) == "explained"


def test_an_equivalence_makes_what_would_be_explained_ambiguous_but_not_what_is_partly_so() -> None:
    known = (object(),)
    assert judged(known=known) == "ambiguous"
    assert judged(known=known, noise=False) == "partly_explained"

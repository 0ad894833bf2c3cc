"""What a search says: where more than noise is left, a cause that shares its resamples with what does the same."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from station.diagnose import finding
from station.diagnose.finding import Finding, find
from station.diagnose.odds import Odds
from station.diagnose.verdict import Stated
from station.estimation.cause import Causes, Key

RIPPLE, INPUT, ENCODER, BIAS = (("torque_ripple", "motor"), ("input_delay", "amplifier"), ("encoder_delay", "encoder"),
                                ("command_bias", "amplifier"))
BEST = frozenset({RIPPLE, ENCODER, BIAS})
RESAMPLED = (BEST,) * 6 + (frozenset({RIPPLE, INPUT}),) * 4
"""Without the bias, which the delay at the other end does not need."""


def said(monkeypatch: pytest.MonkeyPatch, best: Causes, resampled: tuple[Causes, ...], alike: dict[Key, Causes],
         is_noise: bool) -> Stated:
    shares = {key: sum(key in keys for keys in resampled) / len(resampled) for key in (RIPPLE, INPUT, ENCODER, BIAS)}
    found = Odds([(best, 1.0)], shares, 0.0, shares, resampled=resampled)
    monkeypatch.setattr(finding, "odds", lambda search: found)
    monkeypatch.setattr(finding, "collinear", lambda search, best, key: alike.get(key, frozenset()))
    monkeypatch.setattr(finding, "_fitted", lambda search, found, spoken, said, whole: Finding(
        found, spoken, said, None, None, SimpleNamespace(is_noise=is_noise)))
    return find(SimpleNamespace()).said


def test_what_does_the_same_counts_whatever_else_its_resamples_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    alike, late = {ENCODER: frozenset({INPUT})}, frozenset({ENCODER})
    assert said(monkeypatch, BEST, RESAMPLED, alike, False) == Stated(late | {RIPPLE}, late)
    assert said(monkeypatch, BEST, RESAMPLED, {}, False) == Stated(frozenset({RIPPLE}))
    assert said(monkeypatch, BEST, RESAMPLED, alike, True) == Stated(frozenset({RIPPLE})), "it is not beside all others"


def test_what_all_resamples_name_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    everything = {key: frozenset({INPUT}) for key in BEST}
    assert said(monkeypatch, BEST, (BEST,) * 10, everything, False) == Stated(BEST)


def test_what_a_cause_buys_is_read_off_the_likeliest_set_that_was_fitted_without_it_too() -> None:
    """Not off what is stated: a set without one of its causes need not have been fitted, and bought nothing then."""
    whole = BEST | {INPUT}
    scores = {frozenset(): 0.0, frozenset({BIAS}): 3.0, BEST: 90.0, whole: 91.0, whole - {BIAS}: 85.0,
              whole - {RIPPLE}: 20.0, whole | {("dead_zone", "amplifier")}: 92.0}
    search = SimpleNamespace(fits={keys: keys for keys in scores}, score=scores.__getitem__)
    assert finding.bought(search, RIPPLE) == 71.0 and finding.bought(search, BIAS) == 6.0
    assert finding.bought(search, INPUT) == 1.0 and finding.bought(search, ENCODER) == 0.0

"""What cases say together, against answers worked out by hand."""

from __future__ import annotations

import json
import math

import pytest

from station.campaign.outcome import covers
from station.campaign.run import Results
from station.campaign.summary import calibration, confusion, coverage, gains, share, shares, summary
from tests.campaign.made import BASE, COULOMB, DEAD_ZONE, cause, hidden, outcome

RIGHT = outcome("right", [hidden(DEAD_ZONE, width=3.0)], [cause(DEAD_ZONE, 0.95, {COULOMB: 0.05}, width=(2.0, 4.0))])
MISSED = outcome("missed", [hidden(DEAD_ZONE, width=3.0)], [], "nothing_missing", after=0.4, explained=None)
SWAPPED = outcome("swapped", [hidden(COULOMB, torque=1.0)], [cause(BASE, 0.6, {COULOMB: 0.4}, torque=(0.8, 1.2))],
                  "ambiguous")
BOTH = outcome("both", [hidden(COULOMB, torque=1.0), hidden(DEAD_ZONE, width=3.0)],
               [cause(DEAD_ZONE, 0.9, width=(1.0, 2.0)), cause(COULOMB, 0.8, torque=(0.9, 1.1))])
HALF = outcome("half", [hidden(COULOMB, torque=1.0), hidden(BASE, torque=1.0)], [cause(BASE, 0.9)])
CLEAN = outcome("clean", [], [], "nothing_missing")
ACCUSED = outcome("accused", [], [cause(COULOMB, 0.9)])
OUTSIDE = outcome("outside", [{"effect": "stuck_bit", "at": "", "bit": 2.0}], [], "unexplained", outside=True)
UNKNOWN = outcome("unknown", None, [cause(DEAD_ZONE, 0.99)])
ALL = [RIGHT, MISSED, SWAPPED, BOTH, HALF, CLEAN, ACCUSED, OUTSIDE, UNKNOWN]


def test_a_share_has_its_wilson_interval():
    """Wilson: (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n)."""
    found, z, n, p = share([True] * 19 + [False]), 1.959964, 20, 0.95
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert (found["count"], found["of"], found["share"]) == (19, 20, 0.95)
    assert found["low"] == pytest.approx((middle - half) / (1 + z * z / n), abs=1e-6)
    assert found["high"] == pytest.approx((middle + half) / (1 + z * z / n), abs=1e-6)
    assert share([])["share"] is None


def test_shares_count_what_they_say():
    found = {name: (value["count"], value["of"]) for name, value in shares(ALL).items()}
    assert found == {
        "single causes named first": (1, 3),
        "single causes named or listed as a rival": (2, 3),
        "something else accused beside a right first cause": (0, 1),
        "all of several causes found": (1, 2),
        "clean rigs accused": (1, 2),
        "outside the catalogue, explained all the same": (0, 1),
        "ambiguous": (1, 9),
        "right first cause, better on held-out runs": (3, 3),
        "95 % intervals that hold the truth": (2, 3),
    }


def test_the_confusion_matrix_has_a_row_for_everything_that_was_hidden():
    found = confusion(ALL)
    assert found["rows"] == ["coulomb_friction@motor", "dead_zone@amplifier", "clean", "several causes",
                             "outside the catalogue"]
    cells = {(row, column): count for row, counts in zip(found["rows"], found["counts"], strict=True)
             for column, count in zip(found["columns"], counts, strict=True) if count}
    assert cells == {
        ("dead_zone@amplifier", "dead_zone@amplifier"): 1, ("dead_zone@amplifier", "nothing_missing"): 1,
        ("coulomb_friction@motor", "coulomb_friction@base"): 1, ("clean", "nothing_missing"): 1,
        ("clean", "coulomb_friction@motor"): 1, ("several causes", "dead_zone@amplifier"): 1,
        ("several causes", "coulomb_friction@base"): 1, ("outside the catalogue", "unexplained"): 1}


def test_calibration_is_the_mean_distance_of_what_was_said_from_what_was():
    """Ten said 0.9, of which 7 are there; ten said 0.02, of which none is: (10 x 0.2 + 10 x 0.02) / 20."""
    found = calibration([(0.9, i < 7) for i in range(10)] + [(0.02, False)] * 10)
    assert found["error"] == pytest.approx(0.11)
    assert [(b["of"], b["count"]) for b in found["bins"]] == [(10, 0), (10, 7)]
    assert calibration([(1.0, True)])["error"] == 0.0 and calibration([])["error"] is None


def test_what_was_not_mentioned_was_given_no_probability():
    assert sorted(RIGHT.stated()) == [(0.05, False), (0.95, True)]
    assert list(MISSED.stated()) == [(0.0, True)]
    assert sorted(SWAPPED.stated()) == [(0.4, True), (0.6, False)]
    assert list(OUTSIDE.stated()) == [], "no cause of the catalogue is there, none was missed"


def test_intervals_are_held_against_the_truth_and_an_angle_may_wrap():
    assert [held for _, _, held in BOTH.intervals()] == [False, True]
    assert not list(SWAPPED.intervals()), "a wrong cause has no true value"
    assert covers(3.0, -3.0, 3.1) and covers(3.0, -3.0, -3.1) and not covers(3.0, -3.0, 0.0)


def test_coverage_is_told_for_each_parameter():
    found = {name: (value["count"], value["of"]) for name, value in coverage(ALL).items()}
    assert found == {"dead_zone@amplifier width": (1, 2), "coulomb_friction@motor torque": (1, 1)}


def test_gains_are_medians_by_group():
    row = next(row for row in gains(ALL) if row["group"] == "single")
    assert row["cases"] == 4 and row["explained_fraction"] == pytest.approx(0.9)
    assert row["encoder"] == {"nrmse_before": pytest.approx(0.4), "nrmse_after": pytest.approx(0.1)}
    assert row["accel"] == {"nrmse_before": None, "nrmse_after": None}


def test_runs_of_which_nobody_knows_the_cause_are_no_evidence():
    found = summary(Results([UNKNOWN]))
    assert found["confusion"]["rows"] == [] and found["calibration"]["stated"]["statements"] == 0
    assert found["gains"][0]["cases"] == 1 and found["table"][0]["hidden"] is None


def test_what_could_not_be_made_is_listed_and_not_counted():
    found = summary(Results([RIGHT, outcome("never", None, [], unmade="no size shows")], {"lost": "gone"}))
    assert found["cases"] == 1 and found["unmade"] == {"never": "no size shows"} and found["failed"] == {"lost": "gone"}
    json.dumps(found, allow_nan=False)

"""The three clocks meet in one place: device ticks, the host's monotonic clock, the wall."""

import numpy as np
import pytest

from station.loop.clocks import DeviceClock, HostClock, pace
from station.loop.timing import Histogram, Spread


def test_device_ticks_become_seconds_across_a_wrap():
    clock = DeviceClock(1e6)
    assert [clock.seconds((0xFFFFFF00 + i * 2000) & 0xFFFFFFFF) for i in range(4)] == [0.0, 0.002, 0.004, 0.006]


def test_a_wall_that_is_set_meanwhile_moves_no_instant():
    clock = HostClock(host_time=100.0, wall_time=1_700_000_000.0)
    assert clock.wall(100.0).isoformat() == "2023-11-14T22:13:20+00:00"
    assert (clock.wall(160.5) - clock.wall(100.0)).total_seconds() == 60.5


@pytest.mark.parametrize("true", [1.0, 0.98, 1.02, 1.0001])
def test_the_pace_of_a_device_is_found_through_late_receipts(true):
    random = np.random.default_rng(3)
    host = np.arange(5000) / 500.0
    received = host + random.exponential(2e-4, 5000) + 5e-3 * (random.random(5000) < 0.01)
    found = pace(true * host, received)
    assert found.ratio == pytest.approx(true, abs=5.0 * found.sigma + 2e-6)
    assert found.sigma < 2e-5


def test_too_little_for_a_pace_is_none():
    assert pace(np.arange(10.0), np.arange(10.0)) is None
    assert pace(np.zeros(50), np.arange(50.0)) is None


def test_a_histogram_holds_every_value_once():
    values = [5e-6, 15e-6, 15e-6, 1e-3, 0.7]
    found = Histogram.of(values)
    assert sum(found.counts) == 5 and found.counts[0] == 1 and found.counts[1] == 2 and found.counts[-1] == 1
    lines = found.lines()
    assert len(lines) == len(found.counts) and "20.000 %" in lines[0]
    assert Histogram.of([]).lines() == []


def test_a_spread_is_numpys_percentiles():
    values = np.arange(1001) / 1000.0
    found = Spread.of(values)
    assert [found.median, found.p99, found.p999, found.max] == pytest.approx([0.5, 0.99, 0.999, 1.0])

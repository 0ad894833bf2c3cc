"""Chirp bursts: so many, each rising and falling to nothing, silence between them, the frequencies that were asked."""

import numpy as np
import pytest

from station.control.references import chirp_burst, reference_from_test
from station.errors import UsageError


def test_bursts_are_alike_and_the_pauses_are_silent():
    reference = chirp_burst(500.0, amplitude=40.0, length=1.0, pause=0.5, bursts=3, duration=5.0)
    rows = [reference[100 + i * 750:100 + i * 750 + 500] for i in range(3)]
    assert np.array_equal(rows[0], rows[1]) and np.array_equal(rows[0], rows[2])
    for i in range(3):
        assert not np.any(reference[600 + i * 750:850 + i * 750])
    assert not np.any(reference[:100]) and not np.any(reference[2350:])
    assert 38.0 < np.max(np.abs(reference)) <= 40.0
    assert abs(rows[0][0]) < 1e-9 and abs(rows[0][-1]) < 1.0


def test_its_frequency_rises_from_f0_to_f1():
    reference = chirp_burst(1000.0, amplitude=1.0, f0=5.0, f1=45.0, length=4.0, pause=0.0, bursts=1, duration=4.2)
    burst = reference[200:]
    crossings = np.flatnonzero(np.diff(np.signbit(burst)))
    seconds = 0.5 * (crossings[1:] + crossings[:-1]) / 1000.0
    frequency = 500.0 / np.diff(crossings)
    expected = 5.0 + 10.0 * seconds
    assert np.median(np.abs(frequency - expected) / expected) < 0.05


def test_a_burst_that_does_not_fit_is_left_out_whole():
    four, five = (reference_from_test({"kind": "chirp_burst", "bursts": n}, 500.0) for n in (3, 5))
    assert np.array_equal(four, five)
    with pytest.raises(UsageError, match=r"test.duration: no burst of 2 s fits into 2.1 s"):
        reference_from_test({"kind": "chirp_burst", "duration": 2.1}, 500.0)

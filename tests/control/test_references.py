"""Test references: shapes, rests, the laboratory's own tests, and keys that are wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import max_len_seq

from station.control.references import KINDS, defaults, reference_from_test
from station.errors import UsageError
from tests.measured import measured_log

RATE = 500.0


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_begins_at_rest_and_reaches_its_amplitude(kind):
    reference = reference_from_test({"kind": kind}, RATE)
    rest = round(defaults(kind)["rest"] * RATE)
    amplitude = defaults(kind)["amplitude"]
    assert rest >= 100
    assert not np.any(reference[:rest])
    assert np.any(reference[rest:rest + 50])
    assert len(reference) == round(defaults(kind)["duration"] * RATE)
    assert np.max(np.abs(reference)) <= amplitude + 1e-9
    assert np.max(np.abs(reference)) >= 0.99 * amplitude


@given(kind=st.sampled_from(list(KINDS)), rate=st.floats(100.0, 2000.0), amplitude=st.floats(-150.0, 150.0),
       rest=st.floats(0.2, 1.0))
def test_a_reference_scales_with_its_amplitude_and_rests_for_its_rest(kind, rate, amplitude, rest):
    one = reference_from_test({"kind": kind, "rest": rest, "duration": rest * 2 + 3.0, "amplitude": 1.0}, rate)
    other = reference_from_test({"kind": kind, "rest": rest, "duration": rest * 2 + 3.0, "amplitude": amplitude}, rate)
    np.testing.assert_allclose(other, amplitude * one, atol=1e-9)
    assert len(one) == round((rest * 2 + 3.0) * rate)
    assert not np.any(one[:round(rest * rate)])


@pytest.mark.parametrize(("name", "test", "shift"), [
    ("pulse", {"kind": "pulse", "amplitude": 100, "width": 0.1, "second": 1.56, "duration": 2.16}, 80),
    ("p", {"kind": "step", "amplitude": 50, "duration": 2.1}, 50),
    ("lead", {"kind": "step", "amplitude": 100, "duration": 2.18}, 90),
    ("lead_accel", {"kind": "step", "amplitude": 200, "duration": 2.18}, 90),
])
def test_the_laboratorys_tests_are_these_after_a_longer_rest(name, test, shift):
    logged = np.loadtxt(measured_log(name))[:, 2]
    made = reference_from_test(test, RATE)[shift:]
    rows = min(len(logged), len(made))
    assert rows >= 990
    assert np.array_equal(made[:rows], logged[:rows])


def test_the_laboratorys_sweep_is_the_default_one_in_whole_counts():
    logged = np.loadtxt(measured_log("sweep"))[:, 2]
    made = reference_from_test({"kind": "sweep"}, RATE)
    assert len(made) == len(logged)
    assert np.max(np.abs(made - logged)) <= 1.0


@pytest.mark.parametrize("spacing", ["linear", "log"])
def test_a_sweep_goes_from_one_frequency_to_the_other(spacing):
    test = {"kind": "sweep", "f0": 2.0, "f1": 32.0, "duration": 22.0, "rest": 1.0, "spacing": spacing, "amplitude": 1.0}
    reference = reference_from_test(test, 5000.0)[5000:-5000]
    rising = np.flatnonzero((reference[:-1] < 0) & (reference[1:] >= 0)) / 5000.0
    measured, at = 1.0 / np.diff(rising), (rising[1:] + rising[:-1]) / 2.0
    expected = 2.0 + 30.0 * at / 20.0 if spacing == "linear" else 2.0 * 16.0 ** (at / 20.0)
    np.testing.assert_allclose(measured, expected, rtol=0.02)


def test_a_multisine_holds_its_band_alone_and_repeats_with_its_seed():
    test = {"kind": "multisine", "f0": 2.0, "f1": 10.0, "tones": 17, "duration": 10.2}
    wave = reference_from_test(test, RATE)[100:]
    power = np.abs(np.fft.rfft(wave)) ** 2
    lines = np.flatnonzero(power > 1e-6 * power.max()) / 10.0
    assert np.allclose(lines, np.arange(2.0, 10.1, 0.5))
    assert np.array_equal(wave, reference_from_test(test, RATE)[100:])
    assert not np.array_equal(wave, reference_from_test(test | {"seed": 1}, RATE)[100:])


def test_a_binary_sequence_is_balanced_and_of_maximal_length():
    wave = reference_from_test({"kind": "prbs", "bits": 5, "hold": 0.01, "duration": 0.2 + 31 * 0.01}, RATE)[100:]
    bits = wave[::5] > 0
    assert set(np.abs(wave)) == {50.0}
    assert np.count_nonzero(bits) == 16
    assert {tuple(np.roll(bits, -i)[:5]) for i in range(31)} == {
        tuple(bool(n >> i & 1) for i in range(5)) for n in range(1, 32)}


@pytest.mark.parametrize("bits", range(2, 21))
def test_binary_sequences_are_those_of_scipy(bits):
    test = {"kind": "prbs", "bits": bits, "hold": 1.0 / RATE, "duration": 0.2 + (2**bits - 1) / RATE}
    wave = reference_from_test(test, RATE)[100:]
    assert np.array_equal(wave > 0, max_len_seq(bits)[0] == 1)


@pytest.mark.parametrize(("test", "words"), [
    ({}, "test.kind"), ({"kind": "steps"}, "test.kind: 'steps' is none of step"),
    ({"kind": "step", "amplitud": 1}, "test.amplitud: unknown key"),
    ({"kind": "step", "amplitude": "100"}, "test.amplitude: a finite number"),
    ({"kind": "step", "amplitude": float("nan")}, "test.amplitude: a finite number"),
    ({"kind": "step", "amplitude": True}, "test.amplitude: a finite number"),
    ({"kind": "step", "rest": 0.1}, "test.rest: at least 0.2 s"),
    ({"kind": "step", "duration": 0.2}, "test.duration"), ({"kind": "step", "duration": 1e9}, "test.duration"),
    ({"kind": "sweep", "f1": 250.0}, "test.f1"), ({"kind": "sweep", "f0": -1.0}, "test.f0"),
    ({"kind": "sweep", "spacing": "cubic"}, "test.spacing"), ({"kind": "sweep", "spacing": "log"}, "test.f0"),
    ({"kind": "sweep", "duration": 2.0}, "test.duration"), ({"kind": "pulse", "width": 0}, "test.width"),
    ({"kind": "prbs", "bits": 40}, "test.bits"), ({"kind": "multisine", "tones": 1.5}, "test.tones"),
    ({"kind": "multisine", "tones": 0}, "test.tones"), ({"kind": "multisine", "f1": 0.01, "f0": 0}, "test.f1"),
])
def test_a_key_that_is_wrong_is_named(test, words):
    with pytest.raises(UsageError) as told:
        reference_from_test(test, RATE)
    assert words in str(told.value)
    assert "\n" not in str(told.value)

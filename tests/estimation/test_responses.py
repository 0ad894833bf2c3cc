"""Responses as blocks: what a run and a rig's model say of each other in the frequency domain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.errors import WorkError
from station.estimation.dataset import dataset
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.estimation.responses import spectra, with_responses
from station.model.frequency import finite_element_response, measured_response
from station.model.simulate import simulate
from station.rig import load_rig
from station.runs.run import Run, RunMetadata

SFLR = load_rig("sflr")


def shaken(rows: int = 6000) -> Run:
    """Noise in, what the rig makes of it out."""
    command, zero = 80.0 * np.random.default_rng(0).standard_normal(rows).clip(-2, 2), np.zeros(rows)
    run = Run("noise", np.arange(rows) / 500.0, command, command, zero, zero,
              RunMetadata(controller={"kind": "open"}, command_row=-1))
    made = simulate(SFLR, run, start_angle=0.0)
    return replace(run, encoder=made.encoder, accel=made.accel)


@pytest.mark.parametrize("alone", [True, False])
def test_errors_are_the_logarithm_of_measured_over_simulated(alone: bool) -> None:
    run, off = shaken(), SFLR.with_constants({"accelerometer.gain": 1.2 * SFLR.accelerometer.gain})
    data = dataset(off, [run])
    in_time = Predictor(data, observers(data.rig, 0.0), Pool())
    predictor = with_responses(in_time, alone)
    space = parameters(data, Hypothesis(), {})
    predicted = predictor.runs(space, space.mean, data.own)[0]
    plain = in_time.runs(space, space.mean, data.own)[0]
    assert len(predicted) == 4 + (0 if alone else len(plain))
    if not alone:
        np.testing.assert_array_equal(predicted[:-4], plain)
    error = (predictor.measured(0) - predicted)[-4:]
    used = predictor.share(0)[-4:] > 0.0
    for block, sensor in ((0, "encoder"), (2, "accel")):
        spectrum = spectra(run, 2)[block // 2]
        ratio = spectrum.value / getattr(finite_element_response(data.rig, spectrum.frequency), sensor)
        np.testing.assert_allclose(np.exp(error[block] + 1j * error[block + 1])[used[block]], ratio, rtol=1e-9)
    assert np.median(error[2][used[2]]) == pytest.approx(-np.log(1.2), abs=0.02)
    assert np.all(error[~used] == 0.0) and np.all(predictor.counts[0, -4:] == used.sum(axis=1))


def test_only_what_coheres_counts_and_no_more_than_was_logged_can_hold() -> None:
    run = shaken()
    whole = spectra(run, 2)[1]
    coherence = measured_response(run).accel_coherence
    assert whole.frequency.max() < 0.45 * 500.0 and len(whole.rows) == len(set(whole.rows)) <= np.sum(coherence > 0.8)
    thin = replace(run, **{name: values[::2] for name, values in run.columns().items()}).filled(500.0)
    assert 0.0 < spectra(thin, 2)[1].frequency.max() < 0.45 * 250.1
    assert spectra(run.slice(0, 900), 2) == [None, None]


def test_without_any_response_there_is_nothing_to_fit() -> None:
    run = shaken(900)
    data = dataset(SFLR, [run])
    in_time = Predictor(data, observers(data.rig, 0.0), Pool())
    with pytest.raises(WorkError, match="no run is long and rich enough"):
        with_responses(in_time, alone=True)
    assert not with_responses(in_time, alone=False).share(0)[-4:].any()

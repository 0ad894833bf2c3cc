"""Lost samples: simulated through, never counted, never corrected by."""

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
from station.rig import load_rig
from station.runs import Run
from tests.cli.conftest import step_run

LOST = np.array([60, 61, 62, 150])


def with_gaps() -> Run:
    """A step of which a few rows are lost."""
    whole = step_run(name="gappy")
    kept = np.delete(np.arange(len(whole)), LOST)
    columns = {name: values[kept] for name, values in whole.columns().items()}
    return Run(name="gappy", n=kept, metadata=whole.metadata, **columns)


def test_lost_rows_do_not_count_and_the_others_count_as_in_the_whole_run():
    rig = load_rig("sflr")
    data, whole = dataset(rig, [with_gaps()]), dataset(rig, [step_run()])
    assert np.array_equal(np.flatnonzero(~data.records[0].run.logged), LOST)
    assert np.all(data.records[0].share[:, LOST] == 0.0)
    # When a count was left is not known where rows are lost: that stay, and the ones beside it, may last longer.
    stay = np.cumsum(np.diff(whole.records[0].measured[0], prepend=0.0) != 0.0)
    far = np.abs(stay[:, None] - stay[LOST]).min(axis=1) > 1
    assert 0.4 < np.mean(far) < 1.0
    np.testing.assert_array_equal(data.records[0].share[:, far], whole.records[0].share[:, far])


def test_windows_keep_lost_rows_out():
    data = dataset(load_rig("sflr"), [with_gaps()], [slice(0, 100)])
    assert data.records[0].window.sum() == 97 and not data.records[0].window[100:].any()


def test_what_stands_in_a_gap_never_reaches_a_prediction():
    rig = load_rig("sflr")
    found = []
    for spoil in (0.0, 500.0):
        data = dataset(rig, [with_gaps()])
        data.records[0].measured[:, LOST] += spoil
        predictor = Predictor(data, observers(data.rig, data.noise[0]), Pool())
        space = parameters(data, Hypothesis(), {})
        found.append(predictor.runs(space, np.zeros(space.size), data.own)[0])
    read = replace(data, records=tuple(replace(one, run=replace(one.run, extra={})) for one in data.records))
    heard = predictor.on(read).runs(space, np.zeros(space.size), data.own)[0]
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(heard - found[0]).max() > 1.0


def test_a_run_of_another_rate_is_refused():
    slow = load_rig("sflr").model_copy(update={"sample_rate": 250.0})
    with pytest.raises(WorkError, match="step: sampled at 500 Hz, the rig at 250 Hz"):
        dataset(slow, [step_run()])

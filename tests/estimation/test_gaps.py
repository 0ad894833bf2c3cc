"""Lost samples: simulated through, never counted, never corrected by."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from station.errors import WorkError
from station.estimation.dataset import dataset
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import SEARCH, Predictor, predict_run
from station.estimation.record import WARM
from station.model.simulate import build
from station.rig import load_rig
from station.runs import Run
from tests.cli.conftest import step_run
from tests.estimation.made import AXIS, run_of

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


def test_after_a_gap_of_which_nobody_knows_the_commands_the_state_is_found_again() -> None:
    """A loop that turned round in a gap: in the log the command before it stands there."""
    whole = run_of(AXIS, 60.0, "open", "pulses", 3.0)
    kept = np.delete(np.arange(len(whole)), np.arange(100, 250))
    gone = Run.from_columns("gone", "gone", {name: values[kept] for name, values in whole.columns().items()}
                            | {"n": kept}, whole.metadata)
    data = dataset(AXIS, [gone])
    record, after = data.records[0], slice(250 + round(WARM * AXIS.sample_rate), None)
    assert not record.in_motion and np.array_equal(np.flatnonzero(~record.window), np.arange(100, after.start))
    model = build(data.rig, *SEARCH[:2])
    watched = observers(data.rig, data.noise[0], (0.05, math.inf))
    made, torque = predict_run(data, model, watched, 0, data.own[0])
    assert np.abs(made[:, 0, :100] - whole.encoder[:100]).max() < 1.0
    assert np.abs(made[:, 0, after] - whole.encoder[after]).max() < 2.0 and not torque[1, after].any()
    held = replace(record, run=replace(record.run, extra={}), finding=np.zeros(len(whole), dtype=bool))
    assert np.abs(predict_run(replace(data, records=(held,)), model, watched, 0, data.own[0])[0][1, 0, after]
                  - whole.encoder[after]).max() > 50.0


def test_a_run_of_another_rate_is_refused():
    slow = load_rig("sflr").model_copy(update={"sample_rate": 250.0})
    with pytest.raises(WorkError, match="step: sampled at 500 Hz, the rig at 250 Hz"):
        dataset(slow, [step_run()])

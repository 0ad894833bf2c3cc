"""The state estimate of the live view follows the beam of a rig that is not quite the model's."""

import numpy as np
import pytest

from station.model.simulate import simulate
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
from station.view.observer import Observer

RIG = load_rig("sflr")


def followed(rig, model, offset=0.0):
    """Tip deflection (m) of a step on a rig, simulated and as the observer of another model sees it."""
    rows = 800
    reference = np.where(np.arange(rows) < 100, 0.0, 100.0)
    metadata = RunMetadata(controller={"kind": "p", "gain": 2.0},
                           command_row=-1)
    zeros = np.zeros(rows)
    made = simulate(rig, Run("step", zeros + np.arange(rows) / 500.0, reference, zeros, zeros, zeros, metadata),
                    accel_offset=offset, states=True, start_angle=0.3)
    observer, tips, angles = Observer(model), [], []
    for command, encoder, accel in zip(made.command, made.encoder, made.accel, strict=True):
        observer.see(command, encoder, accel)
        tips.append(observer.deflection[-1])
        angles.append(observer.angle)
    angle = made.encoder * rig.angle_per_count
    length = rig.beam.length
    return made.shape[:, -1] - angle * length, \
        np.array(tips), angle, np.array(angles)


@pytest.mark.parametrize(("changes", "most"), [
    ({}, 0.12), ({"tip.mass": 1.1, "clamp.stiffness": 0.9}, 0.17),
    ({"tip.mass": 1.3, "beam.flexural_rigidity": 0.8}, 0.33)])
def test_the_tip_and_the_angle_are_followed(changes, most):
    rig = RIG.with_constants({key: factor * RIG.constants()[key] for key, factor in changes.items()})
    true, seen, angle, angles = followed(rig, RIG, offset=40.0)
    assert np.ptp(true) > 0.01
    assert np.linalg.norm(true - seen) < most * np.linalg.norm(true)
    assert np.max(np.abs(angle - angles)) < 3.0 * RIG.angle_per_count


def test_a_beam_that_bends_the_other_way_would_be_seen():
    """The figure above can fail: a straight arm is far off."""
    true, seen, _, _ = followed(RIG, RIG)
    assert np.linalg.norm(true + seen) > 1.5 * np.linalg.norm(true)
    assert np.corrcoef(true, seen)[0, 1] > 0.98


def test_a_rig_without_a_beam_is_a_straight_arm():
    axis = RIG.model_copy(update={"clamp": None, "beam": None, "tip": None, "accelerometer": None})
    observer = Observer(axis)
    for i in range(200):
        observer.see(0.0, float(i), 0.0)
    assert np.array_equal(observer.deflection, np.zeros(2))
    assert observer.angle == pytest.approx(199 * axis.angle_per_count, abs=2.0 * axis.angle_per_count)

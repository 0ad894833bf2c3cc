"""The picture of friction by load on a rig without a drive: what is missing lies on the law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.model.effects import effect_class
from station.model.simulate import simulate
from station.pictures.evidence import evidence
from station.rig import Amplifier, Encoder, Motor, Rig
from station.runs.run import Run, RunMetadata

FRACTION = 0.3
SERVO = Rig(name="servo", sample_rate=500.0, motor=Motor(inertia=5e-3, damping=0.04, gain=1.5e-3),
            encoder=Encoder(counts_per_revolution=8192.0), amplifier=Amplifier(limit=885.0),
            effects=(effect_class("gravity_tilt")(at="base", torque=0.4, angle=0.0),))


def moved(rig: Rig) -> Run:
    """Three seconds of two sines under proportional control."""
    t = np.arange(1500) / rig.sample_rate
    asked = np.round(900.0 * np.sin(2.0 * np.pi * 0.5 * t) + 300.0 * np.sin(2.0 * np.pi * 1.3 * t))
    run = Run("sines", t, asked, 0.0 * t, 0.0 * t, None,
              RunMetadata(rig=rig.name, controller={"kind": "p", "gain": 1.0}, command_row=-1))
    made = simulate(rig, run)
    return replace(run, command=made.command, encoder=made.encoder)


def test_what_opposes_a_servo_grows_with_the_load_on_its_gears() -> None:
    rubbing = SERVO.with_effects([*SERVO.effects, effect_class("load_friction")(at="motor", fraction=FRACTION)])
    picture, *_ = evidence(SERVO, rubbing, [moved(rubbing)], [("load_friction", "motor")])
    assert picture.kind == "load" and picture.law_x is not None and picture.law_y is not None
    assert np.allclose(picture.law_y, FRACTION * picture.law_x)
    much = picture.x > 0.3 * picture.x.max()
    assert much.sum() > 100
    assert np.median(picture.y[much] / picture.x[much]) == pytest.approx(FRACTION, rel=0.1)

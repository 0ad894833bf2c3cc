"""What acts inside a motor without a drive along a motion: the command that reaches it, and the load on its gears."""

from __future__ import annotations

import numpy as np

from station.model import stepper
from station.model.assembly import assemble, axis_moment
from station.model.effects import Effect, Stage
from station.model.simulate import build, controller_arrays, initial_state
from station.rig import Encoder, Motor, Rig


def effective_command(rig: Rig, command: np.ndarray) -> np.ndarray:
    """Mean command (n), counts, that reaches the motor's gain over each period: after delay, static effects and lag.

    The stepper works it out: a motor of inertia 1 and gain 1 without damping gains as much speed as the command, over
    a period, is large.
    """
    chain = [e for e in rig.effects if e.stage in (Stage.COMMAND, Stage.INPUT_DELAY, Stage.CLOCK)]
    model = build(Rig(name="integrator", sample_rate=rig.sample_rate, amplifier=rig.amplifier,
                      motor=Motor(inertia=1.0, damping=0.0, gain=1.0), encoder=Encoder(counts_per_revolution=1.0),
                      effects=tuple(chain)))
    rows = len(command)
    state, sent = initial_state(model), np.append(np.asarray(command, dtype=float), 0.0)
    zero, history = np.zeros(rows + 1), np.zeros((rows + 1, 2))
    stepper.run_ticks(model.plan, state, controller_arrays({"kind": "open"}, model.rig), sent, sent, False, 0, 0.0,
                      stepper.NONE, False, zero, zero.copy(), history)
    return np.diff(history @ model.form.basis[1]) / (model.plan.h * model.plan.substeps)


def axis_load(rig: Rig, command: np.ndarray, angle: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Load (n), N m, on the gears of a motor without a drive: motor torque less external torque, with its sign.

    ``command`` (n): as it reaches the motor's gain, counts (``effective_command``); ``angle``, ``speed`` (n x
    coordinates of ``assemble``): absolute angles in rad (the beam's deflections in m) and their rates at the same
    instants.  The size of this is what load_friction takes its fraction of; see there for what counts as which torque.
    """
    parts = assemble(rig)
    load = rig.motor.gain * command - rig.motor.damping * speed[:, parts.motor]
    load -= np.hstack([angle, speed]) @ axis_moment(parts, rig.motor.damping)
    for effect in rig.effects:
        if effect.stage is Stage.TORQUE:
            side = -1.0 if effect.at == "base" else 1.0
            load += side * _along(rig, effect, angle[:, parts.motor], speed[:, parts.motor])
        elif effect.stage is Stage.SPRING and effect.at == "clamp":
            bent = angle[:, parts.base] - angle[:, parts.root]
            load += _along(rig, effect, bent, speed[:, parts.base] - speed[:, parts.root])
    return load


def _along(rig: Rig, effect: Effect, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    law, p = type(effect).law, effect.arguments(rig)
    return np.array([law(*row, 0.0, p, [0.0], rig.period) for row in zip(x.tolist(), v.tolist(), strict=True)])

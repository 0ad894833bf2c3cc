"""What a rig's own effects do along a motion that is given: laws, joints, held parts, the load on a motor's gears.

Laws and joints are the stepper's own program, row by row.
"""

from __future__ import annotations

import math

import numpy as np

from station.model import stepper
from station.model.assembly import assemble, axis_moment
from station.model.compiled import address
from station.model.effects import Effect, Stage
from station.model.simulate import build, controller_arrays, initial_state, slots
from station.rig import Encoder, Motor, Rig

TORQUES = (Stage.TORQUE, Stage.FRICTION, Stage.GAP, Stage.SPRING)
"""Stages of the effects that are torques."""
REST_ROWS = 20
"""Rows in which a part must move by a count to count as moving."""
NEWTON = 8
"""Steps of Newton's method."""
SOFTEST = 0.05
"""Share of a joint's stiffness below which its own effects are not taken to make it softer."""
PLACES = np.geomspace(1e-5, 1.0, 512)
"""Deflections at which a joint's torque is worked out, shares of the largest: 2 % apart."""


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
                      stepper.NONE, (False, False), zero, zero.copy(), history)
    return np.diff(history @ model.form.basis[1]) / (model.plan.h * model.plan.substeps)


def axis_load(rig: Rig, command: np.ndarray, angle: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Load (n), N m, on the gears of a motor without a drive: motor torque less external torque, with its sign.

    ``command`` (n): as it reaches the motor's gain, counts (``effective_command``); ``angle``, ``speed`` (n x
    coordinates of ``assemble``): absolute angles in rad (the beam's deflections in m) and their rates at the same
    instants.  The size of this is what load_friction takes its fraction of; see there for what counts as which torque.
    """
    parts = assemble(rig)
    load = rig.motor.gain * command - rig.motor.electrical_damping * speed[:, parts.motor]
    load -= np.hstack([angle, speed]) @ axis_moment(parts, rig.motor.damping)
    for effect in rig.effects:
        if effect.stage is Stage.TORQUE:
            side = -1.0 if effect.at == "base" else 1.0
            load += side * law_values(rig, effect, angle[:, parts.motor], speed[:, parts.motor])
        elif effect.stage is Stage.SPRING and effect.at == "clamp":
            bent = angle[:, parts.base] - angle[:, parts.root]
            load += law_values(rig, effect, bent, speed[:, parts.base] - speed[:, parts.root])
    return load


def law_values(rig: Rig, effect: Effect, x: np.ndarray | float, v: np.ndarray | float = 0.0,
               w: np.ndarray | float = 0.0, h: float | None = None) -> np.ndarray:
    """An effect's own law along arrays (n), its states carried from row to row; see station.model.effects.base."""
    x, v, w = (np.ascontiguousarray(row, dtype=float) for row in np.atleast_1d(*np.broadcast_arrays(x, v, w)))
    return stepper.law_along(address(type(effect).law), np.array([*effect.arguments(rig), 0.0]),
                             np.zeros(max(effect.states, 1)), x, v, w, rig.period if h is None else h)


def true_encoder(rig: Rig, reading: np.ndarray) -> np.ndarray:
    """The encoder (counts) without the eccentricity and delay that the rig holds; its last reading is held."""
    period = rig.period * math.prod(e.values()["ratio"] for e in rig.effects if e.stage is Stage.CLOCK)
    late = sum(e.values()["time"] for e in rig.effects if e.stage is Stage.ENCODER_DELAY)
    added = sum(law_values(rig, e, reading * rig.angle_per_count) for e in rig.effects if e.stage is Stage.ENCODER)
    ticks = np.arange(len(reading))
    return np.interp(ticks + late / period, ticks, reading - added)


def part_of(rig: Rig, effect: Effect) -> str:
    """The place at which an effect's torque acts."""
    if effect.stage is Stage.FRICTION and effect.at == "drive" or effect.at == "base" and rig.drive is None:
        return "motor"
    return effect.at


def joint_torque(rig: Rig, at: str, deflection: np.ndarray, rate: np.ndarray, h: float) -> np.ndarray:
    """Torque (n) of the drive or clamp with the effects that the rig holds, pulling its two sides together, N m."""
    joint = getattr(rig, at)
    laws = [e for stage in (Stage.GAP, Stage.SPRING) for e in rig.effects if e.at == at and e.stage is stage]
    table, first, arguments, states = slots(rig, laws, (at,))
    x, v = (np.ascontiguousarray(row, dtype=float) for row in (deflection, rate))
    return stepper.joint_along((table, first, arguments, np.zeros(states + 1), h), joint.stiffness, joint.damping, x, v)


def held_torque(rig: Rig, at: str, angle: np.ndarray, speed: np.ndarray, load: np.ndarray,
                before: np.ndarray | float, h: float) -> np.ndarray:
    """Torque (n) of the rig's own effects on a part that moves so, N m; of joints what differs from spring and damper.

    ``load`` (n): on the gears, N m.  Dry friction of a part that moves less than a count in REST_ROWS rows is left at
    0: the motion does not say it.
    ``before`` is what was found for this place with the motion at hand: a spring without play is taken at the
    deflection at which it carries the torque that this motion passes on, which the data fix, not the deflection.
    """
    total = np.zeros(len(angle))
    here = [e for e in rig.effects if e.stage in TORQUES and part_of(rig, e) == at]
    for effect in here:
        if effect.stage is Stage.TORQUE:
            total += law_values(rig, effect, angle, speed, h=h)
        elif effect.stage is Stage.FRICTION:
            moves = np.abs(speed) > rig.angle_per_count / (REST_ROWS * h)
            total -= np.sign(speed) * moves * law_values(rig, effect, np.abs(speed), 0.0, np.abs(load), h)
    if any(e.stage is Stage.GAP for e in here):
        joint = getattr(rig, at)
        total += joint.stiffness * angle + joint.damping * speed - joint_torque(rig, at, angle, speed, h)
    elif any(e.stage is Stage.SPRING for e in here):
        stiffness = getattr(rig, at).stiffness
        carried = stiffness * angle - before
        total += stiffness * _deflection(rig, at, carried, angle, h) - carried
    return total


def equivalent_stiffness(rig: Rig, at: str, torque: np.ndarray) -> float:
    """Stiffness, N m/rad, of the spring that comes nearest to a joint and its effects where they carry torques (m).

    By least squares of the deflection, the torques weighing by their squares (statistical linearisation: Booton, Proc.
    Symp. Nonlinear Circuit Analysis, 1953; as a rule these are picked at equal shares of the sum of squares).  A joint
    that softens is deflected no further than to where it carries most.
    """
    softest = SOFTEST * getattr(rig, at).stiffness
    places, compliance = np.max(np.abs(torque)) / softest * PLACES, np.zeros(len(torque))
    both = joint_torque(rig, at, np.concatenate([places, -places]), np.zeros(2 * len(places)), rig.period)
    for way, carried in ((1.0, both[: len(places)]), (-1.0, -both[len(places):])):
        end = len(places) - int(np.argmax(carried[::-1]))
        here = way * torque > 0.0
        held = np.minimum(way * torque[here], carried[end - 1])
        deflection = np.interp(held, np.maximum.accumulate(carried[:end]), places[:end])
        compliance[here] = deflection / np.maximum(held, softest * deflection)
    return 1.0 / float(np.mean(compliance))


def _deflection(rig: Rig, at: str, torque: np.ndarray, guess: np.ndarray, h: float) -> np.ndarray:
    """Deflection (n) at which a joint at rest carries a torque (n), by Newton's method."""
    small, still, x = 1e-6 * (1.0 + np.max(np.abs(guess))), np.zeros(len(guess)), guess
    for _ in range(NEWTON):
        value = joint_torque(rig, at, x, still, h)
        slope = (joint_torque(rig, at, x + small, still, h) - value) / small
        x = x + (torque - value) / np.maximum(slope, 0.05 * getattr(rig, at).stiffness)
    return x

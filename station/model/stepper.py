"""The compiled stepper: one program for every rig and every set of effects.

Between ticks the linear part moves exactly (modal blocks, zero-order hold).  Effects that are torques act at ports:
pairs of a generalised torque with the rotation that it works on.  Over a step h

    y+ = y_free + H f

with y the ports' rotations and speeds, y_free their motion without port torques, f the port torques held over h and
H small and exact.  Smooth laws are taken at the mean of both ends (implicit midpoint).  Dry friction obeys
f in -level Sgn(v) within the step, too: a part is braked by the level until it stops, is then held while what drives it
is within the level at rest, and else moves on the other way.  So sticking is real (the speed is 0, not small), and the
mean torque of a step in which the motion turns, as that of one in which a joint meets or leaves the edge of its gap,
follows the instant at which it does, on the straight line between the step's ends: errors are of second order in h, and
outputs are smooth in the parameters.  The few equations are solved by Gauss-Seidel, each where it does not contract by
the secant: a spring that gets stiffer than the step is long answers more than what it is asked by.

Sensors are read at the tick, before the new command acts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from station.model.compiled import call_law, element, kernel

COMMAND, TORQUE, FRICTION, GAP, SPRING, ACCEL_INPUT, ACCEL_FILTER, ACCEL_COUNTS, ENCODER = range(9)
STAGES = 9
NONE, ALL, INSIDE = range(3)
MAX_ITERATIONS = 40
TOLERANCE = 1e-5
"""Of the ports' speeds, rad/s: 10^-6 of a count over a step."""
SLOW = 0.5
"""Share of what was wrong that is left by an iteration, from which on it is no contraction worth the name."""
LEAST_SLOPE = 0.1
"""Of the encoder's reading by the angle: what an observer divides by."""
AT_REST = 1e-4
"""Speed below which dry friction finds a part at rest, rad/s: what the ports' solution may leave of a speed of 0."""


class Plan(NamedTuple):
    """All that the stepper needs of a rig; arrays of float64 unless said. b blocks, p ports."""

    substeps: int
    h: float
    """Step, s."""
    phi: np.ndarray
    """(4, b) e^(A h)."""
    held: np.ndarray
    """(2b) response to one count held over h."""
    switched: np.ndarray
    """(2b) response to one count that is there until the command switches within a step."""
    switch: int
    """Step of the period in which the command switches (-1: at its start)."""
    switch_time: float
    whole_delay: int
    """Whole periods of input delay."""
    base_angle: np.ndarray
    base_speed: np.ndarray
    tip_acceleration: np.ndarray
    """(2b) output rows: rad, rad/s, m/s^2."""
    tip_feedthrough: float
    """m/s^2 per count."""
    port_joint: np.ndarray
    """(p) int64: 1 where the port is a joint with spring and damper, else 0."""
    port_angle: np.ndarray
    port_speed: np.ndarray
    """(p, 2b) output rows."""
    port_held: np.ndarray
    """(p, 2b) response to one N m held over h."""
    port_tip: np.ndarray
    """(p) m/s^2 at the tip per N m, at once."""
    angle_gain: np.ndarray
    speed_gain: np.ndarray
    """(p, p): H."""
    joint_stiffness: np.ndarray
    joint_damping: np.ndarray
    """(p)."""
    load_port: int
    """Port of the drive for load-dependent friction (-1: none)."""
    axis_port: int
    """Port of a motor without a drive for load-dependent friction (-1: none)."""
    motor_gain: float
    """N m per count."""
    back_emf: float
    """N m s/rad: what of the motor's damping the gears do not carry."""
    moment: np.ndarray
    """(2b) output row: torque of the beam and the clamp on the axis of a motor without a drive, N m."""
    moment_gain: np.ndarray
    """(p) the same per N m held over h."""
    slots: np.ndarray
    """(m, 5) int64: port, address, first argument, first state, side (1 the motor's, -1 what it moves); by stage."""
    first: np.ndarray
    """(STAGES + 1) int64: where each stage's slots begin."""
    arguments: np.ndarray
    limit: float
    length: float
    counts_per_radian: float
    counts_per_acceleration: float
    encoder_delay: float
    accel_delay: float
    """In steps h."""


class State(NamedTuple):
    """All that changes; arrays are written in place."""

    z: np.ndarray
    """(2b) modal coordinates."""
    torque: np.ndarray
    """(p) port torques over the last step."""
    effects: np.ndarray
    """The effects' own states."""
    commands: np.ndarray
    """(whole_delay + 2) ring of commands in force, newest at ``clock[1]``."""
    angles: np.ndarray
    accels: np.ndarray
    """Rings of base angle (rad) and filtered tip acceleration (m/s^2), newest at ``clock[2]``."""
    clock: np.ndarray
    """int64: ticks, place in commands, place in angles and accels."""
    last: np.ndarray
    """Command that acts now (counts), raw tip acceleration one step before, absolute zero of this run (rad)."""


class Controller(NamedTuple):
    """A compensator as arrays; see station.control.compensators."""

    open_loop: bool
    numerator: np.ndarray
    denominator: np.ndarray
    accel_numerator: np.ndarray
    accel_denominator: np.ndarray
    accel_zero: float
    feedback: np.ndarray
    """Coefficients of the encoder's present and past readings, taken off the command."""
    limit: float
    """What cuts its commands, counts."""


@kernel(fastmath={"contract"})
def _propagate(phi, held, z, count):
    """z -> Phi z + held count, in place."""
    b = phi.shape[1]
    for i in range(b):
        one, two = z[i], z[b + i]
        z[i] = phi[0, i] * one + phi[1, i] * two + held[i] * count
        z[b + i] = phi[2, i] * one + phi[3, i] * two + held[b + i] * count


@kernel(fastmath={"contract", "reassoc"})
def _dot(row, z):
    total = 0.0
    for i in range(z.size):
        total += row[i] * z[i]
    return total


@kernel(fastmath={"contract", "reassoc"})
def _dot2(one, two, z):
    first, second = 0.0, 0.0
    for i in range(z.size):
        first += one[i] * z[i]
        second += two[i] * z[i]
    return first, second


@kernel(forceinline=True)
def _cut(plan, command):
    return min(max(command, -plan.limit), plan.limit)


@kernel(forceinline=True)
def _chain(plan, state, command, h):
    for slot in range(plan.first[COMMAND], plan.first[COMMAND + 1]):
        command = call_law(plan.slots[slot, 1], command, 0.0, plan.limit,
                           element(plan.arguments, plan.slots[slot, 2]), element(state.effects, plan.slots[slot, 3]), h)
    return command


@kernel(forceinline=True)
def _port_sum(laws, stage, port, x, v, w):
    slots, first, arguments, effects, h = laws
    total = 0.0
    for slot in range(first[stage], first[stage + 1]):
        if slots[slot, 0] == port:
            total += call_law(slots[slot, 1], x, v, w, element(arguments, slots[slot, 2]),
                              element(effects, slots[slot, 3]), h)
    return total


@kernel(forceinline=True)
def _beyond_gap(laws, port, deflection):
    slots, first, arguments, effects, h = laws
    for slot in range(first[GAP], first[GAP + 1]):
        if slots[slot, 0] == port:
            deflection = call_law(slots[slot, 1], deflection, 0.0, 0.0, element(arguments, slots[slot, 2]),
                                  element(effects, slots[slot, 3]), h)
    return deflection


@kernel(forceinline=True)
def _joint_torque(laws, port, stiffness, damping, deflection, speed):
    """Torque of a joint with all its effects (pulling its two sides together), N m."""
    first = laws[1]
    beyond = _beyond_gap(laws, port, deflection)
    engaged = beyond != 0.0 or first[GAP + 1] == first[GAP]
    torque = stiffness * beyond + _port_sum(laws, SPRING, port, beyond, speed, 0.0)
    if engaged:
        torque += damping * speed
    return torque


@kernel(forceinline=True)
def _mean_joint_torque(laws, port, stiffness, damping, old_angle, angle, old_speed, speed):
    """Mean joint torque over a step, N m: at its middle, or, where contact is made or lost, at the middle of what is in
    contact, times its share of the step.

    A joint with a gap takes up its damper's torque at once at contact.  Deflection d and what exceeds the gap, e(d),
    say where: contact begins and ends at d - e(d), the gap's edge.
    """
    first = laws[1]
    if first[GAP + 1] > first[GAP]:
        before = _beyond_gap(laws, port, old_angle)
        after = _beyond_gap(laws, port, angle)
        if (before > 0.0) != (after > 0.0) or (before < 0.0) != (after < 0.0):
            turned, sped = angle - old_angle, speed - old_speed
            lost, made = min(abs(before / turned), 1.0), min(abs(after / turned), 1.0)
            total = 0.0
            if lost > 0.0:
                middle = 0.5 * lost
                total += lost * _joint_torque(laws, port, stiffness, damping, old_angle + middle * turned,
                                              old_speed + middle * sped)
            if made > 0.0:
                middle = 1.0 - 0.5 * made
                total += made * _joint_torque(laws, port, stiffness, damping, old_angle + middle * turned,
                                              old_speed + middle * sped)
            return total
    return _joint_torque(laws, port, stiffness, damping, 0.5 * (old_angle + angle), 0.5 * (old_speed + speed))


@kernel(forceinline=True)
def _dry(before, loose, level, hold, gain):
    """Mean dry friction over a step, N m, that begins at speed ``before`` and without friction would end at ``loose``.

    ``gain``: speed per N m held over the step.  A part that moves is braked by the level.  Where that stops it within
    the step, it is held there if what drives it, gain hold in speed over the step, can be; else it moves on the other
    way for the rest of the step.
    """
    driven, braking = loose - before, level * gain
    held = abs(driven) <= hold * gain
    if abs(before) < AT_REST:
        return -loose / gain if held else -math.copysign(level, driven)
    braked = loose - math.copysign(braking, before)
    if braked * before > 0.0:
        return -math.copysign(level, before)
    if held:
        return -loose / gain
    left = braked / (braked - before)
    return (left * (driven - math.copysign(braking, driven)) - loose) / gain


@kernel(forceinline=True)
def _axis_load(laws, axis, torque, given, x, v):
    """Mean load over a step on the gears of a motor that moves its load without a drive, N m.

    |motor torque - external torque| (Duclusaud, Passault et al., Extended Friction Models for the Physics Simulation of
    Servo Actuators, 2024, eq. of model M3).  Motor torque: gain times command, less the back-EMF, and what acts at the
    motor; external torque: what acts at the base, and the beam's.  ``given``: gain times command and the beam's torque
    without port torques, ``x``, ``v`` angle and speed, all means over the step.
    """
    slots, first, arguments, effects, h = laws
    port, back_emf, moment_gain = axis
    load = given[0] - back_emf * v - given[1]
    for q in range(torque.size):
        load -= 0.5 * moment_gain[q] * torque[q]
        if q != port:
            load -= torque[q]
    for slot in range(first[TORQUE], first[TORQUE + 1]):
        if slots[slot, 0] == port:
            load += slots[slot, 4] * call_law(slots[slot, 1], x, v, 0.0, element(arguments, slots[slot, 2]),
                                              element(effects, slots[slot, 3]), h)
    return abs(load)


@kernel(forceinline=True)
def _solve_ports(laws, joints, gains, load_port, axis, given, torque, zero, work):
    """Port torques over this step, written to ``torque``; ``work`` holds the ports' free and old angles and speeds, and
    what torque was tried before, and by how much it was wrong."""
    kinds, stiffness, damping = joints
    angle_gain, speed_gain = gains
    ports = kinds.size
    for iteration in range(MAX_ITERATIONS):
        change = 0.0
        for p in range(ports):
            angle, speed, hold = work[0, p], work[1, p], 0.0
            for q in range(ports):
                angle += angle_gain[p, q] * torque[q]
                speed += speed_gain[p, q] * torque[q]
            middle, mean = 0.5 * (work[2, p] + angle), 0.5 * (work[3, p] + speed)
            if kinds[p] == 1:
                linear = stiffness[p] * middle + damping[p] * mean
                wanted = linear - _mean_joint_torque(laws, p, stiffness[p], damping[p], work[2, p], angle, work[3, p],
                                                     speed)
            else:
                wanted = _port_sum(laws, TORQUE, p, middle + zero, mean, 0.0)
                load = 0.0
                if load_port >= 0:
                    j = load_port
                    a, s = work[0, j], work[1, j]
                    for q in range(ports):
                        a += angle_gain[j, q] * torque[q]
                        s += speed_gain[j, q] * torque[q]
                    load = abs(_mean_joint_torque(laws, j, stiffness[j], damping[j], work[2, j], a, work[3, j], s))
                elif axis[0] == p:
                    load = _axis_load(laws, axis, torque, given, middle + zero, mean)
                hold = _port_sum(laws, FRICTION, p, 0.0, 0.0, load)
                if hold > 0.0:
                    level = _port_sum(laws, FRICTION, p, abs(mean), 0.0, load)
                    loose = speed + speed_gain[p, p] * (wanted - torque[p])
                    wanted += _dry(work[3, p], loose, level, hold, speed_gain[p, p])
            wrong = wanted - torque[p]
            if iteration > 0 and hold == 0.0 and abs(wrong) > SLOW * abs(work[5, p]) and torque[p] != work[4, p]:
                slope = (wrong - work[5, p]) / (torque[p] - work[4, p])
                if slope < -1.0:
                    wanted = torque[p] - wrong / slope
            work[4, p], work[5, p] = torque[p], wrong
            change = max(change, abs(wrong) * speed_gain[p, p])
            torque[p] = wanted
        if change < TOLERANCE:
            break


@kernel(forceinline=True)
def _observe(plan, state, fresh):
    """Note base angle and filtered tip acceleration at the present instant in the rings."""
    angle, accel = _dot2(plan.base_angle, plan.tip_acceleration, state.z)
    accel += plan.tip_feedthrough * state.last[0]
    for p in range(plan.port_joint.size):
        accel += plan.port_tip[p] * state.torque[p]
    if plan.first[ACCEL_INPUT + 1] > plan.first[ACCEL_INPUT]:
        speed = _dot(plan.base_speed, state.z)
        for slot in range(plan.first[ACCEL_INPUT], plan.first[ACCEL_INPUT + 1]):
            accel += call_law(plan.slots[slot, 1], speed, 0.0, plan.length,
                              element(plan.arguments, plan.slots[slot, 2]),
                              element(state.effects, plan.slots[slot, 3]), plan.h)
    for slot in range(plan.first[ACCEL_FILTER], plan.first[ACCEL_FILTER + 1]):
        k = slot - plan.first[ACCEL_FILTER]
        before = accel if fresh else state.last[3 + k]
        state.last[3 + k] = accel
        accel = call_law(plan.slots[slot, 1], accel, before, 0.0, element(plan.arguments, plan.slots[slot, 2]),
                         element(state.effects, plan.slots[slot, 3]), plan.h)
    place = state.clock[2] + 1
    if place == state.angles.size:
        place = 0
    state.clock[2] = place
    state.angles[place] = angle
    state.accels[place] = accel


@kernel(forceinline=True)
def _late(ring, place, delay):
    if delay == 0.0:
        return ring[place]
    whole = int(delay)
    part = delay - whole
    i = (place - whole) % ring.size
    j = (place - whole - 1) % ring.size
    return ring[i] + part * (ring[j] - ring[i])


@kernel(forceinline=True)
def sense(plan, state, offset, rounding):
    """Encoder and accelerometer at this tick, counts."""
    angle = _late(state.angles, state.clock[2], plan.encoder_delay)
    encoder = angle * plan.counts_per_radian
    for slot in range(plan.first[ENCODER], plan.first[ENCODER + 1]):
        encoder += call_law(plan.slots[slot, 1], angle + state.last[2], 0.0, 0.0,
                            element(plan.arguments, plan.slots[slot, 2]),
                            element(state.effects, plan.slots[slot, 3]), plan.h)
    accel = _late(state.accels, state.clock[2], plan.accel_delay) * plan.counts_per_acceleration + offset
    for slot in range(plan.first[ACCEL_COUNTS], plan.first[ACCEL_COUNTS + 1]):
        accel = call_law(plan.slots[slot, 1], accel, 0.0, 0.0, element(plan.arguments, plan.slots[slot, 2]),
                         element(state.effects, plan.slots[slot, 3]), plan.h)
    if rounding:
        return math.floor(encoder + 0.5), math.floor(accel + 0.5)
    return encoder, accel


@kernel(forceinline=True)
def encoder_slope(plan, state):
    """What the encoder's reading changes per count of the angle, its own error included, a count to either side."""
    slope, count = 1.0, 1.0 / plan.counts_per_radian
    if plan.first[ENCODER + 1] > plan.first[ENCODER]:
        angle = _late(state.angles, state.clock[2], plan.encoder_delay) + state.last[2]
        for slot in range(plan.first[ENCODER], plan.first[ENCODER + 1]):
            law, arguments = plan.slots[slot, 1], element(plan.arguments, plan.slots[slot, 2])
            own = element(state.effects, plan.slots[slot, 3])
            slope += 0.5 * (call_law(law, angle + count, 0.0, 0.0, arguments, own, plan.h)
                            - call_law(law, angle - count, 0.0, 0.0, arguments, own, plan.h))
    return max(slope, LEAST_SLOPE)


@kernel(forceinline=True)
def advance(plan, state, command, disturbance, work):
    """Hold a command over one period, cut at the amplifier's limit, with ports, delays and filters; ``disturbance``:
    torque besides, in counts."""
    place = state.clock[1] + 1
    if place == state.commands.size:
        place = 0
    state.clock[1] = place
    state.commands[place] = _cut(plan, command)
    new = state.commands[(place - plan.whole_delay) % state.commands.size]
    old = state.commands[(place - plan.whole_delay - 1) % state.commands.size]
    z, ports, size = state.z, plan.port_joint.size, state.z.size
    between = (plan.encoder_delay > 0.0 or plan.accel_delay > 0.0
               or plan.first[ACCEL_FILTER + 1] > plan.first[ACCEL_FILTER])
    for p in range(ports):
        work[2, p], work[3, p] = _dot2(plan.port_angle[p], plan.port_speed[p], z)
    laws = (plan.slots, plan.first, plan.arguments, state.effects, plan.h)
    joints = (plan.port_joint, plan.joint_stiffness, plan.joint_damping)
    gains = (plan.angle_gain, plan.speed_gain)
    axis = (plan.axis_port, plan.back_emf, plan.moment_gain)
    driven, moment = 0.0, 0.0
    for step in range(plan.substeps):
        extra = 0.0
        if step == plan.switch:
            before = _chain(plan, state, old, plan.switch_time)
            count = _chain(plan, state, new, plan.h - plan.switch_time)
            extra = before - count
        else:
            count = _chain(plan, state, old if step < plan.switch else new, plan.h)
        if plan.axis_port >= 0:
            driven = plan.motor_gain * (count + extra * plan.switch_time / plan.h)
            moment = 0.5 * _dot(plan.moment, z)
        count += disturbance
        _propagate(plan.phi, plan.held, z, count)
        if extra != 0.0:
            for i in range(size):
                z[i] += plan.switched[i] * extra
        state.last[0] = count
        if ports > 0:
            for p in range(ports):
                work[0, p], work[1, p] = _dot2(plan.port_angle[p], plan.port_speed[p], z)
            if plan.axis_port >= 0:
                moment += 0.5 * _dot(plan.moment, z)
            _solve_ports(laws, joints, gains, plan.load_port, axis, (driven, moment), state.torque, state.last[2], work)
            for p in range(ports):
                work[2, p], work[3, p] = work[0, p], work[1, p]
                for q in range(ports):
                    work[2, p] += plan.angle_gain[p, q] * state.torque[q]
                    work[3, p] += plan.speed_gain[p, q] * state.torque[q]
                for i in range(size):
                    z[i] += plan.port_held[p, i] * state.torque[p]
        if between or step == plan.substeps - 1:
            _observe(plan, state, False)
    state.clock[0] += 1


@kernel(forceinline=True)
def is_plain(plan):
    """Whether nothing acts within a period and no sensor is late: a tick is one product of blocks."""
    return (plan.substeps == 1 and plan.port_joint.size == 0 and plan.slots.shape[0] == 0 and plan.switch < 0
            and plan.whole_delay == 0 and plan.encoder_delay == 0.0 and plan.accel_delay == 0.0)


@kernel(forceinline=True)
def sense_plain(plan, state, offset):
    """Encoder and accelerometer at this tick, counts, where ``is_plain``."""
    angle, accel = _dot2(plan.base_angle, plan.tip_acceleration, state.z)
    accel += plan.tip_feedthrough * state.last[0]
    return angle * plan.counts_per_radian, accel * plan.counts_per_acceleration + offset


@kernel(forceinline=True)
def advance_plain(plan, state, command, disturbance):
    """The same where ``is_plain``."""
    count = _cut(plan, command) + disturbance
    _propagate(plan.phi, plan.held, state.z, count)
    state.last[0] = count


@kernel()
def begin(plan, state):
    """First look at the sensors: fills the rings so that readings before t = delay are the starting one."""
    _observe(plan, state, True)
    place = state.clock[2]
    for i in range(state.angles.size):
        state.angles[i] = state.angles[place]
        state.accels[i] = state.accels[place]


@kernel()
def tick(plan, state, command, offset, rounding, work, out):
    """Hold a command to the next tick and read the sensors there: out = encoder, accel (counts)."""
    advance(plan, state, command, 0.0, work)
    out[0], out[1] = sense(plan, state, offset, rounding)


@kernel()
def ticks(plan, state, controller, reference, command, closed, command_row, offset, rounding, whole,
          encoder, accel, history, more, seen, work, past, past_accel):
    """As ``run_ticks``, with room to work in."""
    rows = reference.size
    num, den, feedback = controller.numerator, controller.denominator, controller.feedback
    anum, aden = controller.accel_numerator, controller.accel_denominator
    seen_encoder, seen_accel = seen
    e, v, y = past
    g, w = past_accel
    plain = is_plain(plan)
    z = state.z
    begin(plan, state)
    for row in range(rows):
        if plain:
            encoder[row], accel[row] = sense_plain(plan, state, offset)
        else:
            encoder[row], accel[row] = sense(plan, state, offset, False)
        if rounding == NONE:
            seen_encoder[row], seen_accel[row] = encoder[row], accel[row]
        else:
            seen_encoder[row] = math.floor(encoder[row] + 0.5)
            seen_accel[row] = math.floor(accel[row] + 0.5) if whole[1] else accel[row]
        if history.shape[0] > 0:
            for i in range(z.size):
                history[row, i] = z[i]
        if closed:
            out = 0.0
            source = row + command_row
            if source >= 0:
                target = reference[row]
                if aden.size > 0:
                    for k in range(aden.size - 1, 0, -1):
                        g[k], w[k] = g[k - 1], w[k - 1]
                    g[0] = seen_accel[source] - controller.accel_zero
                    shaped = anum[0] * g[0]
                    for k in range(1, aden.size):
                        shaped += anum[k] * g[k] - aden[k] * w[k]
                    w[0] = shaped
                    target -= shaped
                for k in range(num.size - 1, 0, -1):
                    e[k], v[k] = e[k - 1], v[k - 1]
                e[0] = target - seen_encoder[source]
                out = num[0] * e[0]
                for k in range(1, num.size):
                    out += num[k] * e[k] - den[k] * v[k]
                for k in range(feedback.size - 1, -1, -1):
                    y[k] = y[k - 1] if k > 0 and source > 0 else seen_encoder[source]
                    out -= feedback[k] * y[k]
                out = min(max(out, -controller.limit), controller.limit)
                v[0] = out
                if whole[0]:
                    out = math.floor(out + 0.5)
            command[row] = out
        further = more[0] * command[row] + more[1]
        if plain:
            advance_plain(plan, state, command[row], further)
        else:
            advance(plan, state, command[row], further, work)
    if rounding == ALL:
        for row in range(rows):
            encoder[row], accel[row] = seen_encoder[row], seen_accel[row]


@kernel()
def _law_along(law, arguments, states, x, v, w, h, out):
    for i in range(out.size):
        out[i] = call_law(law, x[i], v[i], w[i], element(arguments, 0), element(states, 0), h)


@kernel()
def _joint_along(laws, stiffness, damping, deflection, rate, out):
    for i in range(out.size):
        out[i] = _joint_torque(laws, 0, stiffness, damping, deflection[i], rate[i])


def law_along(law, arguments, states, x, v, w, h):
    """One law, by its address, along arrays (n); its states are carried from row to row."""
    out = np.empty(len(x))
    _law_along(law, arguments, states, x, v, w, h, out)
    return out


def joint_along(laws, stiffness, damping, deflection, rate):
    """Torque (n) of a joint, port 0 of ``laws``, along arrays (n), N m."""
    out = np.empty(len(deflection))
    _joint_along(laws, stiffness, damping, deflection, rate, out)
    return out


def working_room(plan):
    """What ``advance`` works in."""
    return np.zeros((6, max(plan.port_joint.size, 1)))


def run_ticks(plan, state, controller, reference, command, closed, command_row, offset, rounding, whole,
              encoder, accel, history, more=(0.0, 0.0)):
    """One whole test; writes command (where closed), encoder, accel (n) and, where asked, history (n, 2b).

    ``rounding``: NONE, ALL, or INSIDE: the compensator sees whole counts, the columns stay what was rounded.
    ``whole``: whether commands are whole counts, and whether the accelerometer's readings are.  ``more``:
    what the motor does more in this test, a share of the command and a constant (counts of command).
    """
    rows, order, accel_order = reference.size, controller.numerator.size, max(controller.accel_denominator.size, 1)
    ticks(plan, state, controller, reference, command, closed, command_row, offset, rounding, whole,
          encoder, accel, history, more, (np.zeros(rows), np.zeros(rows)), working_room(plan),
          (np.zeros(order), np.zeros(order), np.zeros(controller.feedback.size)),
          (np.zeros(accel_order), np.zeros(accel_order)))

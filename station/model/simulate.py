"""Simulate a rig: a whole run at once, or tick by tick as the simulated device does."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np

from station.control.compensators import Compensator, commanded
from station.errors import UsageError, WorkError
from station.model import stepper
from station.model.assembly import Assembly, assemble, axis_moment
from station.model.compiled import address, njit
from station.model.effects import Effect, Stage
from station.model.modal import INTEGRAL, ModalForm, apply, function, modal_form
from station.rig import Rig
from station.runs.run import Run, RunMetadata

SUBSTEP = 5e-4
"""Longest step, s, where anything acts between ticks."""
TRUNCATION = 0.01
"""Modes are left out while the sum of what they could add to either output stays below this, counts."""

PORT_SHARE = 0.02

_STAGE = {Stage.COMMAND: stepper.COMMAND, Stage.TORQUE: stepper.TORQUE, Stage.FRICTION: stepper.FRICTION,
          Stage.GAP: stepper.GAP, Stage.SPRING: stepper.SPRING, Stage.ACCEL_INPUT: stepper.ACCEL_INPUT,
          Stage.ACCEL_FILTER: stepper.ACCEL_FILTER, Stage.ACCEL_COUNTS: stepper.ACCEL_COUNTS,
          Stage.ENCODER: stepper.ENCODER}
_PORTS = ("motor", "base", "drive", "clamp")


@dataclass(frozen=True)
class Simulation:
    """What a rig does in a test: columns as in a run; counts, whole ones where rounding was asked for."""

    t: np.ndarray
    reference: np.ndarray
    command: np.ndarray
    encoder: np.ndarray
    accel: np.ndarray | None
    states: np.ndarray | None = None
    """(n, coordinates) motor, base, root, beam nodes; rad and m; only where asked for."""
    shape: np.ndarray | None = None
    """(n, elements + 1) deflection of the beam's nodes in the inertial frame, m; only where asked for."""


@dataclass(frozen=True, eq=False)
class Model:
    """A rig made ready for the stepper; independent of any run."""

    rig: Rig
    assembly: Assembly
    form: ModalForm
    plan: stepper.Plan
    per_count: np.ndarray
    """(2 b) rate of the modes per count of torque at the motor."""
    effect_states: int
    filters: int
    rings: int
    dropped: float
    """Bound of what the modes left out could add to an output, counts."""

    def __reduce__(self) -> NoReturn:
        raise TypeError("a model holds addresses of this process; send its rig")


class _Tables:
    """A rig as its linear part sees it: equal where the tables are, whatever effects it has.

    ``moving``: as its motion alone sees it, whatever drives and reads it.
    """

    def __init__(self, rig: Rig, moving: bool = False) -> None:
        self.rig, motor = rig, rig.motor
        self._key: tuple[object, ...] = (motor.inertia, motor.damping, rig.drive, rig.base, rig.clamp, rig.beam,
                                         rig.tip)
        if not moving:
            self._key += (motor.gain, rig.accelerometer, rig.amplifier, rig.encoder)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Tables) and self._key == other._key


@functools.lru_cache(maxsize=32)
def _decoupled(tables: _Tables) -> tuple[Assembly, ModalForm]:
    """Kept, since a fit moves effects on the same linear part again and again."""
    parts = assemble(tables.rig)
    return parts, modal_form(parts)


@functools.lru_cache(maxsize=32)
def _sampled(tables: _Tables, ports: tuple[str, ...], period: float, substeps: int, delay: float, truncation: float,
             ) -> tuple[Assembly, ModalForm, stepper.Plan, np.ndarray, float]:
    """The linear part with its ports, truncated and sampled: its matrices, its form, a plan without effects, what a
    count of command does, and what Model drops."""
    rig, h = tables.rig, period / substeps
    parts, whole = _decoupled(_Tables(rig, moving=True))
    n, rotations = parts.size, _rotations(parts, ports)
    inputs = np.column_stack([rig.motor.gain * parts.unit(parts.motor), *rotations])
    forces = whole.inverse[:, n:] @ np.linalg.solve(parts.mass, inputs)
    rate = whole.rates()
    fed_back = [vector for port, vector in zip(ports, rotations, strict=True) if port == "clamp"]
    keep, dropped = _truncate(rig, parts, whole, forces, rate, fed_back, period, truncation)
    form, kept, rate = whole.select(keep), whole.columns(keep), rate[:, keep]
    held, exponential = form.integral(h), form.exponential(h)
    command, torques = forces[kept, 0], forces[kept, 1:].T
    if parts.tip is None or rig.accelerometer is None:
        tip_speed, gain = np.zeros(2 * form.blocks), 0.0
    else:
        tip_speed, gain = form.basis[n + parts.tip], rig.accelerometer.gain
    whole_delay = int(delay / period + 1e-9)
    rest = max(delay - whole_delay * period, 0.0)
    switch = int(rest / h + 1e-9) if rest > 1e-9 * period else -1
    switch_time = rest - switch * h if switch >= 0 else 0.0
    port_angle = np.array([rotation @ form.basis[:n] for rotation in rotations]).reshape(-1, 2 * form.blocks)
    port_speed = np.array([rotation @ form.basis[n:] for rotation in rotations]).reshape(-1, 2 * form.blocks)
    port_held = np.array([apply(held, torque) for torque in torques]).reshape(-1, 2 * form.blocks)
    joints = [getattr(rig, port) if port in ("drive", "clamp") else None for port in ports]
    table, first, arguments, _ = slots(rig, [], ports)
    moment = axis_moment(parts, rig.motor.damping) @ form.basis
    switched = np.zeros_like(command)
    if switch >= 0:
        switched = apply(form.exponential(h - switch_time), apply(form.integral(switch_time), command))
    plan = stepper.Plan(
        substeps, h, exponential, apply(held, command), switched, switch, switch_time, whole_delay,
        np.ascontiguousarray(form.basis[parts.base]), np.ascontiguousarray(form.basis[n + parts.base]),
        _row(tip_speed, rate),
        float(tip_speed @ command), np.array([int(j is not None) for j in joints], dtype=np.int64),
        port_angle, port_speed, port_held, np.array([float(tip_speed @ torque) for torque in torques]),
        port_angle @ port_held.T, port_speed @ port_held.T,
        np.array([0.0 if j is None else j.stiffness for j in joints]),
        np.array([0.0 if j is None else j.damping for j in joints]),
        -1, -1, rig.motor.gain, rig.motor.damping, moment, port_held @ moment,
        table, first, arguments, rig.amplifier.limit, rig.beam.length if rig.beam else 0.0,
        1.0 / rig.angle_per_count, gain, 0.0, 0.0)
    return parts, form, plan, command, dropped


def build(rig: Rig, truncation: float = TRUNCATION, longest: float = SUBSTEP) -> Model:
    """Assemble, decouple, truncate and sample a rig and lay out its effects.

    ``truncation`` (counts) and ``longest`` (step, s) buy speed for accuracy.
    """
    period, delay, late = rig.period, 0.0, {Stage.ENCODER_DELAY: 0.0, Stage.ACCEL_DELAY: 0.0}
    for effect in rig.effects:
        if effect.stage is Stage.CLOCK:
            period *= next(iter(effect.values().values()))
        elif effect.stage is Stage.INPUT_DELAY:
            delay += next(iter(effect.values().values()))
        elif effect.stage in late:
            late[effect.stage] += next(iter(effect.values().values()))
    laws = sorted((e for e in rig.effects if e.stage in _STAGE), key=lambda e: (_STAGE[e.stage], e.order))
    within = bool(laws) or any(late.values())
    substeps = math.ceil(period / longest - 1e-9) if within else 1
    ports = _ports(rig, laws)
    loaded = any(by_load(rig, e) for e in laws)
    if loaded and rig.drive is None and rig.beam is not None:
        truncation = 0.0   # the moment at the beam's root is the sum of all modes
    parts, form, plan, per_count, dropped = _sampled(_Tables(rig), ports, period, substeps, delay, truncation)
    table, first, arguments, states = slots(rig, laws, ports)
    plan = plan._replace(
        load_port=ports.index("drive") if loaded and rig.drive is not None else -1,
        axis_port=ports.index("motor") if loaded and rig.drive is None else -1,
        slots=table, first=first, arguments=arguments,
        encoder_delay=late[Stage.ENCODER_DELAY] / plan.h, accel_delay=late[Stage.ACCEL_DELAY] / plan.h)
    filters = int(first[stepper.ACCEL_FILTER + 1] - first[stepper.ACCEL_FILTER])
    rings = int(max(plan.encoder_delay, plan.accel_delay)) + 3
    return Model(rig, parts, form, plan, per_count, states, filters, rings, dropped)


def by_load(rig: Rig, effect: Effect) -> bool:
    """Whether an effect's law asks for the load on the gears: friction of a drive, or of what stands for it."""
    return effect.stage is Stage.FRICTION and (effect.at == "drive" or rig.drive is None and "drive" in effect.sites)


def _row(output: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Row vector (2b) times blocks (4, b)."""
    one, two = output.reshape(2, -1)
    return np.concatenate([one * blocks[0] + two * blocks[2], one * blocks[1] + two * blocks[3]])


def _ports(rig: Rig, laws: list[Effect]) -> tuple[str, ...]:
    """Ports at which the rig's effects put torques, in fixed order."""
    wanted = set()
    for effect in laws:
        if effect.stage in (Stage.TORQUE, Stage.FRICTION):
            wanted |= {"motor", "drive"} if effect.at == "drive" else {effect.at}
        elif effect.stage in (Stage.GAP, Stage.SPRING):
            wanted.add(effect.at)
    if rig.drive is None and "base" in wanted:
        wanted = (wanted - {"base"}) | {"motor"}
    return tuple(port for port in _PORTS if port in wanted)


def _rotations(parts: Assembly, ports: tuple[str, ...]) -> list[np.ndarray]:
    """Of each port its rotation, which is, by virtual work, the generalised torque of one N m there."""
    vectors = {"motor": parts.unit(parts.motor), "base": parts.unit(parts.base),
               "drive": parts.unit(parts.motor) - parts.unit(parts.base)}
    if parts.root is not None:
        vectors["clamp"] = parts.unit(parts.base) - parts.unit(parts.root)
    return [vectors[port] for port in ports]


def _truncate(rig: Rig, parts: Assembly, form: ModalForm, forces: np.ndarray, rate: np.ndarray,
              fed_back: list[np.ndarray], period: float, allowed: float) -> tuple[np.ndarray, float]:
    """Which blocks to keep, for the others cannot matter, and what these could add to an output, counts.

    A port's torque counts as PORT_SHARE of the motor's largest.  ``forces`` (2b, 1 + ports): of one count, and of one
    N m at each port; ``rate`` (4, b): the blocks themselves.  ``fed_back``: rotations of a stiff joint at the beam's
    root; an effect acts on them and every mode of the beam yields there, so they count as outputs, in encoder counts.
    """
    n, largest = parts.size, rig.amplifier.limit * forces
    largest[:, 1:] *= PORT_SHARE * rig.motor.gain
    outputs = np.array([parts.unit(parts.base), *fed_back]) @ form.basis[:n] / rig.angle_per_count
    through = np.zeros_like(outputs)
    if parts.tip is not None and rig.accelerometer is not None:
        tip = form.basis[n + parts.tip] * rig.accelerometer.gain
        outputs, through = np.vstack([outputs, _row(tip, rate)]), np.vstack([through, tip])
    most = _bounds(form.kind, form.eigenvalues, outputs, through, largest, period)
    order = np.argsort(most)
    total = np.cumsum(most[order])
    count = int(np.searchsorted(total, allowed))
    return np.sort(order[count:]), float(total[count - 1]) if count else 0.0


@njit(cache=True)
def _bounds(kind, eigenvalues, outputs, through, largest, period):
    """(b) the most that every block could add to any output (o, 2b) by any input (2b, m), some of which it passes
    ``through`` (o, 2b) at once; infinite of a mode that nothing brings back.

    A block with the output c and the sampled response g adds at most sum_k |c e^(A k T) g|, which
    |c| |g| / (1 - |e^(lambda T)|) bounds.
    """
    most, held, b = np.zeros(kind.size), function(kind, eigenvalues, INTEGRAL, period), kind.size
    for i in range(b):
        one, other = eigenvalues[i]
        decay = max(1.0 - math.exp(max(one.real, other.real) * period), 1e-12)
        for k in range(largest.shape[1]):
            first, second = largest[i, k], largest[b + i, k]
            response = math.hypot(held[0, i] * first + held[1, i] * second, held[2, i] * first + held[3, i] * second)
            for c in range(len(outputs)):
                bound = math.hypot(outputs[c, i], outputs[c, b + i]) * response / decay
                most[i] = max(most[i], bound + abs(through[c, i] * first + through[c, b + i] * second))
        if min(abs(one), abs(other)) == 0.0:
            most[i] = np.inf
    return most


def slots(rig: Rig, laws: list[Effect], ports: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Effects, in the order of their stages, as a plan holds them (slots, first, arguments), and their states."""
    rows: list[tuple[int, int, int, int, int]] = []
    arguments: list[float] = []
    states = 0
    counts = np.zeros(stepper.STAGES, dtype=np.int64)
    for effect in laws:
        place, side = effect.at, -1 if effect.at == "base" else 1
        if effect.stage is Stage.FRICTION and place == "drive":
            place = "motor"
        if place == "base" and "base" not in ports:
            place = "motor"
        port = ports.index(place) if place in ports else -1
        rows.append((port, address(type(effect).law), len(arguments), states, side))
        arguments += effect.arguments(rig)
        states += effect.states
        counts[_STAGE[effect.stage]] += 1
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return (np.array(rows, dtype=np.int64).reshape(-1, 5), first, np.array([*arguments, 0.0], dtype=float), states)


def initial_state(model: Model, start_angle: float = 0.0, zero: float = 0.0, *, equilibrium: bool = False,
                  gap_place: float = 0.0) -> stepper.State:
    """State at sample 0.

    Released (the default): at rest, springs relaxed, every rotation at ``start_angle`` (rad, encoder zero at 0).
    Equilibrium: springs carry the constant torques of the angle and of command 0; filters and lags are settled.
    ``zero`` (rad) is the absolute angle of encoder count 0; ``gap_place`` in [-1, 1] the motor's place in a gap.
    """
    plan, parts = model.plan, model.assembly
    q = start_angle * parts.rigid
    gap = sum(e.values()["gap"] for e in model.rig.effects if e.stage is Stage.GAP)
    if parts.motor != parts.base:
        q[parts.motor] += 0.5 * gap * gap_place
    z = model.form.inverse @ np.concatenate([q, np.zeros(parts.size)])
    state = stepper.State(
        z, np.zeros(plan.port_joint.size), np.zeros(model.effect_states + 1), np.zeros(plan.whole_delay + 2),
        np.zeros(model.rings), np.zeros(model.rings), np.zeros(3, dtype=np.int64), np.zeros(3 + model.filters))
    state.last[2] = zero
    if equilibrium:
        _balance(model, state, q)
    return state


def _balance(model: Model, state: stepper.State, q: np.ndarray) -> None:
    """Settle lags on command 0 and let the drive carry the base's constant torque to a motor that is held."""
    rig, parts, zero = model.rig, model.assembly, state.last[2]
    count = 0.0
    first_state = 0
    no_state = [0.0]
    for effect in sorted((e for e in rig.effects if e.stage is Stage.COMMAND), key=lambda e: e.order):
        if effect.states:
            state.effects[first_state] = count
        else:
            count = type(effect).law(count, 0.0, rig.amplifier.limit, effect.arguments(rig), no_state, 0.0)
        first_state += effect.states
    state.last[0] = count
    if rig.drive is None:
        return
    torque = sum(type(e).law(q[parts.base] + zero, 0.0, 0.0, e.arguments(rig), no_state, model.plan.h)
                 for e in rig.effects if e.stage is Stage.TORQUE and e.at == "base")
    if torque:
        q = q.copy()
        q[parts.motor] -= torque / rig.drive.stiffness
        state.z[:] = model.form.inverse @ np.concatenate([q, np.zeros(parts.size)])


def limit_of(rig: Rig, metadata: RunMetadata) -> float:
    """What cuts a loop's command (counts) in a run's test on a rig: the rig's limit, or the run's own if less."""
    return min(rig.command_limit, metadata.command_limit or rig.command_limit)


def controller_arrays(spec: dict, rig: Rig, accel_zero: float = 0.0, limit: float | None = None) -> stepper.Controller:
    """A run's controller as the stepper takes it; an unknown one is none: the commands are taken as logged.

    ``limit`` (counts) of its commands is the rig's by default.
    """
    return _controller_arrays(json.dumps(spec), rig.sample_rate, limit or rig.command_limit, accel_zero)


@functools.lru_cache(maxsize=64)
def _controller_arrays(text: str, sample_rate: float, limit: float, accel_zero: float) -> stepper.Controller:
    spec = json.loads(text)
    if commanded(spec):
        spec = {"kind": "open"}
    comp = Compensator.from_spec(spec, sample_rate, limit)
    order = max(comp.numerator.size, comp.denominator.size)
    num, den = np.zeros(order), np.zeros(order)
    num[: comp.numerator.size], den[: comp.denominator.size] = comp.numerator, comp.denominator
    return stepper.Controller(comp.open_loop, num, den, comp.accel_numerator, comp.accel_denominator,
                              float(spec.get("accel_zero", accel_zero)), comp.feedback, limit)


def simulate_model(model: Model, run: Run, *, rounding: bool | Literal["inside"] = True, start_angle: float = 0.0,
                   zero: float = 0.0, accel_offset: float = 0.0, gap_place: float = 0.0,
                   states: bool = False, more: tuple[float, float] = (0.0, 0.0)) -> Simulation:
    """As ``simulate``, with a rig that has been built.

    ``more``: what the motor does more in this run, a share of the command and a constant (counts of command).

    ``rounding`` "inside" rounds what the compensator sees and sends, but returns what was rounded.  WorkError: the
    run's controller is none that there is, or reads a sensor that the rig has not.
    """
    inside = stepper.INSIDE if rounding == "inside" else (stepper.ALL if rounding else stepper.NONE)
    meta, rig = run.metadata, model.rig
    state = initial_state(model, start_angle, zero, equilibrium=meta.start == "equilibrium", gap_place=gap_place)
    try:
        controller = controller_arrays(meta.controller, rig, meta.accel_zero, limit_of(rig, meta))
    except UsageError as error:
        raise WorkError(f"{run.name}: metadata {error}; where the log's controller is none of the kinds, leave it "
                        "out") from None
    if rig.accelerometer is None and controller.accel_numerator.any():
        raise WorkError(f"{run.name}: its controller reads an accelerometer, and rig {rig.name} has none")
    rows = len(run.t)
    reference = np.ascontiguousarray(run.reference, dtype=float)
    closed = not controller.open_loop
    command = np.zeros(rows) if closed else np.array(run.command, dtype=float)
    encoder, accel = np.zeros(rows), np.zeros(rows)
    history = np.zeros((rows if states else 0, state.z.size))
    stepper.run_ticks(model.plan, state, controller, reference, command, closed, meta.command_row, accel_offset,
                      inside, bool(inside) and meta.rounding, encoder, accel, history, more)
    shape = full = None
    if states:
        full = history @ model.form.basis[: model.assembly.size].T
        if model.assembly.nodes.size:
            shape = np.concatenate([np.zeros((rows, 1)), full[:, model.assembly.nodes]], axis=1)
    return Simulation(run.t, reference, command, encoder, accel if rig.accelerometer is not None else None, full, shape)


def simulate(rig: Rig, run: Run, *, rounding: bool = True, start_angle: float | None = None, zero: float = 0.0,
             accel_offset: float = 0.0, gap_place: float = 0.0, states: bool = False) -> Simulation:
    """Simulate a run's test on a rig.

    A closed loop runs from the run's reference with its own compensator on the model's own outputs, an open loop and
    one whose controller is not known from the run's command.  ``start_angle`` (rad) defaults to the run's first encoder
    reading, ``accel_offset`` is in counts, ``zero`` the absolute angle of encoder count 0.  Without ``rounding``
    outputs stay real numbers.  The beam is meshed as ``Rig.meshed`` says.
    """
    if start_angle is None:
        start_angle = float(run.encoder[0]) * rig.angle_per_count
    return simulate_model(build(rig.meshed()), run, rounding=rounding, start_angle=start_angle, zero=zero,
                          accel_offset=accel_offset, gap_place=gap_place, states=states)


class Plant:
    """A rig one tick at a time: read the sensors, then hold a command to the next tick."""

    def __init__(self, rig: Rig, start_angle: float = 0.0, accel_offset: float = 0.0) -> None:
        self.model = build(rig.meshed())
        self._state = initial_state(self.model, start_angle)
        self._offset = accel_offset
        self._work = np.zeros((4, max(self.model.plan.port_joint.size, 1)))
        self._out = np.zeros(2)
        # One tick of another state: what compiles on a fresh machine does so now, not while a host waits for a sample.
        spare = initial_state(self.model, start_angle)
        stepper.begin(self.model.plan, spare)
        stepper.tick(self.model.plan, spare, 0.0, accel_offset, True, self._work, np.zeros(2))
        stepper.begin(self.model.plan, self._state)
        self._out[:] = stepper.sense(self.model.plan, self._state, accel_offset, True)

    def sample(self) -> tuple[int, int]:
        """Encoder and accelerometer at this tick, whole counts."""
        return int(self._out[0]), int(self._out[1])

    def advance(self, command: float, accel_noise: float = 0.0) -> None:
        """Hold a command (counts) for one period; ``accel_noise`` (counts) joins the next reading before rounding."""
        stepper.tick(self.model.plan, self._state, float(command), self._offset + accel_noise, True, self._work,
                     self._out)

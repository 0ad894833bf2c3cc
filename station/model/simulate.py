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
from station.model.compiled import address
from station.model.effects import Effect, Stage
from station.model.sampled import Linear, linear
from station.rig import Rig
from station.runs.run import Run, RunMetadata

SUBSTEP = 5e-4
"""Longest step, s, where anything acts between ticks."""
TRUNCATION = 0.01
"""Modes are left out while the sum of what they could add to either output stays below this, counts."""

_STAGE = {Stage.COMMAND: stepper.COMMAND, Stage.TORQUE: stepper.TORQUE, Stage.FRICTION: stepper.FRICTION,
          Stage.GAP: stepper.GAP, Stage.SPRING: stepper.SPRING, Stage.ACCEL_INPUT: stepper.ACCEL_INPUT,
          Stage.ACCEL_FILTER: stepper.ACCEL_FILTER, Stage.ACCEL_COUNTS: stepper.ACCEL_COUNTS,
          Stage.ENCODER: stepper.ENCODER}
_BETWEEN = (Stage.TORQUE, Stage.FRICTION, Stage.GAP, Stage.SPRING, Stage.ACCEL_FILTER)
"""Stages whose laws act between ticks, as those of the others do where they have states; else a command is held, and
sensors are read at ticks alone."""
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
class Model(Linear):
    """A rig made ready for the stepper; independent of any run."""

    rig: Rig
    plan: stepper.Plan
    effect_states: int
    filters: int
    rings: int

    def __reduce__(self) -> NoReturn:
        raise TypeError("a model holds addresses of this process; send its rig")


def build(rig: Rig, truncation: float = TRUNCATION, longest: float = SUBSTEP,
          beside: Model | None = None) -> Model:
    """Assemble, decouple, truncate and sample a rig and lay out its effects.

    ``truncation`` (counts) and ``longest`` (step, s) buy speed for accuracy.  ``beside``: a rig that may be near;
    where it is, the modes are told to first order in what is between them.
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
    within = any(e.stage in _BETWEEN or e.states for e in laws) or any(late.values())
    substeps = math.ceil(period / longest - 1e-9) if within else 1
    ports = _ports(rig, laws)
    loaded = any(e.by_load(rig, e.at) for e in laws)
    if loaded and rig.drive is None and rig.beam is not None:
        truncation = 0.0   # the moment at the beam's root is the sum of all modes
    h = period / substeps
    whole_delay = int(delay / period + 1e-9)
    rest = max(delay - whole_delay * period, 0.0)
    switch = int(rest / h + 1e-9) if rest > 1e-9 * period else -1
    switch_time = rest - switch * h if switch >= 0 else 0.0
    found, arrays = linear(rig, ports, h, substeps, switch_time, truncation, beside)
    joints = [getattr(rig, port) if port in ("drive", "clamp") else None for port in ports]
    table, first, arguments, states = slots(rig, laws, ports)
    plan = stepper.Plan(
        **arrays, substeps=substeps, h=h, switch=switch, switch_time=switch_time,
        whole_delay=whole_delay, port_joint=np.array([int(j is not None) for j in joints], dtype=np.int64),
        joint_stiffness=np.array([0.0 if j is None else j.stiffness for j in joints]),
        joint_damping=np.array([0.0 if j is None else j.damping for j in joints]),
        load_port=ports.index("drive") if loaded and rig.drive is not None else -1,
        axis_port=ports.index("motor") if loaded and rig.drive is None else -1,
        motor_gain=rig.motor.gain, back_emf=rig.motor.electrical_damping, slots=table, first=first, arguments=arguments,
        limit=rig.amplifier.limit, length=rig.beam.length if rig.beam else 0.0,
        counts_per_radian=1.0 / rig.angle_per_count,
        encoder_delay=late[Stage.ENCODER_DELAY] / h, accel_delay=late[Stage.ACCEL_DELAY] / h)
    filters = int(first[stepper.ACCEL_FILTER + 1] - first[stepper.ACCEL_FILTER])
    rings = int(max(plan.encoder_delay, plan.accel_delay)) + 3
    return Model(**vars(found), rig=rig, plan=plan, effect_states=states, filters=filters, rings=rings)


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
                      inside, (bool(inside) and run.rounded, run.step("accel") == 1.0), encoder, accel, history, more)
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
        self._work = stepper.working_room(self.model.plan)
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

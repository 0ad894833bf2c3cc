"""Observers whose memory is a given time: what makes a simulation a prediction that far ahead.

A steady Kalman filter of the linear rig, fed by the encoder alone, that takes what it missed for a torque at the motor
(Gauss-Markov, with the horizon as its correlation time).  The torque's size, the one number left, is chosen so that a
wrong angle is forgotten after the horizon: the integral over time of what a unit error of the angle leaves equals it.

Two horizons are looked at.  The quick one tells what a torque does at once: it is the memory of the observer for which
the torque is as large as what models of rigs lack (``UNMODELLED``), so the finer an encoder, the shorter it is.  An
infinite horizon is the simulation driven by the logged command (output error).  Ljung, System Identification (2nd ed.,
1999), sections 3.2 (k-step-ahead predictors), 4.3 (innovations form) and 13.4 (direct method).

Every rig that is simulated has its own (the gain is a function of the parameters: Ljung, section 4.3), with the same
horizon.  With gains of the nominal rig a hypothesis would win by what it makes of them: with a rigid drive in place of
a soft one the same gains forget after three fifths of the time, and errors that are predicted less far ahead are
smaller whatever the cause.  So the linear rig is the one about its motion (``slopes``): torques that its effects put
on the motor and the base as functions of the speed are in it by their slopes, and joints with play or a spring of
another law by the stiffness that comes nearest.  Or a drag that is viscous for all that the runs do would win over the
damping that it is, and a spring that is softer in the middle over a play.  What torques change with the angle is no
matter within the quick horizon, and a pendulum's weight, which holds where it hangs and topples where it stands, has no
one slope.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from station.estimation.filter import (
    SIZES,
    SLOPE,
    Filter,
    Slopes,
    designed,
    fed_back,
    filter_of,
    forgets_within,
    log_memory,
    speeds,
    true_period,
)
from station.estimation.noise import QUANTISATION
from station.model.along import equivalent_stiffness, law_values, part_of
from station.model.effects import Stage
from station.model.modal import ModalForm, apply
from station.model.simulate import Model, build
from station.rig import Rig

UNMODELLED = 1.0 / 300.0
"""Size of a torque that a rig's model may lack, as a share of the amplifier's limit: a fiftieth of what its tests
command, which is about a sixth of the limit (root mean square)."""
QUICKEST, SLOWEST = 3.0, 0.5
"""Shortest horizon, in samples, and longest, s, that it may ask for: an observer of an angle, a speed and a torque
needs three samples to forget, and after half a second a prediction reads what a whole run reads."""
ROUNDS = 40
"""Halvings of the logarithm of the torque's size, for the nominal rig."""
FASTEST = 20.0, 1000.0
"""Over the horizon, and rad/s: of the nominal rig the modes that decay or swing faster than both are not corrected."""
SMALL = 1e-3
"""Of the speeds, the step by which a torque's slope is told."""


@dataclass(frozen=True)
class Observer:
    """How far ahead is predicted, and what an observer of that memory must know beside the rig."""

    horizon: float
    variance: float = QUANTISATION
    """Of a reading of the encoder, counts^2."""
    blocks: int = 0
    """How many of a rig's modes, the slowest, are corrected."""
    log_size: float = 0.0
    """Logarithm of the torque's size (counts of command) that gives a rig this horizon: the nominal one, or one that is
    near to those to come (``near``)."""
    slope: float = SLOPE
    """Change of the memory's logarithm by that, there."""

    def near(self, model: Model, about: Slopes = ()) -> Observer:
        """The same, quicker to work out for rigs like this one."""
        found = _design(self, _Linear(id(model.form), model, about))[1]
        return self if found is None else replace(self, log_size=found[0], slope=found[1])


class Correction(NamedTuple):
    """What one count of the encoder's prediction error changes in a simulation."""

    state: np.ndarray
    """(2 b) modal coordinates."""
    torque: float
    """Disturbance, counts of command."""
    decay: float
    """Of the disturbance from one sample to the next."""
    late: np.ndarray
    """(m) rad, angles that the encoder has yet to show: at the present instant, a step before, and so on."""


@dataclass(frozen=True)
class _Linear:
    """A model as its linear part sees it: equal where that is."""

    form: int
    """Its identity, which is no other's while the model is kept."""
    model: Model = field(compare=False)
    slopes: Slopes


def slopes(rig: Rig, motion: np.ndarray, carried: Mapping[str, np.ndarray] | None = None) -> Slopes:
    """What a rig's torques change about a motion.

    Of those on a part the mean derivative by the speed over ``motion`` (m, 2), angles (rad) and speeds (rad/s) that
    weigh alike (statistical linearisation: Booton, Proc. Symp. Nonlinear Circuit Analysis, 1953); of a joint with play
    or another spring what its ``equivalent_stiffness`` is more, where it carries torques (m), N m, by joint.
    """
    laws = [effect for effect in rig.effects if effect.stage is Stage.TORQUE] if len(motion) else []
    (x, v), step = motion.T, SMALL * float(np.sqrt(np.mean(motion[:, 1] ** 2))) if laws else 0.0
    found = [(part_of(rig, one), float(np.mean(law_values(rig, one, x, v + step) - law_values(rig, one, x, v - step)))
              / (2.0 * step)) for one in laws]
    sprung = {effect.at for effect in rig.effects if effect.stage in (Stage.GAP, Stage.SPRING)}
    found += [(at, equivalent_stiffness(rig, at, torque) - getattr(rig, at).stiffness)
              for at, torque in (carried or {}).items() if at in sprung]
    return tuple((at, change) for at, change in found if change != 0.0)


@functools.lru_cache(maxsize=64)
def correction(observer: Observer, model: Model, about: Slopes = ()) -> Correction:
    """What one count of error changes in a rig's simulation, the same for all its runs; not finite where a rig has no
    such observer.  ``about``: the slopes of its torques where it moves (``slopes``).

    An encoder that is late shows what was to be corrected then: it is carried forward to now, by the rig without its
    effects, and so are the readings that have not been shown.  Or a late encoder would be a worse observer than a late
    command that does the same.
    """
    at_once = _design(observer, _Linear(id(model.form), model, about))[0]
    plan, form, period, decay = model.plan, model.form, true_period(model), at_once.decay
    if plan.encoder_delay == 0.0 or at_once.torque == 0.0:
        return at_once
    delay, count = plan.encoder_delay, model.per_count

    def carried(z: np.ndarray, torque: float, time: float) -> np.ndarray:
        return apply(form.exponential(time), z) + torque * apply(form.integral(time), count)

    begun = [(at_once.state, decay * at_once.torque)]     # what it has become when each period begins
    for _ in range(int(delay / plan.substeps)):
        z, torque = begun[-1]
        begun.append((carried(z, torque, period), decay * torque))

    def after(steps: float) -> np.ndarray:
        whole = int(steps / plan.substeps)
        return carried(*begun[whole], (steps - whole * plan.substeps) * plan.h)

    late = [float(plan.base_angle @ after(delay - k)) for k in range(int(delay) + 1)]
    return Correction(after(delay), at_once.torque * decay ** (delay / plan.substeps), decay, np.array(late))


@functools.lru_cache(maxsize=128)
def _design(observer: Observer, linear: _Linear) -> tuple[Correction, tuple[float, float] | None]:
    """A rig's correction, and (log size, slope) there, None where there is none."""
    model, form, horizon = linear.model, linear.model.form, observer.horizon
    state = np.zeros(2 * form.blocks)
    if math.isinf(horizon):
        return Correction(state, 0.0, 0.0, np.zeros(0)), None
    slowest = _corrected(observer, form)
    system, kept = filter_of(model, horizon, slowest, linear.slopes), form.columns(slowest)
    gain, log_size, slope = designed(system, observer.variance, horizon, observer.log_size, observer.slope)
    state[kept] = gain[:-1]
    found = Correction(state, float(gain[-1]), system.decay, np.zeros(0))
    return found, (float(log_size), float(slope)) if np.isfinite(gain).all() else None


def noise_gain(observer: Observer, model: Model, about: Slopes = ()) -> float:
    """Mean square of the errors of predictions into which white noise of the encoder, of variance one, is fed back."""
    return fed_back(*_at_work(observer, model, about), observer.horizon)[0]


def torque_gains(observer: Observer, model: Model, about: Slopes = ()) -> tuple[float, float]:
    """The share that an observer's torque is of one that acts and stays, and its mean square by white noise of the
    encoder, of variance one.

    The torque fades with the horizon, so that angle and speed are corrected, too.  With x what an observer has wrong of
    the rig's state before a reading, and F, b, h, K the rig's, its input's, its encoder's and the observer's:
    d = phi k/(1 - phi) h x stays where x = F (I - K h) x + b (1 - d).
    """
    system, gain = _at_work(observer, model, about)
    f, b, h, stays = system.f[:-1, :-1], system.enters[:-1], system.h[:-1], system.decay / (1.0 - system.decay)
    wrong = np.linalg.solve(np.eye(len(b)) - f + np.outer(f @ gain[:-1] + stays * gain[-1] * b, h), b)
    return float(stays * gain[-1] * (h @ wrong)), fed_back(system, gain, observer.horizon)[1]


def _at_work(observer: Observer, model: Model, about: Slopes) -> tuple[Filter, np.ndarray]:
    """An observer's filter of a rig, and its gain (s)."""
    slowest = _corrected(observer, model.form)
    found = _design(observer, _Linear(id(model.form), model, about))[0]
    return (filter_of(model, observer.horizon, slowest, about),
            np.append(found.state[model.form.columns(slowest)], found.torque))


def _corrected(observer: Observer, form: ModalForm) -> np.ndarray:
    """The modes that an observer corrects, in the order of the form."""
    return np.sort(np.argsort(speeds(form), kind="stable")[: observer.blocks])


def observers(rig: Rig, noise: float, horizons: Sequence[float] | None = None) -> tuple[Observer, ...]:
    """One for each horizon (s), or for the quick one and whole runs (one between them reads what whole runs read: where
    a loop is closed their slopes correlate by 0.9, and what counts twice makes causes that are not there look likely).

    ``noise``: standard deviation of the encoder before rounding, counts.
    """
    linear = rig.with_effects([]).model_copy(update={"uncertainty": {}}).model_dump_json()
    variance = noise**2 + QUANTISATION
    asked = (_quick(linear, variance), math.inf) if horizons is None else horizons
    return tuple(_observer(linear, variance, horizon) for horizon in asked)


@functools.lru_cache(maxsize=64)
def _quick(linear: str, variance: float) -> float:
    """Seconds: memory of the observer that takes what it missed for a torque of ``UNMODELLED``, or for one so much less
    that more would still make it quicker by half of what it does to a double integrator's."""
    rig = Rig.model_validate_json(linear)
    model, limit = build(rig, 0.1, 1e-3), math.log(rig.amplifier.limit)

    def forgets(log_horizon: float) -> bool:
        horizon = math.exp(log_horizon)
        system = filter_of(model, horizon, _slowest(model, horizon))
        sizes = limit + np.arange(math.log(UNMODELLED), SIZES[0], -1.0)
        return any(forgets_within(system, variance, horizon, size) and quickens(system, horizon, size)
                   for size in sizes.tolist())

    def quickens(system: Filter, horizon: float, log_size: float) -> bool:
        """Whether a larger torque makes an observer quicker; a fine encoder's may ring by less than models lack."""
        slow, quick = (log_memory(system, variance, horizon, log_size + step) for step in (-0.5, 0.5))
        return quick - slow < 0.5 * SLOPE

    return math.exp(_crossing(forgets, math.log(QUICKEST * rig.period), math.log(SLOWEST)))


def _crossing(beyond: Callable[[float], bool], low: float, high: float) -> float:
    """From where on something is true, by bisection."""
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if beyond(middle) else (middle, high)
    return high


def _slowest(model: Model, horizon: float) -> np.ndarray:
    """The modes that are corrected, the slowest first."""
    fast = speeds(model.form)
    return np.argsort(fast, kind="stable")[: max(int(np.sum(fast < max(FASTEST[0] / horizon, FASTEST[1]))), 1)]


@functools.lru_cache(maxsize=64)
def _observer(linear: str, variance: float, horizon: float) -> Observer:
    """Of a rig as JSON; kept, since a diagnosis asks for the same ones again and again."""
    if math.isinf(horizon):
        return Observer(horizon, variance)
    rig = Rig.model_validate_json(linear)
    model = build(rig, 0.1, 1e-3)
    slowest = _slowest(model, horizon)
    forgets = functools.partial(forgets_within, filter_of(model, horizon, slowest), variance, horizon)
    sizes = np.arange(*SIZES) + math.log(rig.amplifier.limit)
    above = next((size for size in sizes[1:].tolist() if forgets(size)), float(sizes[-1]))
    log_size = _crossing(forgets, above - 1.0, above)
    return Observer(horizon, variance, slowest.size, log_size).near(model)

"""What a fit says of the rig and of the sizes of causes: values, 95 % intervals, and the rig that is handed back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import stdtrit

from station.diagnose.result import Estimate
from station.diagnose.thresholds import VARIES
from station.estimation.cause import Key, constant, constant_path, is_constant
from station.estimation.fitted import Fit
from station.estimation.identifiability import NORMAL, parameter_states
from station.estimation.noise import QUANTISATION
from station.estimation.parameters import Coordinate
from station.estimation.spread import Spread, between_runs, shared
from station.model.units import UNITS
from station.rig import MAX_SIGMA, Rig

MOTOR_GAIN = "motor.gain"
"""What is one with a share of the command by which the motor does more in all runs."""
SEVERAL = 3
"""Runs from which on their scatter widens an interval."""


def may_be_none(found: Fit, key: Key, values: dict[str, Estimate]) -> bool:
    """Whether a cause's own 95 % intervals (``estimates``) hold that it is not there: a constant's the value of the rig
    file, those of all sizes of an effect the neutral one, or one the infinite one (a drag that levels off nowhere).

    Of a size x that is fitted by its logarithm it is the interval of x itself, x (1 +- 1.96 sigma), to first order
    (Wald's test: Trans. Am. Math. Soc. 54, 1943): one of its logarithm never reaches neutral.
    """
    if is_constant(key[0]):
        return values["value"].low <= found.space.rig.stated(constant_path(key[0])) <= values["value"].high

    def holds_none(coordinate: Coordinate) -> bool:
        size = values[coordinate.name]
        if coordinate.log:
            return not size.low > 0.0 or math.log(size.high / size.low) >= 2.0
        return size.low <= coordinate.info.neutral <= size.high

    sizes = [one for one in found.space.coordinates if one.cause == key and one.info.neutral is not None]
    finite = [one for one in sizes if math.isfinite(one.info.neutral)]
    return any(holds_none(one) for one in sizes if one not in finite) or bool(finite) and all(map(holds_none, finite))


def common_gain(found: Fit) -> float:
    """How many times the motor does what a fit's constants say in all runs alike; 1 where that may be chance, or the
    rig file calls its gain exact.

    Of a gain that is wrong in all of a few runs each may be given its own; but what they share is no difference, it is
    the rig's.
    """
    shares = found.own[:, 2]
    exact = float(found.space.rig.log_covariance([MOTOR_GAIN])[0, 0]) == 0.0
    return 1.0 if found.alone or exact or shared(shares) < VARIES else 1.0 + float(np.mean(shares))


def rig_of(found: Fit) -> Rig:
    """The rig that a fit describes, with what the motor does in all runs alike."""
    rig = found.space.rig_at(found.x)
    return rig.with_constants({MOTOR_GAIN: common_gain(found) * rig.motor.gain})


def estimates(found: Fit, rougher: Fit, left_out: Sequence[Fit], *, student: bool = True,
              ) -> tuple[dict[Key, dict[str, Estimate]], dict[str, Estimate]]:
    """Fitted parameters of each cause, and the rig's constants, with 95 % intervals.

    A cause's parameters are known no better than runs agree in them (``spread``), nor than they stay where they are
    when run after run is left out (``left_out``: R fits, one without each): by the jackknife their variance is at least
    (R - 1)/R sum (x_r - mean)^2, whatever the errors are like (Efron and Stein, Ann. Stat. 9, 1981), itself known to
    R - 1 degrees of freedom (Student's t in place of the normal: Tukey, Ann. Math. Stat. 29, 1958, p. 614), unless not
    to be widened by it (``student``).
    A level at which readings stand still is known no better than their one rounding error, uniform over a count.
    ``rougher``: the same set fitted with coarser simulations; how far it lies from ``found`` is what the simulation's
    own steps leave uncertain, and is added to the variance.
    """
    space, covariance, shift = found.space, found.covariance, found.x - rougher.x
    found_states = parameter_states(space, covariance, found.x)
    n = len(space.paths)
    nominal, logs = space.rig.constants(), space.logs(found.x)
    without = np.array([one.x for one in left_out if one.x.size == space.size])

    def jackknife(direction: np.ndarray) -> float:
        values = without @ direction if len(without) >= SEVERAL else np.zeros(1)
        wider = float(stdtrit(max(len(values) - 1, 1), 0.975)) / NORMAL if student else 1.0
        return wider * math.sqrt((len(values) - 1) * float(np.var(values)))
    log_sd = np.sqrt(np.diag(space.root @ covariance[:n, :n] @ space.root.T) + (space.root @ shift[:n]) ** 2)
    constants = {}
    for i, path in enumerate(space.paths):
        value, deviation, between = nominal[path] * math.exp(logs[i]), log_sd[i], None
        value *= common_gain(found) if path == MOTOR_GAIN else 1.0
        if path in space.hypothesis.constants:
            seen = _between(found, space.along_log(path))
            own = space.root[i] @ seen.covariance[:n, :n] @ space.root[i]
            own = max(math.sqrt(own), jackknife(np.append(space.root[i], np.zeros(space.size - n))))
            deviation, between = math.hypot(own, space.root[i] @ shift[:n]), _told(seen, value)
        times = math.exp(NORMAL * deviation)
        least, most = sorted((value / times, value * times))
        constants[path] = Estimate(value=value, low=least, high=most, unit=UNITS[path],
                                   state=found_states[i], spread=between)

    def of_held(path: str) -> Estimate:
        k, direction = space.at_held(path), space.along_log(path)
        one, seen = space.held[k - space.parts["held"].start], _between(found, direction)
        deviation = math.hypot(max(math.sqrt(seen.covariance[k, k]), jackknife(np.eye(space.size)[k])), shift[k])
        value, low, high = (one.value(float(found.x[k] + s * NORMAL * deviation)) for s in (0.0, -1.0, 1.0))
        unit = space.rig.effects[one.effect].parameters()[one.name].unit
        return Estimate(value=value, low=low, high=high, unit=unit, state=found_states[k],
                        spread=_told(seen, 1.0 if one.angle else value))

    causes: dict[Key, dict[str, Estimate]] = {}
    for k, coordinate in enumerate(space.coordinates, space.parts["effects"].start):
        direction = np.eye(space.size)[k]
        seen = _between(found, direction)
        per_step = abs(coordinate.to_value(found.x[k])) if coordinate.log else coordinate.scale
        rounding = math.sqrt(QUANTISATION) / per_step if coordinate.info.rounded else 0.0
        deviation = math.hypot(max(math.sqrt(seen.covariance[k, k]), jackknife(direction)), shift[k], rounding)
        low, high = (float(coordinate.to_value(found.x[k] + s * NORMAL * deviation)) for s in (-1.0, 1.0))
        if coordinate.info.periodic and NORMAL * deviation * coordinate.scale >= math.pi:
            low, high = -math.pi, math.pi
        causes.setdefault(coordinate.cause, {})[coordinate.name] = Estimate(
            value=float(coordinate.to_value(found.x[k])), low=low, high=high, unit=coordinate.info.unit,
            state=found_states[k], spread=None if coordinate.info.periodic else _told(seen, per_step))
    for path in space.hypothesis.constants:
        causes[constant(path)] = {"value": constants[path] if path in constants else of_held(path)}
    return causes, constants


def with_sizes(rig: Rig, values: Mapping[Key, Mapping[str, Estimate]]) -> Rig:
    """The rig that states how surely the sizes of its effects are known: what comes later (a fit, a diagnosis of other
    runs) may move them within that.

    One sigma of the logarithm (of an angle: rad), a 95 % interval over twice NORMAL; of an effect at two places, for
    which a rig file has one name, the larger.  A size without end is stated as it is.
    """
    sigmas: dict[str, float] = {}
    for effect in rig.effects:
        for name, size in values.get((effect.name, effect.at), {}).items():
            width = size.high - size.low
            if not type(effect).parameters()[name].periodic and size.value:
                one_sign = size.low * size.high > 0.0
                width = abs(math.log(size.high / size.low)) if one_sign else width / abs(size.value)
            path = f"{effect.name}.{name}"
            if math.isfinite(width):
                sigmas[path] = max(sigmas.get(path, 0.0), min(width / (2.0 * NORMAL), MAX_SIGMA))
    return rig.model_copy(update={"uncertainty": {**rig.uncertainty, **sigmas}})


def _between(found: Fit, direction: np.ndarray) -> Spread:
    """How the runs differ along a direction (p) of x; of fewer than three nothing is said."""
    if len(found.squares) < SEVERAL:
        return Spread(0.0, 0.0, found.covariance)
    return between_runs(found, direction)


def _told(seen: Spread, unit: float) -> float | None:
    """The spread in the value's unit, where the runs say that they differ; ``unit``: the value's change per step of x.
    """
    return float(seen.size * unit) if seen.gained > VARIES else None

"""Compensators: continuous transfer functions, sampled by Tustin, run as difference equations.

A controller is described by a small dictionary (the ``controller`` of a run or a plan):

====================  ==========================================================================
``{"kind": "open"}``  the reference is the command
``p``                 ``gain``: v = gain (r - y)
``lead``              ``gain, zero, pole``: gain (s + zero)/(s + pole) on r - y
``lead_accel``        lead on r - Ga(z) (a - accel_zero) - y, with ``accel_numerator`` and
                      ``accel_denominator``, polynomials in z, highest power first
``pid``               ``gain, integral, derivative, filter`` (1/s, s, s): gain (1 + integral/s
                      + derivative s/(filter s + 1)) on r - y; 0 leaves a term out
``cascade``           ``position_gain, speed_gain``: speed_gain (position_gain (r - y) - y'),
                      y' by backward difference, 0 at the first reading
``filter``            ``numerator, denominator``, polynomials in z, highest power first, on r - y
``unknown``           nothing is known but the commands: a log's, not one that can be run
====================  ==========================================================================

The pid is the standard form with a filtered derivative (Astrom & Hagglund, Advanced PID Control, 2006, ch. 3).  The
recursion runs on its own output after the limit and before rounding, as the laboratory's program did
(confirmed by replaying its logs).  So an integral does not wind up; but what the limit cuts off of a derivative's kick
is lost to the integral too, and drives the other way: gain (1 + derivative/filter) times a step of the reference should
stay within the limit.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from station.errors import UsageError

_FIELDS = {
    "open": (),
    "p": ("gain",),
    "lead": ("gain", "zero", "pole"),
    "lead_accel": ("gain", "zero", "pole", "accel_numerator", "accel_denominator"),
    "pid": ("gain", "integral", "derivative", "filter"),
    "cascade": ("position_gain", "speed_gain"),
    "filter": ("numerator", "denominator"),
    "unknown": (),
}
_OPTIONAL = {"rounding", "accel_zero"}
_SHOWN = 6
"""Keys that a message names."""
_LISTS = {"numerator", "denominator", "accel_numerator", "accel_denominator"}


def commanded(spec: dict[str, Any]) -> bool:
    """Whether a simulation takes a run's commands as logged: where no loop is closed, or by what is not known."""
    return spec.get("kind") in ("open", "unknown")


def tustin_lead(gain: float, zero: float, pole: float, sample_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample gain (s + zero)/(s + pole) by Tustin: s = 2 f (z - 1)/(z + 1).

    Returns numerator and denominator in z, highest power first, the denominator monic.  The closed form is
    that of ``control.sample_system(..., method="tustin")``; a test holds the two together.
    """
    k = 2.0 * sample_rate
    return (gain * np.array([k + zero, zero - k]) / (k + pole), np.array([1.0, (pole - k) / (k + pole)]))


def tustin_pid(gain: float, integral: float, derivative: float, filter: float,
               sample_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample gain (1 + integral/s + derivative s/(filter s + 1)) by Tustin; a term that is 0 adds no state.

    Returns numerator and denominator as ``tustin_lead``.
    """
    from scipy.signal import bilinear  # slow to import, and seldom wanted

    numerator, denominator = np.ones(1), np.ones(1)
    if integral != 0.0:
        numerator, denominator = np.array([1.0, integral]), np.array([1.0, 0.0])
    if derivative != 0.0:
        lag = np.array([filter, 1.0])
        numerator = np.polyadd(np.polymul(numerator, lag), np.polymul(denominator, [derivative, 0.0]))
        denominator = np.polymul(denominator, lag)
    sampled, denominator = bilinear(numerator, denominator, sample_rate)
    return gain * sampled, denominator


def _check_keys(kind: str, spec: dict[str, Any]) -> None:
    """UsageError where a controller has keys that its kind does not know, or lacks some: a misspelt key is both."""
    wanted = _FIELDS[kind]
    unknown = sorted(str(key) for key in spec.keys() - {"kind", *wanted, *_OPTIONAL})
    missing = [key for key in wanted if key not in spec]
    told = [f"{', '.join(f'controller.{key}' for key in keys[:_SHOWN])}: {what}"
            for keys, what in ((unknown, f"unknown key for kind {kind!r}"),
                               (missing, f"missing (kind {kind!r} wants {', '.join(wanted)})")) if keys]
    if told:
        raise UsageError("; ".join(told))


def _numbers(spec: dict[str, Any], key: str) -> np.ndarray:
    try:
        values = np.atleast_1d(np.asarray(spec[key]))
    except ValueError:  # lists of unequal length
        values = np.zeros(0, dtype=object)
    if values.dtype.kind not in "iuf":
        raise UsageError(f"controller.{key}: a number or a list of numbers is wanted, not {spec[key]!r}"[:200])
    if values.ndim != 1 or not 1 <= values.size <= 16 or not np.all(np.isfinite(values)):
        raise UsageError(f"controller.{key}: 1 to 16 finite numbers are wanted")
    return values.astype(float)


def _monic(values: dict[str, np.ndarray], top: str, bottom: str) -> tuple[np.ndarray, np.ndarray]:
    """Two polynomials in z as a difference equation: of equal length, the denominator monic."""
    numerator, denominator = values[top], values[bottom]
    if denominator[0] == 0.0 or numerator.size > denominator.size:
        raise UsageError(f"controller.{bottom}: must begin with a number other than 0 and be at least as long as {top}")
    padded = np.zeros(denominator.size)
    padded[denominator.size - numerator.size:] = numerator
    return padded / denominator[0], denominator / denominator[0]


@dataclass
class Compensator:
    """A difference equation from reference, encoder and accelerometer (counts) to the command (counts).

    ``numerator``/``denominator`` act on the error, ``accel_numerator``/``accel_denominator`` on the
    accelerometer's reading (empty where there is no accelerometer loop); both monic, highest power of z first.
    ``feedback`` are coefficients of the encoder's present and past readings, taken off; before the first reading the
    encoder is taken to have stood there.
    """

    spec: dict[str, Any]
    limit: float
    numerator: np.ndarray
    denominator: np.ndarray
    accel_numerator: np.ndarray = field(default_factory=lambda: np.zeros(0))
    accel_denominator: np.ndarray = field(default_factory=lambda: np.zeros(0))
    feedback: np.ndarray = field(default_factory=lambda: np.zeros(0))
    open_loop: bool = False

    @classmethod
    def from_spec(cls, spec: dict[str, Any], sample_rate: float, limit: float) -> Compensator:
        """Build from a controller's dictionary; UsageError names the key that is missing, unknown or wrong."""
        kind = spec.get("kind")
        if kind not in _FIELDS:
            raise UsageError(f"controller.kind: {kind!r} is none of {', '.join(_FIELDS)}")
        _check_keys(kind, spec)
        values = {key: _numbers(spec, key) for key in (*_FIELDS[kind], *spec.keys() & {"accel_zero"})}
        for key in values.keys() - _LISTS:
            if values[key].size != 1:
                raise UsageError(f"controller.{key}: one number is wanted")
        if spec.get("rounding", True) not in (True, False):
            raise UsageError(f"controller.rounding: true or false is wanted, not {spec['rounding']!r}"[:200])
        if kind == "open":
            return cls(dict(spec), limit, np.ones(1), np.ones(1), open_loop=True)
        if kind == "unknown":
            raise UsageError("controller.kind: unknown, so that no command can be worked out; name the controller")
        if kind == "filter":
            return cls(dict(spec), limit, *_monic(values, "numerator", "denominator"))
        if kind == "cascade":
            position, speed = (float(values[key][0]) for key in _FIELDS[kind])
            return cls(dict(spec), limit, np.array([position * speed]), np.ones(1),
                       feedback=speed * sample_rate * np.array([1.0, -1.0]))
        gain = float(values["gain"][0])
        if kind == "p":
            return cls(dict(spec), limit, np.array([gain]), np.ones(1))
        if kind == "pid":
            gain, integral, derivative, filter = (float(values[key][0]) for key in _FIELDS[kind])
            if filter < 0.0 or (derivative != 0.0 and filter == 0.0):
                raise UsageError("controller.filter: a time constant above 0 s is wanted, without which Tustin's "
                                 "derivative rings")
            return cls(dict(spec), limit, *tustin_pid(gain, integral, derivative, filter, sample_rate))
        zero, pole = float(values["zero"][0]), float(values["pole"][0])
        if 2.0 * sample_rate + pole <= 0.0:
            raise UsageError("controller.pole: too far in the right half plane for this sample rate")
        lead = tustin_lead(gain, zero, pole, sample_rate)
        if kind == "lead":
            return cls(dict(spec), limit, *lead)
        return cls(dict(spec), limit, *lead, *_monic(values, "accel_numerator", "accel_denominator"))

    def __post_init__(self) -> None:
        self.reset()

    def reset(self, accel_zero: float | None = None) -> None:
        """Clear all states; ``accel_zero`` (counts) defaults to the controller's own, else 0."""
        self.accel_zero = float(self.spec.get("accel_zero", 0.0)) if accel_zero is None else float(accel_zero)
        n, m = self.denominator.size, max(self.accel_denominator.size, 1)
        self._errors, self._outputs = deque([0.0] * n, n), deque([0.0] * n, n)
        self._accels, self._shaped = deque([0.0] * m, m), deque([0.0] * m, m)
        self._readings: deque[float] = deque(maxlen=max(self.feedback.size, 1))

    @property
    def memory(self) -> int:
        """Samples before the present one from which a command is worked out, beside the accelerometer's."""
        return max(self.denominator.size, self.feedback.size, 1) - 1

    def sent(self, command: float) -> None:
        """Take another command than the last ``step`` gave for the one that was given."""
        self._outputs[0] = command

    def copy(self) -> Compensator:
        """Another one in the same state."""
        other = copy.copy(self)
        vars(other).update({name: state.copy() for name, state in vars(self).items() if isinstance(state, deque)})
        return other

    def shape(self, accel: float) -> float:
        """One step of the accelerometer loop: Ga(z)(accel - accel_zero), counts."""
        self._accels.appendleft(accel - self.accel_zero)
        out = sum(b * x for b, x in zip(self.accel_numerator, self._accels, strict=True))
        out -= sum(a * y for a, y in zip(self.accel_denominator[1:], self._shaped, strict=False))
        self._shaped.appendleft(out)
        return out

    def step(self, reference: float, encoder: float, accel: float) -> float:
        """One sample: the command in counts, limited, not rounded."""
        if self.open_loop:
            return min(max(reference, -self.limit), self.limit)
        if self.accel_denominator.size:
            reference = reference - self.shape(accel)
        self._errors.appendleft(reference - encoder)
        out = sum(b * x for b, x in zip(self.numerator, self._errors, strict=True))
        out -= sum(a * y for a, y in zip(self.denominator[1:], self._outputs, strict=False))
        if self.feedback.size:
            self._readings.extendleft([encoder] * (1 if self._readings else self.feedback.size))
            out -= sum(c * y for c, y in zip(self.feedback, self._readings, strict=True))
        out = min(max(out, -self.limit), self.limit)
        self._outputs.appendleft(out)
        return out

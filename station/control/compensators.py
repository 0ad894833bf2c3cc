"""Compensators: continuous transfer functions, sampled by Tustin, run as difference equations.

A controller is described by a small dictionary (the ``controller`` of a run or a plan):

====================  ==========================================================================
``{"kind": "open"}``  the reference is the command
``p``                 ``gain``: v = gain (r - y)
``lead``              ``gain, zero, pole``: gain (s + zero)/(s + pole) on r - y
``lead_accel``        lead on r - Ga(z) (a - accel_zero) - y, with ``accel_numerator`` and
                      ``accel_denominator``, polynomials in z, highest power first
====================  ==========================================================================

The recursion runs on its own output after the limit and before rounding, as the laboratory's program did
(confirmed by replaying its logs).
"""

from __future__ import annotations

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
}
_OPTIONAL = {"rounding", "accel_zero"}


def tustin_lead(gain: float, zero: float, pole: float, sample_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample gain (s + zero)/(s + pole) by Tustin: s = 2 f (z - 1)/(z + 1).

    Returns numerator and denominator in z, highest power first, the denominator monic.  The closed form is
    that of ``control.sample_system(..., method="tustin")``; a test holds the two together.
    """
    k = 2.0 * sample_rate
    return (gain * np.array([k + zero, zero - k]) / (k + pole), np.array([1.0, (pole - k) / (k + pole)]))


def _numbers(spec: dict[str, Any], key: str) -> np.ndarray:
    try:
        values = np.atleast_1d(np.asarray(spec[key], dtype=float))
    except (TypeError, ValueError):
        raise UsageError(f"controller.{key}: a number or a list of numbers is wanted, not {spec[key]!r}") from None
    if values.ndim != 1 or not 1 <= values.size <= 16 or not np.all(np.isfinite(values)):
        raise UsageError(f"controller.{key}: 1 to 16 finite numbers are wanted")
    return values


@dataclass
class Compensator:
    """A difference equation from reference, encoder and accelerometer (counts) to the command (counts).

    ``numerator``/``denominator`` act on the error, ``accel_numerator``/``accel_denominator`` on the
    accelerometer's reading (empty where there is no accelerometer loop); both monic, highest power of z first.
    """

    spec: dict[str, Any]
    limit: float
    numerator: np.ndarray
    denominator: np.ndarray
    accel_numerator: np.ndarray = field(default_factory=lambda: np.zeros(0))
    accel_denominator: np.ndarray = field(default_factory=lambda: np.zeros(0))
    open_loop: bool = False

    @classmethod
    def from_spec(cls, spec: dict[str, Any], sample_rate: float, limit: float) -> Compensator:
        """Build from a controller's dictionary; UsageError names the key that is missing, unknown or wrong."""
        kind = spec.get("kind")
        if kind not in _FIELDS:
            raise UsageError(f"controller.kind: {kind!r} is none of {', '.join(_FIELDS)}")
        for key in _FIELDS[kind]:
            if key not in spec:
                raise UsageError(f"controller.{key}: missing (kind {kind!r} wants {', '.join(_FIELDS[kind])})")
        for key in spec.keys() - {"kind", *_FIELDS[kind], *_OPTIONAL}:
            raise UsageError(f"controller.{key}: unknown key for kind {kind!r}")
        if kind == "open":
            return cls(dict(spec), limit, np.ones(1), np.ones(1), open_loop=True)
        values = {key: _numbers(spec, key) for key in _FIELDS[kind]}
        for key in set(values) & {"gain", "zero", "pole"}:
            if values[key].size != 1:
                raise UsageError(f"controller.{key}: one number is wanted")
        gain = float(values["gain"][0])
        if kind == "p":
            return cls(dict(spec), limit, np.array([gain]), np.ones(1))
        zero, pole = float(values["zero"][0]), float(values["pole"][0])
        if 2.0 * sample_rate + pole <= 0.0:
            raise UsageError("controller.pole: too far in the right half plane for this sample rate")
        lead = tustin_lead(gain, zero, pole, sample_rate)
        if kind == "lead":
            return cls(dict(spec), limit, *lead)
        numerator, denominator = values["accel_numerator"], values["accel_denominator"]
        if denominator[0] == 0.0 or numerator.size > denominator.size:
            raise UsageError("controller.accel_denominator: must begin with a number other than 0 "
                             "and be at least as long as accel_numerator")
        padded = np.zeros(denominator.size)
        padded[denominator.size - numerator.size:] = numerator
        return cls(dict(spec), limit, *lead, padded / denominator[0], denominator / denominator[0])

    def __post_init__(self) -> None:
        self.reset()

    def reset(self, accel_zero: float | None = None) -> None:
        """Clear all states; ``accel_zero`` (counts) defaults to the controller's own, else 0."""
        self.accel_zero = float(self.spec.get("accel_zero", 0.0)) if accel_zero is None else float(accel_zero)
        n, m = self.denominator.size, max(self.accel_denominator.size, 1)
        self._errors, self._outputs = deque([0.0] * n, n), deque([0.0] * n, n)
        self._accels, self._shaped = deque([0.0] * m, m), deque([0.0] * m, m)

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
        out = min(max(out, -self.limit), self.limit)
        self._outputs.appendleft(out)
        return out

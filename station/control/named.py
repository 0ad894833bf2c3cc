"""The compensators that go by a name, and how near another one is to them."""

from __future__ import annotations

import math
from typing import Any

SAMPLED_AT = 500.0
"""Rate (Hz) at which the accelerometer's compensator is sampled."""
_LEAD = {"gain": 20.0, "zero": 10.0 * math.pi, "pole": 40.0 * math.pi}
OPEN = frozenset({"pulse", "pulse_train"})
"""Kinds of tests that run open loop where no controller is asked for; the others run under P control."""
NAMED: dict[str, dict[str, Any]] = {
    "open": {"kind": "open"},
    "p": {"kind": "p", "gain": 2.0},
    "lead": {"kind": "lead", **_LEAD},
    "lead-accel": {
        "kind": "lead_accel", **_LEAD,
        "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
        "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]},
}
"""Those of the thesis; the accelerometer's compensator is sampled, as its log's header gives it."""


def named_controller(spec: dict[str, Any]) -> tuple[str, dict[str, float]] | None:
    """The name of a compensator and the numbers (gain, zero, pole) in which it differs from that of the name.

    None where it goes by no name: another kind, or other coefficients of the accelerometer's loop.
    """
    for name, known in NAMED.items():
        if spec.get("kind") != known["kind"]:
            continue
        own = {key: value for key, value in spec.items() if key not in ("rounding", "accel_zero")}
        changed = {key: value for key, value in own.items() if known.get(key) != value}
        if own.keys() == known.keys() and changed.keys() <= {"gain", "zero", "pole"}:
            return name, changed
    return None

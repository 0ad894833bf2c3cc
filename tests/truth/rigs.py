"""Rig constants as plain dicts, and draws of a rig within its stated uncertainty.

A rig is a dict shaped like the rig file: tables of SI constants, `sample_rate`, an `uncertainty` table, and the
`effects` that it is known to have. Any part that a rig file may leave out may be left out here.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

RigDict = dict[str, Any]

SFLR: RigDict = {
    "name": "sflr",
    "sample_rate": 500.0,
    "amplifier": {"limit": 200.0},
    "motor": {"inertia": 0.00131777, "damping": 0.158669, "gain": 0.0106887},
    "drive": {"stiffness": 0.102728, "damping": 0.0956453},
    "base": {"inertia": 0.00161216},
    "clamp": {"stiffness": 2.49780, "damping": 0.00389708},
    "beam": {"mass_per_length": 0.136640, "length": 0.413544, "flexural_rigidity": 0.210000, "damping": 1e-5},
    "tip": {"mass": 0.00612610, "inertia": 7.0627e-7},
    "encoder": {"counts_per_revolution": 1024},
    "accelerometer": {"gain": 1.14527},
    "uncertainty": {
        "default": 0.1,
        "beam.flexural_rigidity": 0.2,
        "drive.stiffness": 0.2,
        "drive.damping": 0.2,
        "beam.mass_per_length": 0.12,
        "motor.inertia": 0.6,
        "beam.damping": 1.0,
        "motor": 1.0,
    },
}
"""Set A of the measured rig, without the beam beyond the sensor."""

SFLR_UNIT: RigDict = copy.deepcopy(SFLR) | {
    "name": "sflr-unit",
    "motor": {"inertia": 0.1232865, "damping": 14.84456, "gain": 1.0},
}
"""The same rig at unit torque per count: its first mode lies at 2.84 Hz."""

RIGID_AXIS: RigDict = {
    "name": "axis",
    "sample_rate": 500.0,
    "amplifier": {"limit": 200.0},
    "motor": {"inertia": 0.02, "damping": 0.15, "gain": 0.01},
    "encoder": {"counts_per_revolution": 1024},
    "uncertainty": {"default": 0.1},
}
"""One inertia on a motor that carries the encoder."""

TWO_MASS: RigDict = {
    "name": "two-mass",
    "sample_rate": 500.0,
    "amplifier": {"limit": 200.0},
    "motor": {"inertia": 0.002, "damping": 0.15, "gain": 0.005},
    "drive": {"stiffness": 20.0, "damping": 0.05},
    "base": {"inertia": 0.004},
    "encoder": {"counts_per_revolution": 1024},
    "uncertainty": {"default": 0.1},
}
"""Motor and load joined by a shaft; no beam."""

SERVO: RigDict = {
    "name": "servo",
    "sample_rate": 200.0,
    "amplifier": {"limit": 885.0},
    "motor": {"inertia": 0.0072, "damping": 0.045, "gain": 0.0009},
    "encoder": {"counts_per_revolution": 4096},
    "effects": [{"effect": "gravity_tilt", "at": "base", "torque": 0.49, "angle": 0.0}],
    "uncertainty": {"default": 0.2},
}
"""A geared servo that swings a pendulum, as hobby servos do: constants of the size of theirs."""

_UNCERTAIN_TABLES = ("motor", "drive", "base", "clamp", "beam", "tip")


def uncertain_keys(rig: RigDict) -> list[str]:
    """Dotted names of the constants that an uncertainty covers; exact and integer ones are left out."""
    keys = [f"{t}.{k}" for t in _UNCERTAIN_TABLES for k in rig.get(t) or {} if k not in ("elements", "back_emf")]
    return keys + (["accelerometer.gain"] if rig.get("accelerometer") else [])


def get_constant(rig: RigDict, key: str) -> float:
    """The constant with the dotted name `key`, SI."""
    table, name = key.split(".")
    return float(rig[table][name])


def with_constants(rig: RigDict, values: dict[str, float]) -> RigDict:
    """A copy of the rig with some constants replaced; an unknown name is a KeyError."""
    out = copy.deepcopy(rig)
    for key, value in values.items():
        table, name = key.split(".")
        if name not in out[table]:
            raise KeyError(key)
        out[table][name] = float(value)
    return out


def own_sigma(uncertainty: dict[str, float], key: str) -> float:
    """One sigma of the natural logarithm of the constant, its table's common factor not included."""
    return float(uncertainty.get(key, uncertainty.get("default", 0.0)))


def draw_logs(
    nominal: RigDict, uncertainty: dict[str, float] | None, rng: np.random.Generator, limit: float = 2.0
) -> tuple[dict[str, float], dict[str, float]]:
    """Natural logarithms of each constant's own factor, and of the common factor that its table adds.

    Every draw is Gaussian, cut at `limit` sigma. A table named in `uncertainty` has one common factor on its
    inertia, damping and gain, on top of each one's own.
    """
    sigmas = nominal.get("uncertainty", {}) if uncertainty is None else uncertainty

    def z() -> float:
        while True:
            value = rng.standard_normal()
            if abs(value) <= limit:
                return float(value)

    own = {key: z() * own_sigma(sigmas, key) for key in uncertain_keys(nominal)}
    common = dict.fromkeys(own, 0.0)
    for table in _UNCERTAIN_TABLES:
        if table in sigmas:
            factor = z() * float(sigmas[table])
            for name in ("inertia", "damping", "gain"):
                if f"{table}.{name}" in own:
                    common[f"{table}.{name}"] = factor
    return own, common


def shifted(rig: RigDict, *logs: dict[str, float]) -> RigDict:
    """The rig with constants multiplied by the exponentials of the sums of `logs`."""
    values = {k: get_constant(rig, k) for k in {k for part in logs for k in part}}
    return with_constants(rig, {k: v * float(np.exp(sum(p.get(k, 0.0) for p in logs))) for k, v in values.items()})


def draw_constants(
    nominal: RigDict,
    uncertainty: dict[str, float] | None,
    rng: np.random.Generator,
    limit: float = 2.0,
) -> RigDict:
    """A rig drawn log-normally around the nominal one, every draw cut at `limit` sigma (see `draw_logs`)."""
    return shifted(nominal, *draw_logs(nominal, uncertainty, rng, limit))

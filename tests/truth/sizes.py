"""Plausible effects: for each, a draw of its shape and how its size grows.

`draw_effect` gives an effect at a middling size; `scaled` makes it larger or smaller along its one size,
whose neutral end (size factor 0) is the rig without it. Torques are measured against the motor: the torque
of some counts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .rigs import RigDict, get_constant, own_sigma
from .simulate import CATALOGUE, OUTSIDE, Effect

PARAMETER_SIGMAS = 4.2
"""A constant is a cause beyond 4 of its own sigma from nominal."""
PARAMETER_FACTOR = 25.0
"""Beyond this factor, or beyond 18 sigma, it would be another rig; 6 sigma are always allowed."""

BANDS = {"clear": (230.0, 100000.0), "subtle": (35.0, 170.0)}
"""Severities that a case is sized for, inside the contract's clear > 200 and 25 to 200."""


def names(rig: RigDict) -> list[tuple[str, str]]:
    """(effect, at) of the catalogue that this rig can have."""
    missing = {t for t in ("drive", "clamp", "accelerometer") if not rig.get(t)}
    if not rig.get("beam"):
        missing |= {"clamp", "accelerometer"}
    no = {(e["effect"], e["at"]) for e in rig.get("effects", ())}
    if rig.get("drive"):
        no.add(("load_friction", "motor"))
    return [(name, at) for name, at in CATALOGUE if at not in missing and (name, at) not in no]


def outside_names(rig: RigDict) -> list[str]:
    """Effects outside the catalogue that this rig can have."""
    return [n for n in OUTSIDE if rig.get("beam") or n not in ("stuck_bit", "tip_rattle")]


def draw_effect(name: str, rng: np.random.Generator, rig: RigDict, at: str | None = None) -> Effect:
    """One effect of middling size, its shape drawn; `at` is needed only where the effect has two places.

    A parameter cause "parameter:TABLE.KEY" is drawn without its value: `scaled` gives it.
    """

    def between(low: float, high: float) -> float:
        return float(math.exp(rng.uniform(math.log(low), math.log(high))))

    def phase() -> float:
        return float(rng.uniform(-math.pi, math.pi))

    def sign() -> float:
        return float(rng.choice([-1.0, 1.0]))

    if name.startswith("parameter:"):
        return {"effect": name, "at": "", "value": math.nan, "_sign": sign()}
    count = abs(rig["motor"]["gain"])  # N m per count
    damping = rig["motor"]["damping"]
    places = [a for n, a in names(rig) if n == name]
    if name in OUTSIDE:
        place = ""
    elif at is not None and at in places:
        place = at
    elif at is None and places:
        place = str(rng.choice(places))
    else:
        raise ValueError(f"{name} at {at!r}: not for rig {rig['name']}")
    base = rig["motor"]["inertia"] + (rig.get("base") or {"inertia": 0.0})["inertia"]
    if rig.get("beam"):
        beam = rig["beam"]
        base += (
            beam["mass_per_length"] * beam["length"] ** 3 / 3
            + rig.get("tip", {}).get("mass", 0.0) * beam["length"] ** 2
        )

    def own_frequency(low: float, high: float, inertia: float, loss: float) -> dict[str, float]:
        w = 2 * math.pi * between(low, high)
        return {"inertia": inertia, "stiffness": inertia * w * w, "damping": 2 * loss * w * inertia}

    match name:
        case "coulomb_friction":
            p = {"torque": between(2, 10) * count}
        case "stribeck_friction":
            level = between(2, 8) * count
            p = {"static_torque": level * between(1.3, 2.5), "coulomb_torque": level}
            p["stribeck_velocity"] = between(0.05, 0.6)
        case "load_friction":
            p = {"fraction": between(0.1, 0.4)}
        case "sublinear_drag":
            p = {"coefficient": between(0.2, 1.0) * damping, "speed": between(0.2, 1.5)}
        case "torque_ripple":
            cycles = float(rng.choice([1, 2, 3, 4, 6, 8, 10, 12]))
            p = {"amplitude": between(2, 10) * count, "cycles": cycles, "phase": phase()}
        case "quadratic_drag":
            p = {"coefficient": between(0.03, 0.2) * damping}
        case "gravity_tilt":
            p = {"torque": between(2, 10) * count, "angle": phase()}
        case "cable_spring":
            p = {"stiffness": between(5, 30) * count, "rest": float(rng.uniform(-0.6, 0.6))}
        case "dead_zone":
            p = {"width": between(2, 10)}
        case "actuator_saturation":
            p = {"limit": rig["amplifier"]["limit"] / (1.0 + between(0.2, 1.0))}
        case "gain_curve":
            p = {"exponent": float(rng.choice([-0.15, 0.25])) * between(0.5, 1.5)}
        case "gain_asymmetry":
            p = {"ratio": math.exp(sign() * between(0.08, 0.3))}
        case "command_bias":
            p = {"offset": sign() * between(2, 8)}
        case "input_delay" | "encoder_delay":
            p = {"time": between(0.0015, 0.008)}
        case "actuator_lag":
            p = {"time_constant": between(0.002, 0.015)}
        case "backlash":
            p = {"gap": between(0.008, 0.05)}
        case "hardening_spring":
            twist = 0.3 if place == "drive" else 0.08
            p = {"cubic": rig[place]["stiffness"] / twist**2 * between(0.5, 2.0)}
        case "accelerometer_highpass":
            p = {"time_constant": between(0.1, 1.0)}
        case "accelerometer_lag":
            p = {"time_constant": between(0.0006, 0.004)}
        case "accelerometer_delay":
            p = {"time": between(0.0008, 0.005)}
        case "accelerometer_saturation":
            p = {"limit": between(20.0, 50.0)}
        case "accelerometer_centripetal":
            p = {"fraction": sign() * between(0.1, 0.6)}
        case "encoder_eccentricity":
            p = {"amplitude": between(1.0, 4.0), "phase": phase()}
        case "clock_scale":
            p = {"ratio": math.exp(sign() * between(0.003, 0.04))}
        case "presliding_friction":
            level = between(4, 12) * count
            p = {"torque": level, "stiffness": level / between(0.03, 0.15), "wave": between(0.4, 0.8)}
            p |= {"cycles": float(rng.integers(5, 14)), "phase": phase()}
        case "angle_friction":
            p = {"torque": between(4, 12) * count, "wave": between(0.6, 0.95)}
            p |= {"cycles": float(rng.integers(5, 14)), "phase": phase()}
        case "friction_drift":
            p = {
                "torque": between(4, 12) * count,
                "change": float(rng.choice([-0.85, 2.5])),
                "time": between(0.4, 1.2),
            }
        case "second_appendage":
            p = own_frequency(5.0, 18.0, base * between(0.08, 0.4), 0.01)
        case "mount_compliance":
            p = own_frequency(6.0, 20.0, base * between(1.0, 3.0), 0.02)
        case "motor_fade":
            p = {"loss": between(0.8, 3.0), "time": between(0.3, 1.5)}
        case "cable_snag":
            low = float(rng.uniform(0.02, 0.25))
            p = {
                "torque": between(5, 20) * count,
                "low": low,
                "high": low + between(0.05, 0.2),
                "mean_time": 0.5,
            }
        case "encoder_slip":
            p = {"counts": float(rng.choice([-1, 1]) * rng.integers(3, 12)), "mean_time": 1.2}
        case "stuck_bit":
            p = {"bit": float(rng.integers(2, 5)), "value": float(rng.integers(2))}
        case "end_stop":
            p = {"angle": between(0.15, 0.4), "stiffness": between(2.0, 20.0), "damping": between(0.01, 0.05)}
        case "tip_rattle":
            mass = between(0.004, 0.015)
            w = 2 * math.pi * between(60.0, 150.0)
            p = {
                "mass": mass,
                "gap": between(0.001, 0.006),
                "stiffness": mass * w * w,
                "damping": 0.1 * w * mass,
            }
        case _:
            raise ValueError(f"{name}: unknown effect")
    return {"effect": name, "at": place, **p}


def largest_parameter(name: str, rig: RigDict) -> float:
    """How far, in its own sigmas, a parameter cause may move."""
    sigma = own_sigma(rig["uncertainty"], name.removeprefix("parameter:"))
    return max(min(math.log(PARAMETER_FACTOR) / sigma, 18.0), 6.0)


_SIZE = {  # the parameters that grow with the size, and the largest value that is still physical
    "coulomb_friction": {"torque": math.inf},
    "stribeck_friction": {"static_torque": math.inf, "coulomb_torque": math.inf},
    "load_friction": {"fraction": 0.85},
    "sublinear_drag": {"coefficient": math.inf},
    "quadratic_drag": {"coefficient": math.inf},
    "torque_ripple": {"amplitude": math.inf},
    "gravity_tilt": {"torque": math.inf},
    "cable_spring": {"stiffness": math.inf},
    "dead_zone": {"width": 60.0},
    "gain_curve": {"exponent": 1.5},
    "command_bias": {"offset": 40.0},
    "input_delay": {"time": 0.03},
    "encoder_delay": {"time": 0.03},
    "accelerometer_delay": {"time": 0.03},
    "actuator_lag": {"time_constant": 0.1},
    "accelerometer_lag": {"time_constant": 0.1},
    "backlash": {"gap": 0.3},
    "hardening_spring": {"cubic": math.inf},
    "accelerometer_centripetal": {"fraction": 1.5},
    "encoder_eccentricity": {"amplitude": 15.0},
}


def scaled(effect: Effect, factor: float, rig: RigDict, centre: RigDict | None = None) -> Effect | None:
    """The effect with its size multiplied by `factor`; None beyond what is physical.

    For a parameter cause the size is in sigmas of its own uncertainty, `factor` 1 being PARAMETER_SIGMAS,
    counted from the value in `centre`: the nominal one times its table's drawn common factor.
    Effects outside the catalogue have no size to scale: factor 1 only.
    """
    out: dict[str, Any] = {k: v for k, v in effect.items() if not k.startswith("_")}
    name = effect["effect"]
    if name.startswith("parameter:"):
        key = name.removeprefix("parameter:")
        base = centre or rig
        sigma = own_sigma(base["uncertainty"], key)
        size = PARAMETER_SIGMAS * factor * sigma
        if factor < 1.0 or size > largest_parameter(name, base) * sigma:
            return None
        out["value"] = get_constant(base, key) * math.exp(effect["_sign"] * size)
        return out
    if name in _SIZE:
        for key, top in _SIZE[name].items():
            out[key] *= factor
            if abs(out[key]) > top or (key == "exponent" and out[key] <= -0.8):
                return None
        return out
    match name:
        case "actuator_saturation":
            full = rig["amplifier"]["limit"]
            out["limit"] = full / (1.0 + (full / effect["limit"] - 1.0) * factor)
        case "gain_asymmetry" | "clock_scale":
            log = math.log(effect["ratio"]) * factor
            if abs(log) > (0.7 if name == "gain_asymmetry" else 0.12):
                return None
            out["ratio"] = math.exp(log)
        case "accelerometer_highpass":
            out["time_constant"] = effect["time_constant"] / factor
        case "accelerometer_saturation":
            out["limit"] = effect["limit"] / factor
            if out["limit"] < 3.0:
                return None
        case _ if factor != 1.0:
            return None
    return out

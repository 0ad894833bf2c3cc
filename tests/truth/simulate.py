"""From a rig's constants and a list of effects to a simulated run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from . import kernel
from .disturbance import Pushes
from .plant import ELEMENTS, MODES, linear_system, mechanics, transition
from .rigs import RigDict, with_constants

Array = NDArray[np.float64]
Effect = dict[str, Any]

GA_NUMERATOR = (0.00045097, 0.00045152, -0.00044989, -0.00045043)
GA_DENOMINATOR = (1.0, -2.9289362, 2.85853684, -0.92960052)

CONTROLLERS: dict[str, dict[str, Any]] = {
    "open": {"kind": "open"},
    "p1": {"kind": "p", "gain": 1.0},
    "p2": {"kind": "p", "gain": 2.0},
    "lead": {"kind": "lead", "gain": 20.0, "zero": 10 * math.pi, "pole": 40 * math.pi},
    "lead_accel": {
        "kind": "lead_accel",
        "gain": 20.0,
        "zero": 10 * math.pi,
        "pole": 40 * math.pi,
        "accel_numerator": list(GA_NUMERATOR),
        "accel_denominator": list(GA_DENOMINATOR),
    },
    "servo_soft": {"kind": "p", "gain": 0.390625},
    "servo_stiff": {"kind": "p", "gain": 1.5625},
    "pid": {"kind": "pid", "gain": 2.0, "integral": 0.5, "derivative": 0.03, "filter": 0.01},
    "cascade": {"kind": "cascade", "position_gain": 6.0, "speed_gain": 0.25},
    "filter": {"kind": "filter", "numerator": [1.2, -1.0], "denominator": [1.0, -0.85, 0.1]},
}
"""The station's compensators in the form of a run's metadata."""

_SITES = {  # where an effect may stand, and its parameters
    "coulomb_friction": (("motor", "base"), ("torque",)),
    "stribeck_friction": (("motor",), ("static_torque", "coulomb_torque", "stribeck_velocity")),
    "load_friction": (("drive", "motor"), ("fraction",)),
    "sublinear_drag": (("motor",), ("coefficient", "speed")),
    "quadratic_drag": (("base",), ("coefficient",)),
    "torque_ripple": (("motor",), ("amplitude", "cycles", "phase")),
    "gravity_tilt": (("base",), ("torque", "angle")),
    "cable_spring": (("base",), ("stiffness", "rest")),
    "dead_zone": (("amplifier",), ("width",)),
    "actuator_saturation": (("amplifier",), ("limit",)),
    "gain_curve": (("amplifier",), ("exponent",)),
    "gain_asymmetry": (("amplifier",), ("ratio",)),
    "command_bias": (("amplifier",), ("offset",)),
    "input_delay": (("amplifier",), ("time",)),
    "actuator_lag": (("amplifier",), ("time_constant",)),
    "backlash": (("drive",), ("gap",)),
    "hardening_spring": (("drive", "clamp"), ("cubic",)),
    "accelerometer_highpass": (("accelerometer",), ("time_constant",)),
    "accelerometer_lag": (("accelerometer",), ("time_constant",)),
    "accelerometer_delay": (("accelerometer",), ("time",)),
    "accelerometer_saturation": (("accelerometer",), ("limit",)),
    "accelerometer_centripetal": (("accelerometer",), ("fraction",)),
    "encoder_delay": (("encoder",), ("time",)),
    "encoder_eccentricity": (("encoder",), ("amplitude", "phase")),
    "clock_scale": (("clock",), ("ratio",)),
}
_OUTSIDE = {
    "presliding_friction": ("torque", "stiffness", "wave", "cycles", "phase"),
    "angle_friction": ("torque", "wave", "cycles", "phase"),
    "friction_drift": ("torque", "change", "time"),
    "second_appendage": ("inertia", "stiffness", "damping"),
    "mount_compliance": ("inertia", "stiffness", "damping"),
    "motor_fade": ("loss", "time"),
    "cable_snag": ("torque", "low", "high", "mean_time"),
    "encoder_slip": ("counts", "mean_time"),
    "stuck_bit": ("bit", "value"),
    "end_stop": ("angle", "stiffness", "damping"),
    "tip_rattle": ("mass", "gap", "stiffness", "damping"),
}
CATALOGUE = tuple((name, at) for name, (sites, _) in _SITES.items() for at in sites)
OUTSIDE = tuple(_OUTSIDE)


def check_effects(rig: RigDict, effects: Sequence[Effect]) -> None:
    """Refuse, with a ValueError, an effect that is unknown, misplaced, repeated, or has no part to act on."""
    seen = set()
    for effect in effects:
        name, at = effect["effect"], effect.get("at", "")
        keys = set(effect) - {"effect", "at"}
        if name.startswith("parameter:"):
            table, key = name.removeprefix("parameter:").split(".")
            if key not in (rig.get(table) or {}) or keys != {"value"}:
                raise ValueError(f"{name}: not a constant of this rig, or no value")
        elif name in _OUTSIDE:
            if at or keys != set(_OUTSIDE[name]):
                raise ValueError(f"{name}: at {at!r}, parameters {sorted(keys)}")
        elif name not in _SITES or at not in _SITES[name][0] or keys != set(_SITES[name][1]):
            raise ValueError(f"{name} at {at!r}: unknown, or parameters {sorted(keys)} do not fit")
        elif at in ("drive", "clamp", "accelerometer") and not rig.get(at):
            raise ValueError(f"{name}: this rig has no {at}")
        elif (name, at) == ("load_friction", "motor") and rig.get("drive"):
            raise ValueError(f"{name}: this rig has a drive, which carries the load")
        if (name, at) in seen:
            raise ValueError(f"{name} at {at}: more than once")
        seen.add((name, at))


@dataclass(frozen=True)
class Output:
    """Columns of a run (counts), and what no log shows: the motion at the ticks (`trace`, see `kernel`)."""

    t: Array
    reference: Array
    command: Array
    encoder: Array
    accel: Array | None
    accel_zero: float
    trace: Array

    @property
    def unrounded(self) -> tuple[Array, Array | None]:
        """Encoder and accelerometer of this very run before rounding and noise, counts."""
        return self.trace[:, 14], None if self.accel is None else self.trace[:, 15]


def compensator(controller: dict[str, Any], rate: float) -> tuple[int, Array, Array, Array, Array]:
    """Kind, then numerator and denominator on the error, then on the accelerometer; of a cascade the two gains
    on the error and, in the accelerometer's place, what is taken off of the encoder's present and last reading.

    gain (s + z)/(s + p) by s = 2 f (1 - q)/(1 + q), q the delay of one sample, at the nominal rate f; a PID's
    integral and derivative alike, each by itself, and then over one denominator.
    """
    one, none = np.array([1.0]), np.array([0.0])
    kind = controller["kind"]
    if kind == "open":
        return 0, one, one, none, one
    if kind == "p":
        return 1, np.array([float(controller["gain"])]), one, none, one
    if kind == "cascade":
        inner = float(controller["speed_gain"])
        return 3, np.array([inner * controller["position_gain"]]), one, inner * rate * np.array([1.0, -1.0]), one
    if kind == "filter":
        den = np.array(controller["denominator"], float)
        num = np.r_[np.zeros(len(den) - len(controller["numerator"])), controller["numerator"]]
        return 1, num / den[0], den / den[0], none, one
    if kind == "pid":
        num, den = np.array([1.0]), one  # in powers of q
        if controller["integral"]:
            num, den = np.r_[1.0, -1.0] + controller["integral"] / (2 * rate) * np.r_[1.0, 1.0], np.r_[1.0, -1.0]
        if controller["derivative"]:
            slow = 2 * rate * controller["filter"]
            lag, lead = np.r_[slow + 1, 1 - slow], 2 * rate * controller["derivative"] * np.r_[1.0, -1.0]
            num, den = np.convolve(num, lag) + np.convolve(den, lead), np.convolve(den, lag)
        return 1, controller["gain"] * num / den[0], den / den[0], none, one
    gain, zero, pole = (float(controller[k]) for k in ("gain", "zero", "pole"))
    top, bottom = np.array([2 * rate + zero, zero - 2 * rate]), np.array([2 * rate + pole, pole - 2 * rate])
    num, den = gain * top / bottom[0], bottom / bottom[0]
    if kind == "lead":
        return 1, num, den, none, one
    if kind != "lead_accel":
        raise ValueError(f"controller kind {kind!r}")
    acc_num = np.array(controller["accel_numerator"], float)
    acc_den = np.array(controller["accel_denominator"], float)
    return 2, num, den, acc_num / acc_den[0], acc_den / acc_den[0]


def _split(delay: float, period: float) -> tuple[int, float]:
    """delay = shift * period + phase, 0 <= phase < period, exact multiples recognised."""
    shift = math.floor(delay / period + 1e-9)
    phase = delay - shift * period
    return shift, 0.0 if phase < 1e-9 * period else phase


def _pieces(
    period: float, command_delay: float, encoder_delay: float, accel_delay: float, step: float | None
) -> tuple[dict[str, Array], tuple[int, int, int]]:
    """Cut one tick at its events. Sensors come before the command where both fall together."""
    c_shift, c_phase = _split(command_delay, period)
    shifts, phases = [], []
    for delay in (encoder_delay, accel_delay):  # tick i reads at t_i - delay = (i - shift) period + phase
        shift, late = _split(delay, period)
        shifts.append(shift + (late > 0.0))
        phases.append(period - late if late > 0.0 else 0.0)
    cuts = sorted({0.0, c_phase, *phases})
    cuts = [c for i, c in enumerate(cuts) if i == 0 or c - cuts[i - 1] > 1e-9 * period]

    def at(phase: float) -> Array:
        nearest = min(range(len(cuts)), key=lambda i: abs(cuts[i] - phase))
        return np.arange(len(cuts)) == nearest

    lengths = np.diff([*cuts, period])
    counts = np.ones(len(cuts), int) if step is None else np.ceil(lengths / step * (1 - 1e-9)).astype(int)
    h = lengths / counts
    pieces = {"h": h, "n": counts, "encoder": at(phases[0]), "accel": at(phases[1]), "switch": at(c_phase)}
    return pieces, (c_shift, shifts[0], shifts[1])


# fmt: off
_NEEDS_STEPS = (
    "coulomb", "static", "load", "drag", "ripple", "bristle", "base_coulomb", "quadratic", "tilt", "cable",
    "snag", "stop_stiffness", "drive_nl", "clamp_k3", "rattle_k", "centripetal",
)
# fmt: on


class Truth:
    """A rig with its effects, prepared once and run many times."""

    def __init__(
        self,
        rig: RigDict,
        effects: Sequence[Effect] = (),
        step: float = 1e-4,
        elements: int = ELEMENTS,
        modes: int = MODES,
        detuning: Sequence[float] = (),
    ) -> None:
        effects = [*rig.get("effects", ()), *effects]
        self.arguments = (rig, effects, step, elements, modes)
        check_effects(rig, effects)
        values = {e["effect"].removeprefix("parameter:"): e["value"] for e in effects if ":" in e["effect"]}
        self.rig = rig = with_constants(rig, values)
        found = {(e["effect"], e.get("at", "")): e for e in effects}

        def get(name: str, at: str, key: str, default: float = 0.0) -> float:
            effect = found.get((name, at))
            return default if effect is None else float(effect[key])

        def outside(name: str, key: str, default: float = 0.0) -> float:
            return get(name, "", key, default)

        self.outside = {n: {k: float(e[k]) for k in _OUTSIDE[n]} for (n, at), e in found.items() if n in _OUTSIDE}
        gap = get("backlash", "drive", "gap")
        drive_k3 = get("hardening_spring", "drive", "cubic")
        loose = gap > 0.0
        mech = mechanics(rig, self.outside, without_drive=loose, elements=elements, modes=modes, detuning=detuning)
        self.mech = mech
        self.gain = rig["motor"]["gain"]
        system = linear_system(
            mech,
            self.gain,
            get("actuator_lag", "amplifier", "time_constant"),
            get("accelerometer_highpass", "accelerometer", "time_constant"),
            get("accelerometer_lag", "accelerometer", "time_constant"),
        )
        self.system = system
        ratio = get("clock_scale", "clock", "ratio", 1.0)
        self.period = ratio / rig["sample_rate"]
        limit = rig["amplifier"]["limit"]
        drive = rig.get("drive") or {"stiffness": 0.0, "damping": 0.0}
        accelerometer = rig.get("accelerometer") if mech.has_tip else None
        par: dict[str, float] = dict.fromkeys(kernel.PARAMETERS, 0.0)
        par |= {
            "period": self.period,
            "limit": limit,
            "dead_zone": get("dead_zone", "amplifier", "width"),
            "clip": get("actuator_saturation", "amplifier", "limit", math.inf),
            "curve": get("gain_curve", "amplifier", "exponent"),
            "ratio": get("gain_asymmetry", "amplifier", "ratio", 1.0),
            "bias": get("command_bias", "amplifier", "offset"),
            "fade": outside("motor_fade", "loss"),
            "fade_time": outside("motor_fade", "time"),
            "counts": rig["encoder"]["counts_per_revolution"],
            "ecc_amplitude": get("encoder_eccentricity", "encoder", "amplitude"),
            "ecc_phase": get("encoder_eccentricity", "encoder", "phase"),
            "acc_gain": accelerometer["gain"] if accelerometer else 0.0,
            "acc_limit": get("accelerometer_saturation", "accelerometer", "limit", math.inf),
            "centripetal": get("accelerometer_centripetal", "accelerometer", "fraction")
            * (rig["beam"]["length"] if mech.has_tip else 0.0),
            "stuck_bit": outside("stuck_bit", "bit", -1.0),
            "stuck_value": outside("stuck_bit", "value"),
            "coulomb": get("coulomb_friction", "motor", "torque") + outside("friction_drift", "torque"),
            "static": get("stribeck_friction", "motor", "static_torque"),
            "stribeck": get("stribeck_friction", "motor", "coulomb_torque"),
            "stribeck_speed": get("stribeck_friction", "motor", "stribeck_velocity", 1.0),
            "load": get("load_friction", "drive" if rig.get("drive") else "motor", "fraction"),
            "axis_gain": 0.0 if system.lag_state >= 0 else self.gain,
            "drag": get("sublinear_drag", "motor", "coefficient"),
            "drag_speed": get("sublinear_drag", "motor", "speed", 1.0),
            "ripple": get("torque_ripple", "motor", "amplitude"),
            "ripple_cycles": get("torque_ripple", "motor", "cycles"),
            "ripple_phase": get("torque_ripple", "motor", "phase"),
            "drift": outside("friction_drift", "change"),
            "drift_time": outside("friction_drift", "time"),
            "bristle": outside("presliding_friction", "torque"),
            "bristle_stiffness": outside("presliding_friction", "stiffness"),
            "bristle_wave": outside("presliding_friction", "wave"),
            "bristle_cycles": outside("presliding_friction", "cycles"),
            "bristle_phase": outside("presliding_friction", "phase"),
            "base_coulomb": get("coulomb_friction", "base", "torque") + outside("angle_friction", "torque"),
            "base_wave": outside("angle_friction", "wave"),
            "base_wave_cycles": outside("angle_friction", "cycles"),
            "base_wave_phase": outside("angle_friction", "phase"),
            "quadratic": get("quadratic_drag", "base", "coefficient"),
            "tilt": get("gravity_tilt", "base", "torque"),
            "tilt_angle": get("gravity_tilt", "base", "angle"),
            "cable": get("cable_spring", "base", "stiffness"),
            "cable_rest": get("cable_spring", "base", "rest"),
            "snag": outside("cable_snag", "torque"),
            "snag_low": outside("cable_snag", "low"),
            "snag_high": outside("cable_snag", "high"),
            "stop_angle": outside("end_stop", "angle"),
            "stop_stiffness": outside("end_stop", "stiffness"),
            "stop_damping": outside("end_stop", "damping"),
            "drive_nl": 2.0 if loose else float(drive_k3 > 0.0),
            "drive_k": drive["stiffness"],
            "drive_c": drive["damping"],
            "gap": gap,
            "drive_k3": drive_k3,
            "clamp_k3": get("hardening_spring", "clamp", "cubic"),
            "rattle_gap": outside("tip_rattle", "gap"),
            "rattle_k": outside("tip_rattle", "stiffness"),
            "rattle_c": outside("tip_rattle", "damping"),
        }
        self.nonlinear = any(par[name] != 0.0 for name in _NEEDS_STEPS)
        self.pieces, shifts = _pieces(
            self.period,
            get("input_delay", "amplifier", "time"),
            get("encoder_delay", "encoder", "time"),
            get("accelerometer_delay", "accelerometer", "time"),
            step if self.nonlinear else None,
        )
        par |= dict(zip(("command_shift", "encoder_shift", "accel_shift"), map(float, shifts), strict=True))
        self.par = par
        sizes, self.which = np.unique(np.round(self.pieces["h"], 15), return_inverse=True)
        steps = [transition(system, float(h)) for h in sizes]
        self.a = np.ascontiguousarray([a for a, _ in steps])
        self.b = np.ascontiguousarray([b for _, b in steps])
        self.g = np.ascontiguousarray([system.c_port @ b for _, b in steps])
        self.c_load = np.zeros(len(system.a))
        self.c_load[: 2 * system.nq] = mech.load.ravel()
        if system.lag_state >= 0:
            self.c_load[system.lag_state] = self.gain
        self.has_accelerometer = accelerometer is not None

    def detuned(self, factors: Sequence[float]) -> Truth:
        """The same with other frequencies of the beam's modes."""
        rig, effects, step, elements, modes = self.arguments
        known = len(rig.get("effects", ()))
        return Truth(rig, effects[known:], step, elements, modes, factors)

    def _twist(self, torque: float, place: float) -> float:
        """Motor angle less base angle at which the drive's springs pass `torque`; in a gap, `place` of its
        half."""
        p = self.par
        if p["drive_k"] == 0.0:
            return 0.0
        if torque == 0.0:
            return place * 0.5 * p["gap"]
        e = abs(torque) / p["drive_k"]
        if p["drive_k3"] > 0.0:
            excess = lambda x: p["drive_k"] * x + p["drive_k3"] * x**3 - abs(torque)  # noqa: E731
            e = brentq(excess, 0.0, 1.001 * e, xtol=1e-15)
        return math.copysign(e + 0.5 * p["gap"], torque)

    def equilibrium(self, start_angle: float, place: float = 0.0) -> tuple[float, float]:
        """Base angle and motor angle at rest under the constant torques, at `start_angle` where friction
        allows.

        A ValueError where nothing holds the rig.
        """
        p = self.par
        push = self.gain * p["bias"]

        def base_torque(angle: float) -> float:
            return -p["tilt"] * math.sin(angle - p["tilt_angle"]) - p["cable"] * (angle - p["cable_rest"])

        def motor_torque(angle: float) -> float:
            return push + p["ripple"] * math.sin(p["ripple_cycles"] * angle + p["ripple_phase"])

        has_drive = p["drive_k"] > 0.0
        dry_m, dry_b = p["coulomb"] + p["static"], p["base_coulomb"]
        if not has_drive:
            load = abs(motor_torque(start_angle) - base_torque(start_angle))
            if abs(motor_torque(start_angle) + base_torque(start_angle)) <= dry_m + p["load"] * load + dry_b:
                return start_angle, start_angle
        else:
            passed = -base_torque(start_angle)  # the base balanced, the motor's friction holds the rest
            motor = start_angle + self._twist(passed, place)
            if abs(motor_torque(motor) - passed) <= dry_m + p["load"] * abs(passed):
                return start_angle, motor
            passed = push  # the motor balanced, the base's friction holds the rest
            for _ in range(200):
                motor = start_angle + self._twist(passed, place)
                passed += 0.5 * (motor_torque(motor) - passed)
            if abs(motor_torque(motor) - passed) < 1e-12 and abs(passed + base_torque(start_angle)) <= dry_b:
                return start_angle, motor

        def total(angle: float) -> float:
            return motor_torque(angle + self._twist(-base_torque(angle), place)) + base_torque(angle)

        scale = np.concatenate([[0.0], np.geomspace(1e-4, math.pi, 200)])
        best: list[float] = []
        for side in (1.0, -1.0):
            grid = start_angle + side * scale
            sums = [total(x) for x in grid]
            for k in range(len(grid) - 1):
                if sums[k] == 0.0 or sums[k] * sums[k + 1] < 0.0:
                    root = grid[k] if sums[k] == 0.0 else brentq(total, grid[k], grid[k + 1], xtol=1e-14)
                    if total(root + 1e-6) < total(root - 1e-6):  # stable
                        best.append(float(root))
                        break
        if not best:
            raise ValueError("no equilibrium: a constant torque, and neither spring nor friction to hold it")
        angle = min(best, key=lambda x: abs(x - start_angle))
        return angle, angle + self._twist(-base_torque(angle), place)

    def start_state(self, start: str, start_angle: float, place: float) -> Array:
        """State at sample 0 at rest."""
        z = np.zeros(len(self.system.a))
        if start == "released":
            base, motor = start_angle, start_angle + place * 0.5 * self.par["gap"]
        else:
            base, motor = self.equilibrium(start_angle, place)
            if self.system.lag_state >= 0:
                z[self.system.lag_state] = self.par["bias"]
        z[: self.system.nq] = base * self.mech.lift[0] + (motor - base) * self.mech.lift[1]
        return z

    def run(
        self,
        reference: Array,
        controller: dict[str, Any],
        *,
        command_row: int = -1,
        start: str = "released",
        start_angle: float = 0.0,
        gap_place: float = 0.0,
        zero_angle: float = 0.0,
        accel_offset: float = 0.0,
        accel_sigma: float = 0.0,
        accel_zero: float | None = None,
        rounding: bool = True,
        rng: np.random.Generator | None = None,
        pushes: Pushes | None = None,
    ) -> Output:
        """One run. Angles in rad, `gap_place` in [-1, 1] of half the gap, offset and sigma in counts before
        rounding; `pushes` disturb it.

        `accel_zero` None: measured as the station does, the mean of 0.2 s at rest before the test.
        """
        rng = rng or np.random.default_rng(0)
        rate = self.rig["sample_rate"]
        n = len(reference)
        noise = accel_sigma * rng.standard_normal(n)
        before = accel_sigma * rng.standard_normal(round(0.2 * rate))
        slip, snag = self._events(n, rng)
        none = np.zeros(n)
        state = self.start_state(start, start_angle, gap_place)
        if pushes is not None:
            noise = noise + pushes.noise
            nq = self.system.nq
            state[:nq] += pushes.bend * self.mech.lift[2]
            state[nq : 2 * nq] += pushes.speed * self.mech.lift[0]
        p = self.par | {
            "acc_offset": accel_offset,
            "rounding": float(rounding),
            "command_row": float(command_row),
            "zero": zero_angle * self.rig["encoder"]["counts_per_revolution"] / (2 * math.pi),
        }
        par = np.array([p[name] for name in kernel.PARAMETERS])
        kind, num, den, acc_num, acc_den = compensator(controller, rate)
        if accel_zero is None:
            accel_zero = (
                float(np.mean([kernel.read_accel(kernel.scale_accel(0.0, x, par), par) for x in before]))
                if kind == 2
                else 0.0
            )
        if kind == 2 and not self.has_accelerometer:
            raise ValueError("lead_accel: this rig has no accelerometer")
        s = self.system
        encoder, accel, command, trace = kernel.run_kernel(
            np.ascontiguousarray(reference, float),
            noise,
            slip,
            snag,
            none if pushes is None else pushes.torque,
            none if pushes is None else pushes.drift,
            none if pushes is None else pushes.force,
            pushes is not None,
            num,
            den,
            acc_num,
            acc_den,
            kind,
            accel_zero,
            self.pieces["h"],
            self.pieces["n"],
            self.pieces["encoder"],
            self.pieces["accel"],
            self.pieces["switch"],
            self.which,
            self.a,
            self.b,
            self.g,
            s.c_port,
            s.c_encoder,
            s.c_acc,
            s.d_acc,
            self.c_load,
            par,
            state,
            self.par["bias"],
            self.nonlinear,
        )
        return Output(
            t=np.arange(n) / rate,
            reference=np.asarray(reference, float),
            command=command,
            encoder=encoder,
            accel=accel if self.has_accelerometer else None,
            accel_zero=accel_zero if kind == 2 else 0.0,
            trace=trace,
        )

    def _events(self, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Counts lost so far, and whether the cable is caught, tick by tick; drawn anew for each run."""
        slip, snag = np.zeros(n), np.zeros(n)
        first = int(0.2 / self.period)
        if "encoder_slip" in self.outside:
            o = self.outside["encoder_slip"]
            at = first + rng.exponential(o["mean_time"]) / self.period
            at = min(at, 0.7 * n)  # at least one in every run
            while at < n:
                slip[int(at) :] += o["counts"]
                at += rng.exponential(o["mean_time"]) / self.period + 10
        if "cable_snag" in self.outside:
            o = self.outside["cable_snag"]
            at, on = 0.0, bool(rng.integers(2))
            while at < n:
                stop = at + rng.exponential(o["mean_time"]) / self.period
                snag[int(at) : int(min(stop, n))] = float(on)
                at, on = stop, not on
        return slip, snag

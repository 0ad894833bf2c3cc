"""Pictures of a joint: its torque, or the share of it that the joint carries, against its wind-up."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from station.model.along import joint_torque
from station.model.effects import Effect, Stage
from station.pictures.missing import MissingTorque, missing_torque
from station.pictures.picture import PLACES, Cause, Evidence, count, grid_over, thin
from station.pictures.torques import estimates, joined
from station.runs.run import Run

DRIFT = 0.5
"""Share of a joint's wind-up (rms) by which two accounts of it may differ where its spring's law is drawn."""
CARRIED = 0.05
"""Share of a joint's largest torque below which what it carries is not drawn as a share: that would be noise."""


def wind_up(cause: Cause, effect: Effect) -> list[Evidence]:
    """The drive or clamp against its wind-up: a spring by its torque, play by the share of the torque that it carries.

    Play is drawn as a share because a damper's torque, which has no place on the axis, may outweigh the spring's.
    """
    at, h = effect.at, cause.extended.period
    each = estimates(cause, at)
    seen = [k for k, one in enumerate(each) if _wind_up_is_seen(cause, effect, cause.runs[k], one)]
    if not seen:
        return [_unseen_wind_up(cause, at)]
    cause = cause._replace(runs=[cause.runs[k] for k in seen])
    found, joint = joined([each[k] for k in seen]), getattr(cause.extended, at)
    angle, speed = found.angle, found.speed
    total = joint_torque(cause.without, at, angle, speed, h) - found.torque
    label = f"{'motor - base' if at == 'drive' else 'base - beam root'} (rad)"
    source = f"Points: spring and damper of the {at} plus what is missing there, smoothed from {count(cause.runs)}"
    if effect.stage is Stage.GAP:
        linear = joint.stiffness * angle + joint.damping * speed
        clear = np.abs(linear) > CARRIED * np.max(np.abs(linear))
        share = joint_torque(cause.extended, at, angle, speed, h)[clear] / linear[clear]
        return [thin(f"Share of its torque that the {at} carries, against its wind-up: {cause.title}", "deflection",
                     label, f"torque of the {at} over the same without play", angle[clear],
                     total[clear] / linear[clear], _running_median(angle[clear], share),
                     f"{source}, over what it would carry without play; rows with less than "
                     f"{100.0 * CARRIED:g} % of the largest torque are left out. The smoothing rounds the edges of the "
                     "gap and fills it in part. Line: the fitted law on the same motion, its median.")]
    grid = grid_over(angle)
    doubt = ("" if at == "drive" else " The sensors tell this torque better than the wind-up, which is estimated "
             "towards that of a linear clamp: where the law is steep, points lie inside it.")
    return [thin(f"Torque of the {at} against its wind-up: {cause.title}", "deflection", label,
                 f"torque of the {at} less its damper (N m)", angle, total - joint.damping * speed,
                 (grid, joint_torque(cause.extended, at, grid, np.zeros(len(grid)), h)),
                 f"{source}; the damper's part is taken off. Line: the fitted law.{doubt}")]


def _wind_up_is_seen(cause: Cause, effect: Effect, run: Run, found: MissingTorque) -> bool:
    """Whether the sensors tell a joint's wind-up in a run well enough to draw its law against it.

    No sensor reads the motor.  Its place is worked out from the command, and a small torque that the model lacks makes
    it drift.  Two accounts meet the readings alike: a torque missing in the joint (``found``), and with the cause in
    its place one at the motor.  They must put the wind-up closer together than the play is wide, or of a spring than
    DRIFT of the wind-up itself (rms).
    """
    other = missing_torque(cause.extended, run, "motor", along=effect.at, accelerometer=found.by_accel)
    allowed = effect.values()["gap"] if "gap" in effect.values() else DRIFT * _rms(other.angle)
    return _rms(found.angle - other.angle) <= allowed


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _unseen_wind_up(cause: Cause, at: str) -> Evidence:
    """Why there is no picture of a joint's law."""
    nothing = np.zeros(0)
    return Evidence(f"Torque of the {at} against its wind-up: {cause.title}", "none", "", "", nothing, nothing,
                    note=f"Not drawn: these runs do not show the wind-up of the {at}. No sensor reads the motor's own "
                         "angle, and what little torque the model lacks there lets its estimate drift by more than "
                         "the law bends. This speaks neither for the cause nor against it.")


def _running_median(x: np.ndarray, y: np.ndarray, width: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Median of y over neighbours in x."""
    order = np.argsort(x)
    every = max(len(x) // PLACES, 1)
    return x[order][::every], median_filter(y[order], size=width, mode="nearest")[::every]

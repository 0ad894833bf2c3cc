"""The rig's state while a test runs, estimated by its linear model from the command, encoder and accelerometer.

A stationary Kalman filter (Anderson and Moore, Optimal Filtering, 4.4) on the exactly sampled model:

    x- = A x + B u          u the command in force since the tick before
    x  = x- + M (y - C x- - D u),    M = P C' (C P C' + R)^-1

with P from the discrete algebraic Riccati equation.  What the model leaves out is taken for a torque at the motor and
for speeds that change at random from tick to tick.  On simulated steps the tip's deflection is met to 10 % (rms) on the
model's own rig, to 14 % where tip.mass and clamp.stiffness are 10 % off, to 28 % where tip.mass is 30 % and the beam's
rigidity 20 % off.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg

from station.model.assembly import assemble
from station.model.linear import sampled
from station.rig import Rig

DISTURBANCE = 0.1
"""Standard deviation of the unknown torque, as a share of the motor's at the command's limit."""
SPEED_SIGMA = 0.01
"""The same of every speed, m/s and rad/s in a tick: what keeps a model that is off from believing itself."""
ACCEL_SIGMA = 3.0
"""Of the accelerometer's reading, counts: its noise, and the modes that the estimate does not follow."""
REST_ROWS = 50
"""So many rows at the beginning tell the accelerometer's reading at rest."""


class Observer:
    """Follows one test; a rig without a beam has no deflection."""

    def __init__(self, rig: Rig) -> None:
        model, self._parts = sampled(rig), assemble(rig)
        self._a, self._b = np.asarray(model.A), np.asarray(model.B)[:, 0]
        self._c, self._d = np.asarray(model.C), np.asarray(model.D)[:, 0]
        self._per_count = rig.angle_per_count
        drive = np.outer(self._b, self._b) * (DISTURBANCE * rig.amplifier.limit) ** 2
        noise = np.diag([1.0 / 12.0, ACCEL_SIGMA**2][:len(self._c)])
        unknown = np.repeat([1e-12, SPEED_SIGMA**2], self._parts.size)
        self._gain: np.ndarray | None = None
        try:
            spread = scipy.linalg.solve_discrete_are(self._a.T, self._c.T, drive + np.diag(unknown), noise)
            self._gain = spread @ self._c.T @ np.linalg.inv(self._c @ spread @ self._c.T + noise)
        except (ValueError, np.linalg.LinAlgError):  # the equation is too badly conditioned: a straight arm is drawn
            pass
        self._along = np.linspace(0.0, rig.beam.length if rig.beam else 0.0, len(self._parts.nodes) + 1)
        self._x: np.ndarray | None = None
        self._command = 0.0
        self._rest: list[float] = []

    def see(self, command: float, encoder: float, accel: float) -> None:
        """One row: readings (counts) at a tick, and the command (counts) that is in force from it on."""
        if self._x is None or self._gain is None:
            self._x = np.concatenate((self._parts.rigid * encoder * self._per_count, np.zeros(self._parts.size)))
        if self._gain is None:
            return
        if len(self._rest) < REST_ROWS:
            self._rest.append(accel)
        x = self._a @ self._x + self._b * self._command
        read = np.array([encoder, accel - math.fsum(self._rest) / len(self._rest)])[:len(self._c)]
        self._x = x + self._gain @ (read - self._c @ x - self._d * self._command)
        self._command = command

    @property
    def angle(self) -> float:
        """Base angle, rad."""
        return 0.0 if self._x is None else float(self._x[self._parts.base])

    @property
    def deflection(self) -> np.ndarray:
        """(nodes + 1,) m: how far each node is off the straight line at the base's angle, from the root to the tip."""
        if self._x is None or not len(self._parts.nodes):
            return np.zeros(2)
        across = np.concatenate(([0.0], self._x[self._parts.nodes]))
        return across - self.angle * self._along

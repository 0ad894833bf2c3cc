"""The linear model in state space, continuous and exactly sampled.

x = [q, q'], x' = A x + B u (see assembly), u the command.  Outputs in counts: the encoder N/(2 pi) theta_base,
and the accelerometer's gain times the tip's acceleration, a row of q'' = -M^-1 K q - M^-1 C q' + M^-1 F u.
"""

from __future__ import annotations

import control
import numpy as np
import scipy.linalg

from station.model.assembly import Assembly, assemble, state_matrix, strain, torque_input
from station.rig import Rig


def state_space(rig: Rig, parts: Assembly | None = None) -> control.StateSpace:
    """Continuous model from command (counts) to encoder and accelerometer (counts); effects are left out.

    ``parts``: other matrices for the same rig, such as a lumped chain; by default those of ``assemble``.
    """
    parts = assemble(rig) if parts is None else parts
    n = parts.size
    a = state_matrix(parts)
    b = rig.motor.gain * torque_input(parts, parts.unit(parts.motor))
    c, d, outputs = [np.zeros(2 * n)], [0.0], ["encoder"]
    c[0][parts.base] = 1.0 / rig.angle_per_count
    if rig.accelerometer is not None and parts.tip is not None:
        c.append(rig.accelerometer.gain * a[n + parts.tip])
        d.append(rig.accelerometer.gain * b[n + parts.tip])
        outputs.append("accel")
    return control.ss(a, b[:, None], np.array(c), np.array(d)[:, None], inputs=["command"], outputs=outputs,
                      name=rig.name)


def sampled(rig: Rig) -> control.StateSpace:
    """The same under a zero-order hold at the rig's sample rate, exact by the matrix exponential."""
    return control.sample_system(state_space(rig), rig.period, method="zoh")


def natural_frequencies(rig: Rig) -> np.ndarray:
    """Undamped natural frequencies, Hz, ascending, the rigid mode's 0 included.

    With K = R^T R and M = L L^T they are the singular values of R L^-T, and 0.  Rounding moves these by a share of the
    highest frequency, where it moves eigenvalues by that share of its square: 200 elements leave the lowest mode ten
    digits, not five.
    """
    lower = scipy.linalg.cholesky(assemble(rig).mass, lower=True)
    whitened = scipy.linalg.solve_triangular(lower, strain(rig).T, lower=True)
    singular = scipy.linalg.svdvals(whitened) if whitened.size else np.zeros(0)
    return np.concatenate([[0.0], np.sort(singular)]) / (2.0 * np.pi)

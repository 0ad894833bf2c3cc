"""What a designer asks of a plant in state space: its closed loop, poles, zeros, and what each mode can do
and show.

Functions take ``control.StateSpace`` plants, continuous or sampled, with one input (the command, counts)
and named outputs (counts).  They know nothing of rigs.
"""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np
import scipy.linalg

from station.errors import UsageError

ORIGIN = 1e-7
"""Poles and zeros below this share of the median pole are taken to be 0: what rounding leaves of a double root."""


def _row(plant: control.StateSpace, output: str) -> int:
    if output not in plant.output_labels:
        raise UsageError(f"output {output!r}: this plant has {', '.join(plant.output_labels)}")
    return int(plant.output_labels.index(output))


def proportional_loop(plant: control.StateSpace, gain: float, output: str = "encoder") -> control.StateSpace:
    """The loop u = gain (r - y) on one output, in state space: A - B gain C with the reference input B gain.

    On the sampled plant this is the loop with the same hold, the command of a tick computed from that
    tick's reading. ``output`` must not jump with the command (D = 0), as no reading taken at the tick does.
    """
    row = _row(plant, output)
    c, through = plant.C[row:row + 1], plant.D[row, 0]
    if through != 0.0:
        raise UsageError(f"output {output!r}: jumps with the command, so that the loop has no order")
    return control.ss(plant.A - gain * plant.B @ c, gain * plant.B, plant.C - gain * plant.D @ c, gain * plant.D,
                      plant.dt, inputs=["reference"], outputs=plant.output_labels)


@dataclass(frozen=True)
class ZeroPoleGain:
    """gain prod(s - zeros) / prod(s - poles), and a static factor for what was left out."""

    zeros: np.ndarray
    poles: np.ndarray
    gain: float

    @property
    def nonminimum_phase(self) -> np.ndarray:
        """Zeros in the right half plane (a continuous plant), ascending in size."""
        size = np.abs(self.zeros)
        return self.zeros[self.zeros.real > 1e-6 * np.maximum(size, 1.0)]

    def __call__(self, s: np.ndarray | complex) -> np.ndarray:
        """Value at complex s of any shape."""
        s = np.asarray(s, dtype=complex)[..., None]
        return self.gain * np.exp(np.log(s - self.zeros).sum(-1) - np.log(s - self.poles).sum(-1))


def transfer_function(plant: control.StateSpace, output: str, below: float = np.inf) -> ZeroPoleGain:
    """From command to ``output`` of a continuous plant, in factors.

    Poles and zeros larger than ``below`` (rad/s) are left out and only their gain at rest is kept, which is
    a reduced model: good where |s| is much smaller.  Factors at the origin stay.
    """
    row = _row(plant, output)
    one = control.ss(plant.A, plant.B, plant.C[row], plant.D[row])
    zeros, poles = (np.asarray(v, dtype=complex) for v in (one.zeros(), one.poles()))
    zeros, poles = zeros[np.argsort(np.abs(zeros))], poles[np.argsort(np.abs(poles))]
    origin = ORIGIN * float(np.median(np.abs(poles)))
    zeros, poles = (np.where(np.abs(v) < origin, 0.0, v) for v in (zeros, poles))
    # The gain, at a point that is no pole or zero and where the plant is well conditioned.
    probe = np.abs(poles[np.abs(poles) > 0.0]).min() * (0.6 + 0.4j) if np.any(np.abs(poles) > 0.0) else 1.0 + 1.0j
    ratio = np.exp(np.log(probe - zeros).sum() - np.log(probe - poles).sum())
    gain = float((complex(one(probe)) / ratio).real)
    kept_zeros, kept_poles = zeros[np.abs(zeros) <= below], poles[np.abs(poles) <= below]
    left = np.exp(np.log(-zeros[np.abs(zeros) > below]).sum() - np.log(-poles[np.abs(poles) > below]).sum())
    return ZeroPoleGain(kept_zeros, kept_poles, gain * float(left.real))


@dataclass(frozen=True)
class Mode:
    """One mode of a plant: a real pole, or a pair (listed once, the pole above the real axis)."""

    pole: complex
    """rad/s."""
    damping: float
    """Ratio -Re / |pole|; 1 for a real pole, 0 at the origin."""
    controllability: float
    """Cosine between the input and the left eigenvector, 0 to 1, in balanced coordinates; 0: out of reach."""
    observability: dict[str, float]
    """By output: cosine between its row and the right eigenvector; 0: unseen."""
    residue: dict[str, complex]
    """By output: the mode's part of the transfer function is residue / (s - pole)."""

    @property
    def frequency(self) -> float:
        """|pole| / 2 pi, Hz."""
        return abs(self.pole) / (2.0 * np.pi)


def modes(plant: control.StateSpace) -> list[Mode]:
    """Modes of a continuous plant, ascending in frequency: damping, and reach from the input and to every
    output.

    The cosines are taken after balancing the state matrix by a diagonal scaling, since their size means
    nothing between states of different units; the residues need no such choice.  Two poles at the origin
    without damping (a free rigid body) have no separate residues and are reported with NaN.
    """
    _, (scale, _) = scipy.linalg.matrix_balance(plant.A, permute=False, separate=True)
    a, b, c = plant.A * scale / scale[:, None], plant.B[:, 0] / scale, plant.C * scale
    values, left, right = scipy.linalg.eig(a, left=True, right=True)
    values = np.where(np.abs(values) < ORIGIN * np.median(np.abs(values)), 0.0, values)
    found = []
    for i in np.argsort(np.abs(values), kind="stable"):
        pole = complex(values[i])
        if pole.imag < 0.0:
            continue
        w, v = left[:, i], right[:, i]
        overlap = np.vdot(w, v)
        separate = abs(overlap) > 1e-7
        seen = c @ v
        reach = np.vdot(w, b) / overlap if separate else np.nan
        found.append(Mode(
            pole, 0.0 if pole == 0.0 else -pole.real / abs(pole),
            float(abs(np.vdot(w, b)) / np.linalg.norm(b)),
            {name: float(abs(y) / np.linalg.norm(row)) for name, y, row in zip(plant.output_labels, seen, c,
                                                                               strict=True)},
            {name: complex(y * reach) for name, y in zip(plant.output_labels, seen, strict=True)}))
    return found

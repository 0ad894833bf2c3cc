"""The linear model in real modal form: 2 x 2 blocks that do not touch each other.

A v = lambda v with lambda = s + j w and v = p + j q gives A [p q] = [p q] [[s, w], [-w, s]].  A function f of the
block, with f(lambda) = a + j b, is [[a, b], [-b, a]]; two real eigenvalues share a block, f = diag(f1, f2).  So
the matrix exponential and its integrals cost four numbers per block, and a step costs O(n) instead of O(n^2).
The rigid mode of a rig without any damping to ground is a Jordan block [[0, 1], [0, 0]].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from station.model.assembly import Assembly, state_matrix
from station.model.compiled import njit

JORDAN, PAIR, REAL = 0, 1, 2
ITSELF, EXPONENTIAL, INTEGRAL = 0, 1, 2
"""Functions of the blocks."""


@dataclass(frozen=True)
class ModalForm:
    """x = basis z; blocks of z in order.

    z holds the first coordinate of every block, then the second of every block, so that a step is four products of
    whole rows.  kind (b): JORDAN, PAIR or REAL; eigenvalues (b, 2) complex: of a pair lambda and its conjugate, of a
    real block both; basis (2n, 2b), inverse (2b, 2n).
    """

    kind: np.ndarray
    eigenvalues: np.ndarray
    basis: np.ndarray
    inverse: np.ndarray

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.kind.size

    def columns(self, blocks: np.ndarray) -> np.ndarray:
        """Where some blocks (indices) stand in z."""
        return np.concatenate([blocks, self.blocks + blocks])

    def select(self, keep: np.ndarray) -> ModalForm:
        """The same with only some blocks (indices): a modal truncation."""
        columns = self.columns(keep)
        return ModalForm(self.kind[keep], self.eigenvalues[keep], self.basis[:, columns], self.inverse[columns])

    def rates(self) -> np.ndarray:
        """A itself, (4, b): of each block [[f0, f1], [f2, f3]]."""
        return _function(self.kind, self.eigenvalues, ITSELF, 1.0)

    def exponential(self, h: float) -> np.ndarray:
        """e^(A h), (4, b)."""
        return _function(self.kind, self.eigenvalues, EXPONENTIAL, h)

    def integral(self, h: float) -> np.ndarray:
        """int_0^h e^(A s) ds, (4, b): the effect of an input held over h."""
        return _function(self.kind, self.eigenvalues, INTEGRAL, h)


def apply(blocks: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Blocks (4, b) times a vector (2b) or the columns of a matrix (2b, m)."""
    a, b, c, d = blocks[..., None] if vector.ndim == 2 else blocks
    half = len(vector) // 2
    one, two = vector[:half], vector[half:]
    return np.concatenate([a * one + b * two, c * one + d * two])


def dense(blocks: np.ndarray) -> np.ndarray:
    """Blocks (4, b) as one matrix (2b, 2b)."""
    one = np.arange(blocks.shape[1])
    other, out = len(one) + one, np.zeros((2 * len(one), 2 * len(one)))
    out[one, one], out[one, other], out[other, one], out[other, other] = blocks
    return out


@njit(cache=True)
def _scalar(which, z, h):
    """A function of an eigenvalue."""
    if which == ITSELF:
        return z
    zh = z * h
    growth = math.exp(zh.real)
    sine, half = math.sin(zh.imag), math.sin(0.5 * zh.imag)
    if which == EXPONENTIAL:
        return complex(growth * math.cos(zh.imag), growth * sine)
    if abs(zh) < 1e-8:
        return h * (1.0 + 0.5 * zh)
    return h * complex(math.expm1(zh.real) - 2.0 * growth * half * half, growth * sine) / zh    # (e^zh - 1) / z


@njit(cache=True)
def _function(kind, eigenvalues, which, h):
    """(4, b) a function f of every block; of a Jordan block at 0 it holds f(0) and f'(0)."""
    out = np.zeros((4, kind.size))
    for i in range(kind.size):
        first = _scalar(which, eigenvalues[i, 0], h)
        out[0, i], out[3, i] = first.real, first.real
        if kind[i] == PAIR:
            out[1, i], out[2, i] = first.imag, -first.imag
        elif kind[i] == REAL:
            out[3, i] = _scalar(which, eigenvalues[i, 1], h).real
        else:
            out[1, i] = 1.0 if which == ITSELF else h if which == EXPONENTIAL else 0.5 * h * h
    return out


def modal_form(assembly: Assembly) -> ModalForm:
    """Decouple the rig's state equation; all modes kept, ascending in |lambda|.

    Critical damping to the last digit makes A defective.  A change of the damping by parts in 10^9 then restores a
    full set of eigenvectors; it moves the answer by less than 10^-6 of itself.
    """
    for nudge in (0.0, 1e-10, 1e-8, 1e-6):
        a = state_matrix(assembly)
        n = assembly.size
        a[n:, n:] *= 1.0 + nudge * np.arange(1, n + 1)
        form = _decouple(a, assembly)
        if form is not None:
            return form
    raise ArithmeticError("the rig's eigenvectors cannot be separated; check its constants")


def _decouple(a: np.ndarray, assembly: Assembly) -> ModalForm | None:
    n = assembly.size
    values, vectors = np.linalg.eig(a)
    order = np.argsort(np.abs(values), kind="stable")
    values, vectors = values[order], vectors[:, order]
    kinds, eigenvalues, firsts, seconds = [], [], [], []
    scale = max(abs(values[-1]), 1.0)
    free = not np.any(assembly.damping @ assembly.rigid)
    rigid = np.concatenate([assembly.rigid, np.zeros(n)])
    if free:
        kinds.append(JORDAN)
        eigenvalues.append((0.0, 0.0))
        firsts.append(rigid[:, None])
        seconds.append(np.concatenate([np.zeros(n), assembly.rigid])[:, None])
        values, vectors = values[2:], vectors[:, 2:]
    else:
        values[0], vectors[:, 0] = 0.0, rigid
    real = np.abs(values.imag) <= 1e-12 * np.maximum(np.abs(values), 1e-12 * scale)
    pairs, reals = np.flatnonzero(~real & (values.imag > 0.0)), np.flatnonzero(real)
    if reals.size % 2 or 2 * (len(kinds) + pairs.size) + reals.size != 2 * n:
        return None
    one, other = reals.reshape(-1, 2).T
    kind = np.array(kinds + [PAIR] * pairs.size + [REAL] * one.size)
    all_values = np.concatenate([
        np.array(eigenvalues, dtype=complex).reshape(-1, 2), np.stack([values[pairs], values[pairs].conj()], axis=1),
        np.stack([values[one].real, values[other].real], axis=1)])
    basis = np.concatenate([*firsts, vectors[:, pairs].real, vectors[:, one].real,
                            *seconds, vectors[:, pairs].imag, vectors[:, other].real], axis=1)
    try:
        inverse = np.linalg.inv(basis)
    except np.linalg.LinAlgError:
        return None
    form = ModalForm(kind, all_values, basis, inverse)
    error = np.linalg.norm(basis @ apply(form.rates(), inverse) - a) / np.linalg.norm(a)
    return form if error < 1e-7 else None

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
from scipy.linalg.lapack import dgeev

from station.model.assembly import Assembly, state_matrix
from station.model.compiled import njit

JORDAN, PAIR, REAL = 0, 1, 2
ITSELF, EXPONENTIAL, INTEGRAL = np.int64(0), np.int64(1), np.int64(2)
"""Functions of the blocks; for each plain integer Numba would compile them once more."""
SMALL = 1e-3
"""Of a change to first order, the share of it that is wrong."""


@dataclass(frozen=True, eq=False)
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

    def moved(self, change: np.ndarray) -> ModalForm | None:
        """The form where A has changed by so much (2n, 2n), to first order; None where that is not small, or where this
        form has a Jordan block.

        With E = V^-1 change V: lambda_i + E_ii, V (I + X), (I - X) V^-1, where X_ij = E_ij/(lambda_j - lambda_i)
        (Wilkinson, The Algebraic Eigenvalue Problem, 1965, chapter 2).  It is small where the second order, E_ij X_ji,
        moves no eigenvalue by more than SMALL of what the first moves one, both over the eigenvalue.
        """
        if JORDAN in self.kind:
            return None
        e = self.inverse @ (change @ self.basis)
        moved, mixed = _first_order(self.kind, self.eigenvalues, e)
        size = np.maximum(np.abs(self.eigenvalues), 1e-300).T.ravel()
        first = np.abs(moved - self.eigenvalues).T.ravel() / size
        second = np.abs(np.einsum("ij,ji->i", e, mixed)) / size
        if not np.all((second <= SMALL * first.max()) | (self.eigenvalues.T.ravel() == 0.0)):
            return None
        return ModalForm(self.kind, moved, self.basis + self.basis @ mixed, self.inverse - mixed @ self.inverse)

    def rates(self) -> np.ndarray:
        """A itself, (4, b): of each block [[f0, f1], [f2, f3]]."""
        return function(self.kind, self.eigenvalues, ITSELF, 1.0)

    def exponential(self, h: float) -> np.ndarray:
        """e^(A h), (4, b)."""
        return function(self.kind, self.eigenvalues, EXPONENTIAL, h)

    def integral(self, h: float) -> np.ndarray:
        """int_0^h e^(A s) ds, (4, b): the effect of an input held over h."""
        return function(self.kind, self.eigenvalues, INTEGRAL, h)


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
def function(kind, eigenvalues, which, h):
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


@njit(cache=True)
def _first_order(kind, eigenvalues, e):
    """(b, 2) eigenvalues and X (2b, 2b), in the blocks' coordinates, as is E; in between, a pair's [p q] become v and
    its conjugate, [p q] [[1, 1], [j, -j]]."""
    b, moved, mixed = kind.size, eigenvalues.copy(), np.zeros_like(e)
    for i in range(b):
        for j in range(b):
            w, x = complex(e[i, j]), complex(e[i, b + j])
            y, z = complex(e[b + i, j]), complex(e[b + i, b + j])
            if kind[i] == PAIR:
                w, x, y, z = 0.5 * (w - 1j * y), 0.5 * (x - 1j * z), 0.5 * (w + 1j * y), 0.5 * (x + 1j * z)
            if kind[j] == PAIR:
                w, x, y, z = w + 1j * x, w - 1j * x, y + 1j * z, y - 1j * z
            one, other = eigenvalues[i]
            if i == j:
                moved[i, 0] += w if one != 0.0 else 0.0    # the rigid mode's stays
                moved[i, 1] += z
                w, x, y, z = 0j, x / (other - one), y / (one - other), 0j
            else:
                w, x = w / (eigenvalues[j, 0] - one), x / (eigenvalues[j, 1] - one)
                y, z = y / (eigenvalues[j, 0] - other), z / (eigenvalues[j, 1] - other)
            if kind[j] == PAIR:
                w, x, y, z = 0.5 * (w + x), 0.5j * (x - w), 0.5 * (y + z), 0.5j * (z - y)
            if kind[i] == PAIR:
                w, x, y, z = w + y, x + z, 1j * (w - y), 1j * (x - z)
            mixed[i, j], mixed[i, b + j], mixed[b + i, j], mixed[b + i, b + j] = w.real, x.real, y.real, z.real
    return moved, mixed


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
    n, still = assembly.size, np.zeros(assembly.size)
    real, imaginary, _, vectors, failed = dgeev(a, compute_vl=0)    # of a pair p and q, one column beside the other
    if failed:
        return None
    order = np.argsort(np.hypot(real, imaginary), kind="stable")
    values, vectors = (real + 1j * imaginary)[order], vectors[:, order]
    size = np.abs(values)
    floor = 1e-12 * max(size[-1], 1.0)
    rigid = np.concatenate([assembly.rigid, still])
    free = not np.any(assembly.damping @ assembly.rigid)
    if free:
        values, vectors, size = values[2:], vectors[:, 2:], size[2:]
    else:
        values[0], vectors[:, 0] = 0.0, rigid
    alone = np.abs(values.imag) <= 1e-12 * np.maximum(size, floor)
    pairs, reals = np.flatnonzero(~alone & (values.imag > 0.0)), np.flatnonzero(alone)
    if reals.size % 2 or 2 * (free + pairs.size) + reals.size != 2 * n:
        return None
    one, other = np.concatenate([pairs, reals[::2]]), np.concatenate([pairs + 1, reals[1::2]])
    kind = np.repeat([PAIR, REAL], [pairs.size, reals.size // 2])
    eigenvalues, firsts, seconds = np.stack([values[one], values[other]], axis=1), vectors[:, one], vectors[:, other]
    if free:
        kind, eigenvalues = np.append(JORDAN, kind), np.concatenate([np.zeros((1, 2)), eigenvalues])
        firsts = np.column_stack([rigid, firsts])
        seconds = np.column_stack([np.concatenate([still, assembly.rigid]), seconds])
    basis = np.concatenate([firsts, seconds], axis=1)
    try:
        inverse = np.linalg.inv(basis)
    except np.linalg.LinAlgError:
        return None
    form = ModalForm(kind, eigenvalues, basis, inverse)
    error = np.linalg.norm(basis @ apply(form.rates(), inverse) - a) / np.linalg.norm(a)
    return form if error < 1e-7 else None

"""The laboratory's tab-separated logs: columns named in the last header line, the compensator before it.

The header is parsed, never evaluated: ``kp=2.0``, or the coefficients of a compensator in z as numpy prints
them, highest power first (``Gth num=[ 18.32547182 -17.20911971]``, then ``Gth den``, ``Ga num``, ``Ga den``).
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from station.control.compensators import tustin_lead
from station.errors import WorkError
from station.runs.run import Run, RunMetadata
from station.runs.table import read_table

NAMES = {"t": "t", "n": "n", "u": "reference", "v": "command", r"$\theta$": "encoder", "a": "accel",
         r"$\hat{\theta}_d$": "reference_shaped"}
REST_ROWS = 10

_GAIN = re.compile(r"\s*(kp|ki|kd)\s*=\s*(\S+)\s*\Z")
_POLYNOMIAL = re.compile(r"\s*(Gth|Ga)\s+(num|den)\s*=\s*\[([^\]]*)\]\s*\Z")
_DECIMAL = re.compile(r"[-+]?\d+\.?(\d*)(?:[eE][-+]?\d+)?\Z")


@dataclass(frozen=True)
class Polynomial:
    """Coefficients as printed, highest power of z first, and half a unit of their last printed digit."""

    values: tuple[float, ...]
    rounding: float


def read_lab_log(path: str | os.PathLike[str]) -> Run:
    """Read a log; WorkError, one line naming the file, for unknown columns or an unknown compensator.

    The board computes a row's command from its reference and the encoder and accelerometer one row
    earlier, and latches it at the tick (``command_row`` -1).  A command with fractions was logged before rounding
    (``rounding`` false).  The column ``reference_shaped`` is the reference after the accelerometer loop.
    """
    path = Path(path)
    table = read_table(path, "\t", names_in_header=True)
    unknown = [name for name in table.names if name not in NAMES]
    if unknown:
        raise WorkError(f"{path}: the column names {' '.join(table.names)[:80]!r} are not those of a laboratory "
                        f"log ({' '.join(NAMES)})")
    columns = {NAMES[name]: values for name, values in zip(table.names, table.values.T, strict=True)}
    header = [line for _, line in table.comments[:-1]]
    run = Run.from_columns(str(path), path.stem, columns, RunMetadata(), table.first_line)
    controller = _controller(path, header, run)
    resting = bool(np.all(run.encoder[:REST_ROWS] == run.encoder[0]))
    metadata = RunMetadata(  # type: ignore[call-arg]  # other keys are kept
        rig="sflr" if any(re.search(r"\bS(FL|LF)R", line) for line in header) else "",
        controller=controller,
        test=guess_test(run.reference, run.sample_rate),
        command_row=-1,
        start="equilibrium" if resting else "released",
        rounding=bool(np.all(run.command == np.floor(run.command))),
        header=header,
    )
    return Run.from_columns(str(path), path.stem, run.columns(), metadata)


def _controller(path: Path, header: list[str], run: Run) -> dict[str, Any]:
    gains: dict[str, float] = {}
    polynomials: dict[str, Polynomial] = {}
    for line in header:
        if match := _GAIN.match(line):
            gains[match[1]] = _polynomial(path, line, match[2]).values[0]
        elif match := _POLYNOMIAL.match(line):
            polynomials[f"{match[1]} {match[2]}"] = _polynomial(path, line, match[3])
    if polynomials:
        return _lead(path, polynomials, run.sample_rate)
    if gains.get("ki") or gains.get("kd"):
        return {"kind": "unknown"}  # how that program sampled them is not known
    if "kp" in gains:
        return {"kind": "p", "gain": gains["kp"]}
    return {"kind": "open" if np.array_equal(run.command, run.reference) else "unknown"}


def _polynomial(path: Path, line: str, text: str) -> Polynomial:
    values, decimals = [], 0
    for word in text.split():
        match = _DECIMAL.match(word)
        if not match or not math.isfinite(float(word)):
            raise WorkError(f"{path}: header line {line.strip()[:60]!r}: {word[:20]!r} is not a number")
        values.append(float(word))
        decimals = max(decimals, len(match[1]))
    return Polynomial(tuple(values), 0.5 * 10.0**-decimals)


def _lead(path: Path, polynomials: dict[str, Polynomial], sample_rate: float) -> dict[str, Any]:
    num, den = polynomials.get("Gth num"), polynomials.get("Gth den")
    if num is None or den is None or len(num.values) != 2 or len(den.values) != 2 or den.values[0] != 1.0:
        raise WorkError(f"{path}: Gth must be a lead: two coefficients over two, the first of den 1")
    controller: dict[str, Any] = {"kind": "lead", **lead_of_tustin(num, den, sample_rate)}
    if controller["gain"] is None:
        raise WorkError(f"{path}: Gth is not a lead sampled by Tustin")
    accel = [polynomials.get(f"Ga {part}", Polynomial((), 0.0)).values for part in ("num", "den")]
    if any(accel):
        if not all(accel):
            raise WorkError(f"{path}: Ga has only one of num and den")
        controller |= {"kind": "lead_accel",
                       "accel_numerator": list(accel[0]), "accel_denominator": list(accel[1])}
    return controller


def lead_of_tustin(num: Polynomial, den: Polynomial, sample_rate: float) -> dict[str, float | None]:
    """The lead gain (s + zero)/(s + pole) whose Tustin form was printed: the roundest with those digits.

    Inverts s = k (z - 1)/(z + 1), k = 2 sample_rate: pole = k (1 + a1)/(1 - a1),
    zero = k (b0 + b1)/(b0 - b1), gain = (b0 - b1)/(1 - a1).  Zero and pole are then tried with few digits, as
    multiples of pi and plain.
    """
    (b0, b1), a1, k = num.values, den.values[1], 2.0 * sample_rate
    if b0 == b1 or a1 >= 1.0:
        return {"gain": None, "zero": None, "pole": None}
    gain, zero, pole = (b0 - b1) / (1.0 - a1), k * (b0 + b1) / (b0 - b1), k * (1.0 + a1) / (1.0 - a1)
    for digits in (2, 3, 4, 5):
        for unit in (math.pi, 1.0):
            guess = _round(gain, digits), unit * _round(zero / unit, digits), unit * _round(pole / unit, digits)
            n, d = tustin_lead(*guess, sample_rate)
            if np.all(np.abs(n - num.values) <= num.rounding) and abs(d[1] - a1) <= den.rounding:
                return dict(zip(("gain", "zero", "pole"), guess, strict=True))
    return {"gain": gain, "zero": zero, "pole": pole}


def _round(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def guess_test(reference: np.ndarray, sample_rate: float) -> dict[str, Any]:
    """The kind of test that a reference shows: step (one level, kept), pulse (few, and back to the first), sweep.

    ``amplitude`` in counts from the first level, ``start`` in s, when the reference first moves.
    """
    moved = reference - reference[0]
    if not moved.any():
        return {"kind": "rest"}
    edges = np.flatnonzero(np.diff(reference)) + 1
    found = {"amplitude": float(moved[np.argmax(np.abs(moved))]), "start": float(edges[0] / sample_rate)}
    if len(edges) == 1:
        return {"kind": "step", **found}
    if len(edges) <= 20 and moved[-1] == 0.0:
        return {"kind": "pulse", **found}
    return {"kind": "sweep", **found}

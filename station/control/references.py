"""Test references: what the arm is asked to do, in counts, one value per tick.

Every test begins at rest (at least 0.2 s); ``duration`` is the whole test's length, rests included.  Amplitudes and
times default to those of the laboratory's measured logs where there is one of the kind.  All times in s, frequencies
in Hz, ``rate`` in samples per second.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from station.errors import UsageError

LEAST_REST = 0.2
MAX_ROWS = 10_000_000
_MAX_TONES = 1000


def _row(time: float, rate: float) -> int:
    return round(time * rate)


def _time(rest: float, duration: float, rate: float, rest_after: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """All-zero reference, and the times since the first rest's end of the rows between the rests."""
    begin = _row(rest, rate)
    end = _row(duration - rest if rest_after else duration, rate)
    return np.zeros(_row(duration, rate)), np.arange(max(end - begin, 0)) / rate


def step(rate: float, amplitude: float = 100.0, duration: float = 2.0, rest: float = 0.2) -> np.ndarray:
    """From 0 to amplitude after the rest."""
    reference, _ = _time(rest, duration, rate)
    reference[_row(rest, rate):] = amplitude
    return reference


def pulse(rate: float, amplitude: float = 100.0, width: float = 0.1, duration: float = 2.0, rest: float = 0.2,
          second: float | None = None) -> np.ndarray:
    """One pulse of +amplitude after the rest, one of -amplitude at ``second`` (by default 1.36 s later or half way)."""
    if second is None:
        second = rest + min(1.36, 0.5 * (duration - rest))
    reference, _ = _time(rest, duration, rate)
    for begin, level in ((rest, amplitude), (second, -amplitude)):
        reference[_row(begin, rate):_row(begin + width, rate)] = level
    return reference


def pulse_train(rate: float, amplitude: float = 100.0, width: float = 0.1, spacing: float = 0.5, pulses: int = 6,
                duration: float = 4.0, rest: float = 0.2) -> np.ndarray:
    """``pulses`` pulses, + and - by turns, that begin ``spacing`` apart."""
    reference, _ = _time(rest, duration, rate)
    for index in range(int(pulses)):
        begin = rest + index * spacing
        reference[_row(begin, rate):_row(begin + width, rate)] = amplitude if index % 2 == 0 else -amplitude
    return reference


def triangle(rate: float, amplitude: float = 100.0, period: float = 1.0, duration: float = 4.0,
             rest: float = 0.2) -> np.ndarray:
    """A triangle wave through 0, rising first."""
    reference, time = _time(rest, duration, rate)
    reference[_row(rest, rate):] = amplitude * (2.0 / math.pi) * np.arcsin(np.sin(2.0 * math.pi * time / period))
    return reference


def sweep(rate: float, amplitude: float = 50.0, f0: float = 0.0, f1: float = 40.0, duration: float = 22.0,
          rest: float = 1.0, spacing: str = "linear") -> np.ndarray:
    """A sine whose frequency goes from f0 to f1 between two rests, linearly or (``log``) by equal ratios.

    Phase, with T the time between the rests: 2 pi (f0 t + (f1 - f0) t^2 / 2T), or
    2 pi f0 T/ln(f1/f0) ((f1/f0)^(t/T) - 1).
    """
    if spacing not in ("linear", "log"):
        raise UsageError(f"test.spacing: {spacing!r} is none of linear, log")
    reference, time = _time(rest, duration, rate, rest_after=True)
    length = duration - 2.0 * rest
    if spacing == "linear":
        cycles = f0 * time + 0.5 * (f1 - f0) * time**2 / length
    else:
        if not (f0 > 0.0 and f1 > 0.0 and f0 != f1):
            raise UsageError("test.f0: a logarithmic sweep goes between two different frequencies above 0")
        ratio = math.log(f1 / f0)
        cycles = f0 * length / ratio * np.expm1(ratio * time / length)
    begin = _row(rest, rate)
    reference[begin:begin + len(time)] = amplitude * np.sin(2.0 * math.pi * cycles)
    return reference


def multisine(rate: float, amplitude: float = 50.0, f0: float = 0.5, f1: float = 25.0, tones: int = 50,
              duration: float = 10.2, rest: float = 0.2, seed: int = 0) -> np.ndarray:
    """``tones`` sines of equal size and random phase, each a whole number of periods, scaled to peak at amplitude."""
    if not 1 <= tones <= _MAX_TONES:
        raise UsageError(f"test.tones: 1 to {_MAX_TONES} are wanted, not {tones:g}")
    reference, time = _time(rest, duration, rate)
    lines = np.unique(np.round(np.linspace(f0, f1, int(tones)) * (duration - rest)))
    lines = lines[lines > 0.0]
    if not lines.size:
        raise UsageError("test.f1: no tone has a whole period in this duration")
    phases = np.random.default_rng(int(seed)).uniform(0.0, 2.0 * math.pi, lines.size)
    wave = np.zeros(len(time))
    for line, phase in zip(lines, phases, strict=True):
        wave += np.sin(2.0 * math.pi * line / (duration - rest) * time + phase)
    reference[_row(rest, rate):] = amplitude * wave / np.max(np.abs(wave))
    return reference


TAPS = {2: (1,), 3: (2,), 4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,),
        12: (11, 10, 4), 13: (12, 11, 8), 14: (13, 12, 2), 15: (14,), 16: (15, 13, 4), 17: (14,), 18: (11,),
        19: (18, 17, 14), 20: (17,)}
"""By the bits of a shift register, what is fed back beside its last: primitive polynomials, those of SciPy."""


def _maximal_length(bits: int) -> np.ndarray:
    """(2^bits - 1) zeros and ones of a shift register that begins with ones (Golomb, Shift Register Sequences, 1967).

    As ``scipy.signal.max_len_seq`` has them, which takes half a second to import: a tenth of a quick diagnosis.
    """
    shifted = [1] * bits
    for row in range(2**bits - 1 - bits):
        shifted.append(shifted[row] ^ sum(shifted[row + tap] for tap in TAPS[bits]) % 2)
    return np.array(shifted, dtype=float)


def prbs(rate: float, amplitude: float = 50.0, hold: float = 0.02, bits: int = 9, duration: float = 10.2,
         rest: float = 0.2) -> np.ndarray:
    """A binary sequence of maximal length 2^bits - 1, +-amplitude, repeated."""
    if not 2 <= bits <= 20:
        raise UsageError(f"test.bits: 2 to 20 are wanted, not {bits:g}")
    reference, time = _time(rest, duration, rate)
    levels = amplitude * (2.0 * _maximal_length(int(bits)) - 1.0)
    each = max(_row(hold, rate), 1)
    reference[_row(rest, rate):] = levels[np.arange(len(time)) // each % len(levels)]
    return reference


def chirp_burst(rate: float, amplitude: float = 50.0, f0: float = 0.5, f1: float = 25.0, length: float = 2.0,
                pause: float = 1.0, bursts: int = 3, duration: float = 10.2, rest: float = 0.2) -> np.ndarray:
    """``bursts`` times a sine whose frequency goes from f0 to f1 within ``length``, then ``pause`` at 0, if they fit.

    Each burst rises and falls over a tenth of its length (Tukey window), so that the free decay in the pause is the
    rig's own.  Phase 2 pi (f0 t + (f1 - f0) t^2 / 2 length).
    """
    if rest + length > duration + 0.5 / rate:
        raise UsageError(f"test.duration: no burst of {length:g} s fits into {duration:g} s after the rest")
    reference, _ = _time(rest, duration, rate)
    from scipy.signal.windows import tukey  # as in prbs

    rows = _row(length, rate)
    time = np.arange(rows) / rate
    burst = amplitude * tukey(rows, 0.2) * np.sin(2.0 * math.pi * (f0 * time + 0.5 * (f1 - f0) * time**2 / length))
    for index in range(int(bursts)):
        begin = _row(rest + index * (length + pause), rate)
        if begin + rows <= len(reference):
            reference[begin:begin + rows] = burst
    return reference


KINDS: dict[str, Callable[..., np.ndarray]] = {
    "step": step, "pulse": pulse, "pulse_train": pulse_train, "triangle": triangle, "sweep": sweep,
    "multisine": multisine, "prbs": prbs, "chirp_burst": chirp_burst,
}
_POSITIVE = {"duration", "width", "spacing", "period", "hold", "pulses", "length", "bursts"}


def defaults(kind: str) -> dict[str, Any]:
    """The keys of a test of this kind and their defaults; UsageError for an unknown kind."""
    if kind not in KINDS:
        raise UsageError(f"test.kind: {kind!r} is none of {', '.join(KINDS)}")
    parameters = inspect.signature(KINDS[kind]).parameters
    return {name: parameter.default for name, parameter in parameters.items() if name != "rate"}


def reference_from_test(test: Mapping[str, Any], rate: float) -> np.ndarray:
    """The reference (counts, one value per tick) of a test such as ``{"kind": "step", "amplitude": 100}``.

    Keys left out have the defaults of the function of that name.  UsageError names the key that is unknown, of
    the wrong type or out of range.
    """
    known = defaults(str(test.get("kind")))
    values = dict(known)
    for key, value in test.items():
        if key == "kind":
            continue
        if key not in known:
            raise UsageError(f"test.{key}: unknown key for kind {test['kind']!r}; choose from {', '.join(known)}")
        if isinstance(known[key], str):
            values[key] = value
        elif isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UsageError(f"test.{key}: a finite number is wanted, not {value!r}")
        elif isinstance(known[key], int) and value != int(value):
            raise UsageError(f"test.{key}: a whole number is wanted, not {value!r}")
        elif key in _POSITIVE and value <= 0:
            raise UsageError(f"test.{key}: a number above 0 is wanted, not {value!r}")
        else:
            values[key] = value
    rests = 2.0 if test["kind"] == "sweep" else 1.0
    if values["rest"] < LEAST_REST:
        raise UsageError(f"test.rest: at least {LEAST_REST:g} s, not {values['rest']:g}")
    if (values["duration"] - rests * values["rest"]) * rate < 2.0:
        raise UsageError(f"test.duration: {values['duration']:g} s leave no test after {values['rest']:g} s at rest")
    if values["duration"] * rate > MAX_ROWS:
        raise UsageError(f"test.duration: {values['duration']:g} s are more than {MAX_ROWS} rows at {rate:g} Hz")
    for key in ("f0", "f1"):
        if key in values and not 0.0 <= values[key] < 0.5 * rate:
            raise UsageError(f"test.{key}: from 0 to below half the sample rate ({0.5 * rate:g} Hz), "
                             f"not {values[key]:g}")
    return KINDS[test["kind"]](rate, **values)

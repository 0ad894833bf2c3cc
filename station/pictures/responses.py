"""Pictures over frequency: measured over simulated channels, and the response to the command.

Points never know the law: ratios are measured over channels simulated from the logged command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import signal

from station.model.effects import Effect
from station.model.modal import modal_form
from station.model.simulate import Simulation, build
from station.pictures.driven import command_driven
from station.pictures.picture import DELAYS, TOP, Cause, Evidence, count
from station.rig import Rig
from station.runs.run import Run

BANDS = 40
"""Of frequency, in which ratios are taken."""
HIGHEST = 0.3
"""Share of the sample rate up to which they reach: short of Nyquist's."""
TAPER = 0.1
"""Share of a run that is faded in and out (Tukey's window): what does not end at rest would leak."""
SPREAD = 0.1
"""Largest standard error of a ratio in a band that is drawn, a share of its size: 0.9 dB, or 6 degrees."""
FEWEST = 4
"""Spectral lines, over all runs, that a band holds at least: fewer would look coherent by themselves."""
_SENSORS = {"encoder": "angle", "accel": "acceleration"}


def over_frequency(cause: Cause, effect: Effect, quantities: tuple[str, ...]) -> list[Evidence]:
    """Measured over simulated response against frequency, in the channel on which the cause bears most."""
    found = _ratios(cause, False, lambda extended, without: np.abs(extended - without))
    if found is None:
        return []
    pictures = []
    for quantity in quantities:
        word, label, limit, of = _QUANTITIES[quantity]
        line, how = of(found.extended), "Line: the extended rig over the same, estimated alike."
        if quantity == "phase" and effect.stage in DELAYS:
            line = -360.0 * found.frequency * next(iter(effect.values().values()))
            how = "Below 0 the measured is late. Line: -360 degrees times frequency times the fitted delay."
        pictures.append(Evidence(
            f"{word} of the measured {_SENSORS[found.channel]} against the simulated, over frequency: {cause.title}",
            "frequency", "frequency (Hz)", label, found.frequency, of(found.measured), found.frequency, line,
            f"Points: cross over power spectra of {count(cause.runs)}, simulated from the logged command without "
            f"this cause; bands with a standard error above {limit} are left out. {how}"))
    return pictures


def command_response(cause: Cause) -> list[Evidence]:
    """What a wrong constant moves: the response to the command over frequency, measured and of both rigs."""
    found = _ratios(cause, True, lambda extended, without: np.abs(_decibel(extended) - _decibel(without)))
    if found is None:
        return []
    sensor = _SENSORS[found.channel]
    unit = "counts per count" if found.channel == "accel" else "counts per sample and count"
    moved = "; ".join(f"{a:.3g} Hz becomes {b:.3g} Hz" for a, b in
                      zip(_resonances(cause.without), _resonances(cause.extended), strict=False))
    modes = f" Modes below {TOP * cause.extended.sample_rate:g} Hz: {moved}." if moved else ""
    return [Evidence(
        f"Response of the {sensor} to the command, over frequency: {cause.title}", "frequency", "frequency (Hz)",
        f"{sensor} over command (dB, {unit})", found.frequency, _decibel(found.measured), found.frequency,
        _decibel(found.extended),
        f"Points: cross over power spectra of {count(cause.runs)}; bands with a standard error above 0.9 dB are left "
        f"out. Lines: both rigs from the logged command, estimated alike.{modes}", _decibel(found.without))]


class _Ratios(NamedTuple):
    """Measured, extended and without the cause over the same input, (m) in bands, in the channel that shows it best."""

    channel: str
    frequency: np.ndarray
    measured: np.ndarray
    extended: np.ndarray
    without: np.ndarray


def _ratios(cause: Cause, over_command: bool, weigh: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> _Ratios | None:
    """Over the command or over the rig without the cause; shown is the channel of the largest sum of what ``weigh``
    says of the extended rig and of that without the cause."""
    sources: list[Sequence[Run | Simulation]] = [
        cause.runs, *([command_driven(rig, run) for run in cause.runs] for rig in (cause.extended, cause.without))]
    best, most = None, -1.0
    for channel in _channels(cause):
        moves = [[_moves(getattr(one, channel), channel) for one in ones] for ones in sources]
        inputs = [run.command - run.command[0] for run in cause.runs] if over_command else moves[-1]
        (frequency, measured, error), (_, extended, _), (_, without, _) = (
            _transfer(list(zip(inputs, outputs, strict=True)), cause.extended.sample_rate) for outputs in moves)
        clear = error <= SPREAD
        weight = float(np.sum(weigh(extended, without)[clear]))
        if weight > most and clear.sum() >= 3:
            best = _Ratios(channel, *(row[clear] for row in (frequency, measured, extended, without)))
            most = weight
    return best


def _channels(cause: Cause) -> list[str]:
    """The channels that the rig and all its runs have."""
    lacks = cause.extended.accelerometer is None or any(r.accel is None for r in cause.runs)
    return ["encoder"] if lacks else ["encoder", "accel"]


def _moves(values: np.ndarray, channel: str) -> np.ndarray:
    """The angle by its changes, so that drift of an open integrator does not swamp it; the acceleration as it is."""
    return np.diff(values, prepend=values[0]) if channel == "encoder" else values - values[0]


def _transfer(pairs: Sequence[tuple[np.ndarray, np.ndarray]], rate: float) -> tuple[np.ndarray, ...]:
    """Frequencies (Hz), transfer function H1 = Sxy/Sxx and its relative standard error in bands, over pairs (x, y).

    Whole runs are transformed at once: most begin and end at rest, and a moving window would cut their transients.
    Bands are logarithmic, and wider where they would hold fewer than FEWEST lines of all runs.  The error is
    √((1 − γ²)/(2 n γ²)) of n lines with the coherence γ² (Bendat and Piersol, Random Data, 4th ed., 2010, section 9.2),
    γ² freed of its bias 1/n.
    """
    longest = max(len(x) for x, _ in pairs)
    sums = np.zeros((3, longest // 2 + 1), dtype=complex)
    for x, y in pairs:
        for row, (a, b) in enumerate(((x, x), (x, y), (y, y))):
            frequency, spectrum = signal.csd(a, b, rate, window=("tukey", TAPER), nperseg=len(x), nfft=longest,
                                             detrend=False)
            sums[row] += spectrum * len(x)
    lines = sum(len(x) for x, _ in pairs) / longest
    fewest = max(math.ceil(FEWEST / lines), 1)
    ratio = (HIGHEST * longest) ** (1.0 / BANDS)
    rows, end = [], 1
    while frequency[end] < HIGHEST * rate:
        inside = slice(end, max(end + fewest, math.ceil(end * ratio)))
        end = inside.stop
        if end >= len(frequency) or not sums[0, inside].real.sum() > 0.0:
            break
        xx, xy, yy = sums[:, inside].sum(axis=1)
        power, n = np.abs(sums[0, inside]), lines * (inside.stop - inside.start)
        raw = abs(xy) ** 2 / max(xx.real * yy.real, 1e-300)
        coherence = max((raw * n - 1.0) / (n - 1.0), 1e-6)
        rows.append((np.sum(power * frequency[inside]) / power.sum(), xy / xx,
                     math.sqrt(max(1.0 - coherence, 0.0) / (2.0 * n * coherence))))
    frequencies, ratios, errors = np.array(rows, dtype=complex).reshape(-1, 3).T
    return frequencies.real, ratios, errors.real


def _resonances(rig: Rig) -> list[float]:
    """Undamped frequencies (Hz) of the oscillating modes below TOP of the sample rate, lowest first."""
    values = modal_form(build(rig.with_effects([])).assembly).eigenvalues.ravel()
    found = sorted({round(abs(v) / (2.0 * math.pi), 6) for v in values if abs(v.imag) > 1e-6 * abs(v)})
    return [f for f in found if f < TOP * rig.sample_rate]


def _decibel(ratio: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.maximum(np.abs(ratio), 1e-6))


def _degrees(ratio: np.ndarray) -> np.ndarray:
    return np.degrees(np.unwrap(np.angle(ratio)))


_QUANTITIES = {"gain": ("Size", "measured over simulated (dB)", "0.9 dB", _decibel),
               "phase": ("Phase", "phase of measured over simulated (degrees)", "6 degrees", _degrees)}
"""Word, label and SPREAD of each, and how it is had of a ratio."""

"""What the causes buy on runs that no fit has seen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from station.diagnose.thresholds import BEYOND
from station.estimation.cause import constant
from station.estimation.identifiability import NORMAL
from station.view.wording.names import CHANNELS, constant_title, joined
from station.view.wording.numbers import number, percent
from station.view.wording.remains import leaves_noise

if TYPE_CHECKING:
    from station.diagnose.result import ChannelGain, Diagnosis, DiagnosisResult


def gone(diagnosis: Diagnosis) -> str:
    """How much of the error above the noise the causes take away on unseen runs, as a clause; empty where nothing says.

    It never says more or less than the verdict: a remainder too small to change the error by a half percent may stand
    out of the noise, and one of a few percent may be no more than what a fit without the judged run leaves uncertain.
    """
    fraction = diagnosis.gain.explained_fraction
    if fraction is None or not diagnosis.causes:
        return ""
    noise = leaves_noise(diagnosis)
    if fraction <= 0.0:
        return f"the error of whole runs is not smaller{', within the uncertainty of the fits' if noise else ''}"
    if fraction >= 0.995:
        return f"{'all' if noise else 'nearly all'} of the error above the noise is gone"
    rest = ", the rest within the uncertainty of the fits" if noise else ""
    return f"{percent(fraction)} of the error above the noise is gone{rest}"


def beyond(result: DiagnosisResult) -> list[str]:
    """What re-fitting the constants alone does, and what the causes do beyond it, a sentence per channel; none without
    causes."""
    said = []
    for name, words in CHANNELS.items():
        gain, refit = getattr(result.diagnosis.gain, name), result.refitted(name)
        if gain is None or refit is None or not result.diagnosis.causes:
            continue
        fall = gain.nrmse_before - gain.nrmse_after
        share = (gain.nrmse_before - refit) / fall if fall > 0.0 else None
        alone = ("" if share is None else " Re-fitting alone does none of that." if share <= 0.0 else
                 " Re-fitting alone does all of that." if share >= 1.0 else
                 " Re-fitting alone does nearly all of that." if share >= 0.95 else
                 f" Re-fitting alone does {percent(share)} of that, the causes the rest.")
        said.append(f"{words.capitalize()} error: {percent(gain.nrmse_before)} with the rig file as it is, "
                    f"{percent(refit)} with its constants re-fitted, {percent(gain.nrmse_after)} with the causes."
                    f"{alone}{_most_runs(result, name) if gain.nrmse_after >= refit else ''}")
    return said


def _most_runs(result: DiagnosisResult, channel: str) -> str:
    """That most runs are met better with the causes, where they are, though the largest errors are not."""
    errors = [row.errors(channel)[1:] for row in result.comparisons if channel in row.channels]
    better = sum(before is not None and after is not None and after < before for before, after in errors)
    return f" But {better} of {len(errors)} runs are met better with the causes." if 2 * better > len(errors) else ""


def strained(result: DiagnosisResult) -> str:
    """The constants that a refit moves by more than 95 % of the rig file's own uncertainty, and that are no causes;
    empty where there are none."""
    told = [f"{words} ({deviation:.1f} sigma)" for deviation, words in _moved(result) if deviation > NORMAL]
    return f"Re-fitted, {joined(told)} than the rig file says." if told else ""


def far_off(result: DiagnosisResult) -> str:
    """The constant that a refit moves furthest, as a clause, where that is so far that it could be accused; empty where
    none is."""
    deviation, words = next(iter(_moved(result)), (0.0, ""))
    return f"{words} than the rig file says, {deviation:.1f} sigma" if deviation > BEYOND else ""


def _moved(result: DiagnosisResult) -> list[tuple[float, str]]:
    """By how many sigmas of the rig file's a refit moves each constant that is no cause, and that in words; the
    furthest first."""
    stated, named = result.rig.constants(), {cause.effect for cause in result.diagnosis.causes}
    paths = [path for path in result.constants if path in stated and constant(path)[0] not in named]
    sigmas = dict(zip(paths, np.sqrt(result.rig.log_covariance(paths).diagonal()), strict=True)) if paths else {}
    rows = []
    for path, sigma in sigmas.items():
        moved = math.log(result.constants[path].value / stated[path])
        if sigma > 0.0:
            change = math.expm1(moved)
            rows.append((abs(moved) / sigma,
                         f"{constant_title(path)} is {percent(abs(change))} {'more' if change > 0.0 else 'less'}"))
    return sorted(rows, reverse=True)


def gain_rows(result: DiagnosisResult) -> list[tuple[str, ChannelGain, float | None]]:
    """The gain per channel, in words, of the channels that have one, and the error with the constants re-fitted."""
    rows = ((words, getattr(result.diagnosis.gain, name), result.refitted(name)) for name, words in CHANNELS.items())
    return [(name, gain, refit) for name, gain, refit in rows if gain is not None]


def ahead_times(diagnosis: Diagnosis) -> list[str]:
    """The times ahead that gains are told for."""
    return list(dict.fromkeys(time for row in diagnosis.gain.runs for time in row.ahead))


def any_step(diagnosis: Diagnosis) -> bool:
    """Whether a run is a step test."""
    return any(row.measured for row in diagnosis.gain.runs)


def step_words(measures: dict[str, float | None], repeats: Mapping[str, float] = MappingProxyType({})) -> str:
    """Overshoot, rise and settling time of a step test, with what repeats differ by; a dash for other tests."""
    if not measures:
        return "–"

    def told(name: str, unit: str, never: str) -> str:
        value, spread = measures.get(name), f" ± {number(repeats[name], 2)}" if name in repeats else ""
        return never if value is None else f"{number(value)}{spread} {unit}"
    return ", ".join([told("overshoot_percent", "%", "–"), told("rise_time", "s", "not risen"),
                      told("settling_time", "s", "not settled")])

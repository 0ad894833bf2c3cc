"""Plain words and rounded numbers for what a diagnosis says; the report and the terminal share them."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from station.control.named import named_controller
from station.control.references import KINDS, defaults
from station.diagnose.thresholds import STABLE, SURE
from station.estimation.cause import constant_path, is_constant
from station.model.effects import catalogue

if TYPE_CHECKING:
    from station.diagnose.result import (
        Cause,
        ChannelGain,
        Diagnosis,
        DiagnosisResult,
        Estimate,
        NextExperiment,
        RankedCause,
        Rival,
        Wrong,
    )
    from station.rig import Rig

VERDICTS = {"explained": "explained", "partly_explained": "partly explained", "unexplained": "unexplained",
            "nothing_missing": "nothing missing", "ambiguous": "ambiguous", "not_enough_data": "not enough data"}
CHANNELS = {"encoder": "angle", "accel": "acceleration"}
STATES = {"determined": "determined by these runs", "at_bound": "at a bound",
          "traded_off": "known only together with another",
          "not_excited": "not told by these runs; known only as it was beforehand"}

LATENCY = "loop_latency"
"""How a delay is called that stands at the encoder or at the input, and nothing tells at which."""
SMALL = 0.01
"""Share of the command's torque below which a missing one is called little: what a motor does from one test to the next
differs by as much."""
_DELAYS = {"input_delay", "encoder_delay"}
_INSIDE = {"drive", "clamp", "accelerometer", "encoder", "clock", "amplifier"}
# measure: (words, factor, unit)
_MEASURES = {"overshoot_percent": ("overshoot", 1.0, " %"), "settling_time": ("settling time", 1.0, " s"),
             "peak_counts": ("peak", 1.0, " counts"), "nrmse": ("error", 100.0, " % of the signal")}
_TITLES = {LATENCY: "latency in the loop (encoder or input)"}
_NO_CAUSE = {"none": "none of these", "nothing": "nothing missing", "": "nothing missing"}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits, a dash for None, ``not finite`` values in words."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "infinite" if math.isinf(value) else "undefined"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_SUPERSCRIPT)}".replace("-", "−")
    decimals = digits - 1 - (math.floor(math.log10(abs(value))) if value else digits - 1)
    return f"{value:.{max(decimals, 0)}f}".replace("-", "−")


def decimal(value: float) -> str:
    """Two decimals, never a negative zero."""
    return f"{round(value, 2) + 0.0:.2f}".replace("-", "−")


def percent(share: float | None) -> str:
    """A share as a percentage: ``0.03 %``, ``0.4 %``, ``41 %``; a dash for None."""
    if share is None or not math.isfinite(share):
        return "–"
    value = 100.0 * share
    decimals = 0 if abs(value) >= 9.95 or value == 0.0 else 1 if abs(value) >= 0.095 else 2
    return f"{round(value, decimals) + 0.0:.{decimals}f} %".replace("-", "−")


def resamples(value: float) -> str:
    """A share of resamples: ``all resamples``, ``93 % of the resamples``."""
    return "all resamples" if value > 0.995 else f"{percent(value)} of the resamples"


def probability(value: float) -> str:
    """A probability as a percentage that never rounds to certainty."""
    if value < 0.001:
        return "< 0.1 %"
    if value > 0.999:
        return "> 99.9 %"
    if value > 0.99:
        return f"{100.0 * value:.1f} %"
    return percent(value)


def interval(estimate: Estimate) -> str:
    """``0.0210 N m (0.0191 to 0.0229)``, as many digits as the interval deserves."""
    low, high, value = estimate.low, estimate.high, estimate.value
    digits = 3
    if math.isfinite(high - low) and high > low and value:
        digits = min(6, max(2, 2 + math.floor(math.log10(abs(value)) - math.log10((high - low) / 2.0))))
    unit = f" {unit_of(estimate)}" if unit_of(estimate) else ""
    differs = "" if estimate.spread is None else f", from run to run ± {number(estimate.spread, 2)}"
    return f"{number(value, digits)}{unit} ({number(low, digits)} to {number(high, digits)}{differs})"


def unit_of(estimate: Estimate) -> str:
    """The unit as it is written behind a number: none for a pure number."""
    return "" if estimate.unit == "1" else estimate.unit


def constant_title(path: str) -> str:
    """``beam.mass_per_length`` -> ``beam mass per length``."""
    return path.replace(".", " ").replace("_", " ")


def cause_title(effect: str, at: str) -> str:
    """``Coulomb friction at the motor``, ``wrong tip mass``."""
    if is_constant(effect):
        return f"wrong {constant_title(constant_path(effect))}"
    if effect in _NO_CAUSE or effect in _TITLES:
        return {**_NO_CAUSE, **_TITLES}[effect]
    known = catalogue().get(effect)
    title = known.title if known is not None and known.title else effect.replace("_", " ")
    return title if not at or at in title else f"{title} {place(at)}"


def place(at: str) -> str:
    """``at the motor``, ``in the drive``."""
    return f"{'in' if at in _INSIDE else 'at'} the {at}"


def _and(words: Sequence[str], last: str = "and") -> str:
    """Words joined: ``a``, ``a and b``, ``a, b and c``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def rest_sentence(cause: Cause, outside: float) -> str:
    """Where the probability lies that a cause does not hold (``outside``: what is kept for none that is known), and
    where else a law may act that may act at several places; empty where hardly anything is left.

    Rivals may stand beside each other in one set, so that theirs may add up to more.
    """
    places = [r for r in cause.rivals if r.effect == cause.effect]
    instead = [r for r in cause.rivals if r.effect != cause.effect]
    words = []
    if places:
        words.append(f"Instead of {place(cause.at)} it may act "
                     f"{' or '.join(f'{place(r.at)} ({probability(r.probability)})' for r in places)}.")
    rest = 1.0 - cause.probability - outside
    if rest >= 0.005:
        among = [f"{cause_title(r.effect, r.at)} ({probability(r.probability)})" for r in instead]
        left = rest - sum(r.probability for r in instead)
        beside = f"; {probability(left)} with none of these" if left > 0.005 else ""
        words.append(f"The other {probability(rest)}: sets of causes without it, "
                     + (f"among them with {', '.join(among)}{beside}." if among else
                        "none of them with a likely cause in its place."))
    return " ".join(words)


def outside_sentence(outside: float) -> str:
    """What is kept for causes that no effect describes; empty where only noise is left."""
    return (f"More than noise is left, so {probability(outside)} is kept for something that acts like these causes and "
            "is none that is known here.") if outside else ""


def verdict_sentence(diagnosis: Diagnosis, rig: Rig) -> str:
    """The verdict for a student: one plain sentence, or two where something is certain and something is not."""
    causes = diagnosis.causes
    if diagnosis.verdict in ("explained", "partly_explained") and causes:
        fraction = diagnosis.gain.explained_fraction
        closer = ("it comes closer on the whole, but" if fraction is None or fraction > 0.0 else
                  "its predictions come closer, whole runs do not, and")
        ends = {"explained": "only noise and the rig's stated uncertainty remain",
                "partly_explained": f"{closer} more than noise remains"}
        return f"The simulation {_accusation(causes, rig)}; with that put right, {ends[diagnosis.verdict]}."
    if diagnosis.verdict == "ambiguous" and causes:
        return _ambiguous(diagnosis, rig)
    if diagnosis.verdict == "unexplained" and diagnosis.disturbance is not None:
        return _unexplained(diagnosis.disturbance.refitted)
    return {"unexplained": "The simulation gets something wrong, and no cause known here is named by most resamples "
                           "of these runs and helps on runs that no fit has seen.",
            "nothing_missing": "Nothing is missing: the simulation agrees with these runs to within noise and "
                               "the rig's stated uncertainty.",
            "not_enough_data": "These runs are not enough: most effects would not have shown in them.",
            }.get(diagnosis.verdict, "The simulation gets something wrong that these runs do not settle.")


def _unexplained(missing: float) -> str:
    """``missing``: torque, a share of the command's, that the re-fitted rig lacks."""
    share = f"a torque of {percent(missing)} of the command's"
    if missing < SMALL:
        return ("The simulation gets something wrong, but little: with its constants re-fitted all that is left is "
                f"{share}, which no law of the catalogue describes.")
    return (f"The simulation gets something wrong: with its constants re-fitted {share} is still missing, and no cause "
            "known here is named by most resamples of these runs and helps on runs that no fit has seen.")


def _ambiguous(diagnosis: Diagnosis, rig: Rig) -> str:
    """What is certain, then what is undecided between which."""
    causes, sure = diagnosis.causes, SURE * (1.0 - diagnosis.outside)
    undecided = [c for c in causes if c.stability < STABLE or c.probability < sure]
    late = any(c.effect == LATENCY for c in causes)
    if not undecided and not late:
        undecided = [max(causes, key=lambda c: sum(r.probability for r in c.rivals))]
    certain = [c for c in causes if c not in undecided]
    parts = [f"The simulation {_accusation(certain, rig)}."] if certain else []
    begin = "Something more is wrong" if certain else "The simulation gets something wrong"
    choices = [_choice(c, certain) for c in undecided]
    if any(len(choice) > 1 for choice in choices):
        pairs = ", nor ".join(f"whether it is {_and(choice, 'or')}" for choice in choices if len(choice) > 1)
        parts.append(f"{begin}, but these runs cannot tell {pairs}.")
    elif undecided:
        parts.append(f"{begin}; {_and([choice[0] for choice in choices])} would explain it, but these runs cannot "
                     "settle it.")
    else:
        parts.append("These runs cannot tell whether that latency stands at the encoder or at the input.")
    return " ".join(parts)


def _choice(cause: Cause, certain: Sequence[Cause]) -> list[str]:
    """A cause that is undecided and at most two rivals that count beside it, in words."""
    sure = {(c.effect, c.at) for c in certain}
    rivals = [r for r in cause.rivals if (r.effect, r.at) not in sure]
    close = [r for r in rivals if r.probability >= 0.1 * cause.probability] or rivals[:1]
    return [_told(cause), *(cause_title(r.effect, r.at) for r in close[:2])]


def _told(cause: Cause) -> str:
    """A cause for a headline: a latency with its size."""
    title = cause_title(cause.effect, cause.at)
    if cause.effect != LATENCY:
        return title
    return f"a {title.replace('latency', f'latency of {_milliseconds(cause)}', 1)}"


def _milliseconds(cause: Cause) -> str:
    return f"{number(1e3 * cause.parameters['time'].value, 2)} ms"


def as_told(result: DiagnosisResult) -> Diagnosis:
    """The diagnosis for people: encoder and input delay are one latency of the loop where nothing tells them apart.

    That is so without an accelerometer, where the table of equivalences says that they are the same.
    """
    found, twins = result.diagnosis, _twins(result)
    if twins is None:
        return found
    cause, twin = twins
    rows = {(row.effect, row.at): row.stability for row in result.ranking}
    both = cause.model_copy(update={
        "effect": LATENCY, "at": "", "probability": min(cause.probability + twin.probability, 1.0 - found.outside),
        "stability": min(cause.stability + rows.get((twin.effect, twin.at), 0.0), 1.0),
        "rivals": [r for r in cause.rivals if r is not twin]})
    others = [c.model_copy(update={"rivals": [r for r in c.rivals if r.effect != twin.effect]})
              for c in found.causes if c is not cause]
    causes = sorted([*others, both], key=lambda c: -c.probability)
    return found.model_copy(update={"causes": causes})


def _twins(result: DiagnosisResult) -> tuple[Cause, Rival] | None:
    """A named delay and the other one in its place, where both are the same to every test."""
    from station.diagnose.equivalences import TABLE  # slow to import

    same = next(row.sentence for row in TABLE if row.name == "delays")
    delays = [c for c in result.diagnosis.causes if c.effect in _DELAYS]
    if result.rig.accelerometer is not None or same not in result.equivalences or len(delays) != 1:
        return None
    twin = next((r for r in delays[0].rivals if r.effect in _DELAYS), None)
    return None if twin is None else (delays[0], twin)


def ranked(result: DiagnosisResult, most: int) -> list[tuple[RankedCause, str]]:
    """The first candidates, and why each stands where it does."""
    named, twins = {(c.effect, c.at) for c in result.diagnosis.causes}, _twins(result)
    rows = [(c, why_lost(c, result.ranking[0], (c.effect, c.at) in named)) for c in result.ranking[:most]]
    if twins is None:
        return rows
    same, twin = (cause_title(one.effect, one.at) for one in twins)
    return [(c, f"one latency with the {same}, which no test tells from it" if cause_title(c.effect, c.at) == twin
             else why) for c, why in rows]


def _accusation(causes: Sequence[Cause], rig: Rig) -> str:
    effects = [c for c in causes if not is_constant(c.effect)]
    constants = [c for c in causes if is_constant(c.effect)]
    parts = []
    if effects:
        parts.append(f"leaves out {_and(list(map(_told, effects)))}")
    if constants:
        nominal = rig.constants()
        words = []
        for cause in constants:
            path, estimate = constant_path(cause.effect), cause.parameters.get("value")
            values = ""
            if estimate is not None and path in nominal:
                stated = f"{number(nominal[path])} {unit_of(estimate)}".rstrip()
                values = f" ({stated} where these runs say {number(estimate.value)})"
            words.append(f"a wrong {constant_title(path)}{values}")
        parts.append(f"has {' and '.join(words)}")
    return " and ".join(parts)


def measure(item: Wrong) -> tuple[str, str, str]:
    """What one entry of ``wrong`` measures, simulated and measured, in words."""
    words, factor, unit = _MEASURES.get(item.measure, (item.measure.replace("_", " "), 1.0, ""))

    def shown(value: float | None) -> str:
        if value is None:
            return "never" if item.measure == "settling_time" else "–"
        return f"{number(factor * value)}{unit}"
    measured = shown(item.measured)
    if item.measure == "nrmse" and item.measured is not None:
        measured = f"a right simulation would leave {percent(item.measured)}"
    return f"{CHANNELS[item.channel]} {words}", shown(item.simulated), measured


def fact(item: Wrong) -> tuple[str, str]:
    """One entry of ``wrong`` for a sentence: the measure, and simulated against measured."""
    what, simulated, measured = measure(item)
    if item.measured is None and item.measure != "settling_time":
        return what, simulated
    if item.measure == "nrmse":
        return what, f"{simulated}, where {measured}"
    return what, f"simulated {simulated}, measured {measured}"


def test_words(test: dict[str, Any] | None) -> str:
    """A test in words: ``pulse, amplitude 60, duration 2.0``."""
    if not test:
        return "not stated"
    rest = [f"{key.replace('_', ' ')} {_short(value)}" for key, value in test.items() if key != "kind"]
    return ", ".join([str(test.get("kind", "test")), *rest])


def _short(value: Any) -> str:
    """A value of a test or controller: numbers with six digits, lists in brackets."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def run_command(test: dict[str, Any], port: str = "PORT", rig: str = "RIG") -> str:
    """The command line that runs a test, as one types it; the test in words where the station has no such kind."""
    kind = str(test.get("kind"))
    if kind not in KINDS:
        return test_words(test)
    usual, spec = defaults(kind), test.get("controller")
    words = ["station", "run", kind.replace("_", "-"), "--port", port, "--rig", rig]
    name = kind
    if isinstance(spec, dict):
        known = named_controller(spec)
        name = f"{kind}-{known[0] if known else 'own'}"
        words += ["--controller", known[0] if known else "CONTROLLER.toml"]
        words += [word for key, value in (known[1] if known else {}).items() for word in (f"--{key}", f"{value:.12g}")]
    for key, value in test.items():
        if key in usual and (key in ("amplitude", "duration") or value != usual[key]):
            words += [f"--{key}", f"{value:.12g}" if isinstance(value, int | float) else str(value)]
    size = test.get("amplitude")
    name += f"-{abs(size):g}" if isinstance(size, int | float) else ""
    return shlex.join([*words, "--out", f"{name}.mcap"])


def next_test(asked: NextExperiment, rig: str) -> str:
    """The next experiment as a sentence: the command to type, and why."""
    words = f"{run_command(asked.test, rig=rig)}\n" if asked.test else ""
    return f"{words}{sentence(plain(asked.why))}"


def plain(text: str) -> str:
    """A diagnosis' own note with causes by their titles: ``dead_zone@amplifier`` is a dead zone in the amplifier."""
    known = "|".join(sorted(map(re.escape, catalogue()), key=len, reverse=True))
    text = re.sub(rf"\b({known})(?:@| at )(\w+)", lambda m: cause_title(m[1], m[2]), text)
    text = re.sub(r"\bparameter:(\w+\.\w+)(?:@(?!\w))?", lambda m: cause_title(m[0].rstrip("@"), ""), text)
    return text.replace("chi^2", "χ²")


def sentence(text: str) -> str:
    """A clause with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


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
                    f"{alone}")
    return said


def leaves_noise(diagnosis: Diagnosis) -> bool:
    """Whether the verdict says that what is left, over whole runs, is noise and stated uncertainty."""
    return diagnosis.outside == 0.0


def residual_words(larger: bool, white: bool, followed: int) -> str:
    """What a residual one sample ahead looks like.

    ``larger``: than the noise; ``white``: whether its lags pass for white noise; ``followed``: the lags at which an
    earlier command shows.
    """
    if not larger:
        return "noise" if white and not followed else "no larger than the noise"
    return f"larger than the noise{', and it follows the command' if followed else ''}"


def remains_sentence(diagnosis: Diagnosis, larger: int, of: int) -> str:
    """What is left over whole runs, as the verdict has it, and one sample ahead: ``larger`` residuals of ``of``."""
    count = "the residual is" if of == 1 else f"{larger} of {of} residuals {'is' if larger == 1 else 'are'}"
    ahead = f"one sample ahead {count} larger than the sensors' noise"
    if leaves_noise(diagnosis):
        whole = ("Over whole runs, by which the verdict judges, what is left is noise"
                 f"{' and stated uncertainty' if diagnosis.verdict != 'not_enough_data' else ''}")
        none = "one sample ahead no residual is larger than the sensors' noise"
        return f"{whole}; {ahead if larger else none}."
    whole = "Over whole runs, by which the verdict judges, more than noise is left"
    return f"{whole}; {ahead}." if larger else f"{whole}; one sample ahead it does not show."


def no_test(diagnosis: Diagnosis) -> str:
    """Why no next experiment is named."""
    if diagnosis.verdict in ("explained", "nothing_missing"):
        return "None is needed for this verdict."
    return "None was worked out."


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


def disturbance(diagnosis: Diagnosis) -> str:
    """What torque is still missing at the motor, as a sentence; empty where it was not worked out."""
    found = diagnosis.disturbance
    if found is None:
        return ""
    words = (f"The torque that must be missing at the motor to meet the angle a few hundredths of a second ahead is "
             f"{percent(found.nominal)} of the command's rms torque with the rig file as it is, "
             f"{percent(found.refitted)} with its constants re-fitted")
    return f"{words}, {percent(found.extended)} with the causes." if diagnosis.causes else f"{words}."


def differences(diagnosis: Diagnosis) -> str:
    """How probable it is that the runs differ, and how many resamples show it; empty where they do not."""
    found = diagnosis.between_runs
    return "" if found is None or not found.probability else (
        f"{probability(min(found.probability.values()))} probable, shown by {resamples(min(found.stability.values()))}")


def between_runs(diagnosis: Diagnosis) -> str:
    """In what the runs differ by themselves, as a sentence; empty where they do not."""
    found = diagnosis.between_runs
    if found is None:
        return ""
    sizes = {"share": f"{percent(found.share)} of its command", "constant": f"{number(found.constant, 2)} counts"}
    told = " and ".join(size for name, size in sizes.items() if name in found.probability)
    if not told:
        return ""
    words = (f"From run to run the motor does more or less by {told}, as no cause with one value for all runs can "
             "(standard deviations)")
    if found.share is None:
        return f"{words}."
    least, most = (pick(found.runs, key=lambda row: row.share) for pick in (min, max))
    return (f"{words}: from {percent(least.share)} in {least.run} to {percent(most.share)} in {most.run}. A supply "
            "whose voltage differs between tests does that.")


def why_lost(cause: RankedCause, first: RankedCause, named: bool) -> str:
    """Why a candidate stands where it does: its own note, or what the numbers say."""
    if named:
        alone = cause.adds is None or cause.adds == cause.delta_chi2
        return "named as a cause" if alone else \
            f"named as a cause: {_adds(cause)} to 2 Δln L of the others that are named"
    if not cause.lost and cause is first:
        return "most probable, but too few resamples name it or it does not help on unseen runs"
    if not cause.lost and cause.probability > 0.5:
        return "may be there as well, but too few resamples name it"
    if cause.note or cause.beside_named:
        return _beside(cause)
    if cause.lost in ("resamples", "left_out", "within") or len(cause.instead) == 1 or cause.lost and first.note:
        return _lost(cause)
    if cause.held_out_gain is not None and cause.held_out_gain <= 0.0:
        return "does not help on unseen runs"
    if not first.note and first.delta_chi2 - cause.delta_chi2 > 4.0:
        return f"explains less: 2 Δln L is {number(first.delta_chi2 - cause.delta_chi2)} below the first's"
    if cause.adds is not None and cause.adds < cause.price:
        return f"{_adds(cause)} to 2 Δln L{_too_little(cause)}"
    return "as good as the first on these runs" if cause.probability > 0.1 else "no better than the first"


def _beside(cause: RankedCause) -> str:
    """What a candidate adds to its set, and why that is not enough or what else keeps it from being named."""
    note = "beside the causes named" if cause.beside_named else plain(cause.note)
    if not cause.beside_named and not note.startswith("as part of"):
        return note
    if cause.adds is not None:
        note = f"{note}: {_adds(cause)} to 2 Δln L"
        if cause.adds < cause.price:
            return f"{note}{_too_little(cause)}"
    return "; ".join(filter(None, (note, _lost(cause))))


def _adds(cause: RankedCause) -> str:
    """``adds 10.0``, ``adds nothing``."""
    return f"adds {number(cause.adds)}" if cause.adds is not None and cause.adds > 1.0 else "adds nothing"


def _too_little(cause: RankedCause) -> str:
    """What a candidate must add, behind what it adds; empty where it adds nothing."""
    return f", too little (it must add {number(cause.price, 2)})" if cause.adds is not None and cause.adds > 1.0 else ""


def _lost(cause: RankedCause) -> str:
    """Why a candidate is not named though it may add enough; empty where nothing says."""
    if cause.lost == "another":
        does = "does" if len(cause.instead) == 1 else "do"
        how = f"{does} better" if cause.behind > 4.0 else f"{does} as well"
        return f"{_and([cause_title(*key) for key in cause.instead])} in its place {how}"
    few = f"named in {resamples(cause.stability)}, too few" if cause.stability else "no resample names it"
    return {"resamples": few, "left_out": "does not help on unseen runs",
            "within": "a value within the rig's stated uncertainty does as well"}.get(cause.lost, "")

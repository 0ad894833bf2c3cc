"""The verdict as a sentence: what is certain, and what is undecided between which."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from station.diagnose.result import NOT_NAMED
from station.diagnose.thresholds import LIKELY, STABLE
from station.estimation.cause import constant_path, is_constant
from station.view.wording.names import LATENCY, cause_title, constant_title, joined
from station.view.wording.numbers import number, percent, unit_of
from station.view.wording.odds import as_good_as_certain
from station.view.wording.remains import leaves_noise
from station.view.wording.runs import differing

if TYPE_CHECKING:
    from station.diagnose.result import Cause, Diagnosis
    from station.rig import Rig

SMALL = 0.02
"""Share of the command's torque below which a missing one is called little: models of rigs lack as much
(``estimation.observer.UNMODELLED``, a fiftieth of what tests command)."""
NONE = 0.005
"""Share below which none is told: it would be a nought of a percent."""


def verdict_sentence(diagnosis: Diagnosis, rig: Rig, far_off: str = "") -> str:
    """The verdict for a student: one plain sentence, or two where something is certain and something is not.

    ``far_off``: the constant that a refit moves beyond belief, as a clause (``gain.far_off``).
    """
    causes = diagnosis.causes
    if diagnosis.verdict in ("explained", "partly_explained") and causes:
        fraction = diagnosis.gain.explained_fraction
        closer = ("it comes closer on the whole, but" if fraction is None or fraction > 0.0 else
                  "its predictions come closer, whole runs do not, and")
        ends = {"explained": "only noise and the rig's stated uncertainty remain",
                "partly_explained": f"{closer} {_missing(diagnosis) or 'more than noise remains'}"}
        accused = _hedged(causes, diagnosis.outside, rig)
        return f"The simulation {accused}; with that put right, {ends[diagnosis.verdict]}."
    if diagnosis.verdict == "ambiguous" and causes:
        said, missing = _ambiguous(diagnosis, rig), _missing(diagnosis)
        return f"{said} Whichever it is, {missing}." if missing else said
    if diagnosis.verdict == "unexplained" and diagnosis.disturbance is not None:
        return _unexplained(diagnosis.disturbance.refitted, differing(diagnosis), _none_named(diagnosis), far_off)
    return {"unexplained": f"The simulation gets something wrong, and {_none_named(diagnosis)}.",
            "nothing_missing": "Nothing is missing: the simulation agrees with these runs to within noise and "
                               "the rig's stated uncertainty.",
            "not_enough_data": "These runs are not enough: most effects would not have shown in them.",
            }.get(diagnosis.verdict, "The simulation gets something wrong that these runs do not settle.")


def _missing(diagnosis: Diagnosis) -> str:
    """What torque the causes leave, as a clause; empty where that is little, or only noise is left."""
    found = diagnosis.disturbance
    if leaves_noise(diagnosis) or found is None or found.extended < SMALL:
        return ""
    return f"a torque of {percent(found.extended)} of the command's is still missing"


def _hedged(causes: Sequence[Cause], outside: float, rig: Rig) -> str:
    """What is as good as certain, then what is only likely."""
    sure = [c for c in causes if c.probability >= as_good_as_certain(outside)]
    likely = [c for c in causes if c not in sure and c.probability > LIKELY]
    rest = [c for c in causes if c not in sure and c not in likely]
    words = (("", sure), ("probably ", likely), ("perhaps ", rest))
    return ", and ".join(f"{how}{_accusation(some, rig)}" for how, some in words if some)


def _accusation(causes: Sequence[Cause], rig: Rig) -> str:
    effects = [c for c in causes if not is_constant(c.effect)]
    constants = [c for c in causes if is_constant(c.effect)]
    parts = []
    if effects:
        parts.append(f"leaves out {joined(list(map(_told, effects)))}")
    if constants:
        words = []
        for cause in constants:
            path, estimate = constant_path(cause.effect), cause.parameters.get("value")
            values = ""
            if estimate is not None:
                stated = f"{number(rig.stated(path))} {unit_of(estimate)}".rstrip()
                values = f" ({stated} where these runs say {number(estimate.value)})"
            words.append(f"a wrong {constant_title(path)}{values}")
        parts.append(f"has {' and '.join(words)}")
    return " and ".join(parts)


def _none_named(diagnosis: Diagnosis) -> str:
    """Why no cause is stated: no set is stable, or runs left out speak against the one that is."""
    against = [cause_title(row.effect, row.at) for row in diagnosis.ranking if row.note == NOT_NAMED["left_out"]]
    if not against:
        return "no cause known here is named by most resamples of these runs and helps on runs that no fit has seen"
    return (f"no cause known here is named: {joined(against)}, which most resamples name, "
            f"{'does' if len(against) == 1 else 'do'} not help on runs that no fit has seen")


def _unexplained(missing: float, differ: str, none_named: str, far_off: str) -> str:
    """``missing``: torque, a share of the command's, that the re-fitted rig lacks; ``differ``: how runs do."""
    share = f"a torque of {percent(missing)} of the command's"
    little = ", but little" if missing < SMALL and not differ and not far_off else ""
    begin = f": {differ}. With that and" if differ else f"{little}: with"
    ends = (f"no torque is missing a few hundredths of a second ahead (less than {percent(NONE)} of the command's); "
            "what is left shows in whole runs alone." if missing < NONE else
            f"all that is left is {share}, which no law of the catalogue describes." if missing < SMALL else
            f"{share} is still missing, and {none_named}.")
    moved = f" ({far_off})" if far_off else ""
    return f"The simulation gets something wrong{begin} its constants re-fitted{moved} {ends}"


def _ambiguous(diagnosis: Diagnosis, rig: Rig) -> str:
    """What is certain, then what is undecided between which."""
    causes, sure = diagnosis.causes, as_good_as_certain(diagnosis.outside)
    undecided = [c for c in causes if c.stability < STABLE or c.probability < sure]
    late = any(c.effect == LATENCY for c in causes)
    if not undecided and not late:
        undecided = [max(causes, key=lambda c: sum(r.probability for r in c.rivals))]
    certain = [c for c in causes if c not in undecided]
    parts = [f"The simulation {_accusation(certain, rig)}."] if certain else []
    begin = "Something more is wrong" if certain else "The simulation gets something wrong"
    choices = [_choice(c, certain) for c in undecided]
    if any(len(choice) > 1 for choice in choices):
        pairs = ", nor ".join(f"whether it is {joined(choice, 'or')}" for choice in choices if len(choice) > 1)
        parts.append(f"{begin}, but these runs cannot tell {pairs}.")
    elif undecided:
        parts.append(f"{begin}; {joined([choice[0] for choice in choices])} would explain it, but these runs cannot "
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
    milliseconds = number(1e3 * cause.parameters["time"].value, 2)
    return f"a {title.replace('latency', f'latency of {milliseconds} ms', 1)}"

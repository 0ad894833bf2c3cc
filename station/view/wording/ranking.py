"""Why each candidate stands where it does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.latency import delay_twins
from station.view.wording.names import cause_title, joined, plain
from station.view.wording.numbers import number, resamples

if TYPE_CHECKING:
    from station.diagnose.result import DiagnosisResult, RankedCause


def ranked(result: DiagnosisResult, most: int) -> list[tuple[RankedCause, str]]:
    """The first candidates, and why each stands where it does."""
    named, twins = {(c.effect, c.at) for c in result.diagnosis.causes}, delay_twins(result)
    rows = [(c, why_lost(c, result.ranking[0], (c.effect, c.at) in named)) for c in result.ranking[:most]]
    if twins is None:
        return rows
    same, twin = (cause_title(one.effect, one.at) for one in twins)
    return [(c, f"one latency with the {same}, which no test tells from it" if cause_title(c.effect, c.at) == twin
             else why) for c, why in rows]


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
        return f"{joined([cause_title(*key) for key in cause.instead])} in its place {how}"
    few = f"named in {resamples(cause.stability)}, too few" if cause.stability else "no resample names it"
    return {"resamples": few, "left_out": "does not help on unseen runs",
            "within": "a value within the rig's stated uncertainty does as well"}.get(cause.lost, "")

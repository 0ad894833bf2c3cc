"""Why each candidate stands where it does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.diagnose.result import NOT_NAMED
from station.view.wording.latency import delay_twins
from station.view.wording.names import cause_title, joined, plain
from station.view.wording.numbers import number, resamples

if TYPE_CHECKING:
    from station.diagnose.result import DiagnosisResult, RankedCause, Reason

NOTHING = 1.0
"""Of 2 ln L: what adds no more is said to add nothing."""


def ranked(result: DiagnosisResult, most: int) -> list[tuple[RankedCause, str]]:
    """The first candidates, and why each stands where it does."""
    twins = delay_twins(result)
    rows = [(c, why(c.reason)) for c in result.ranking[:most]]
    if twins is None:
        return rows
    same, twin = (cause_title(one.effect, one.at) for one in twins)
    return [(c, f"one latency with the {same}, which no test tells from it" if cause_title(c.effect, c.at) == twin
             else words) for c, words in rows]


def why(reason: Reason) -> str:
    """Why a candidate stands where it does: beside what it was tried, what it adds there, and what decides."""
    much = reason.adds is not None and reason.adds > NOTHING
    adds = "" if reason.adds is None else f"adds {number(reason.adds) if much else 'nothing'} to 2 Δln L"
    if reason.kind == "named":
        return f"named as a cause: {adds} of the others that are named" if adds else "named as a cause"
    if reason.kind == "too_little" and much:
        adds = f"{adds}, too little (it must add {number(reason.value, 2)})"
    tried = ": ".join(filter(None, (plain(reason.tried), adds)))
    return "; ".join(filter(None, (tried, _decides(reason))))


def _decides(reason: Reason) -> str:
    """What decides, beyond what a candidate adds."""
    others = joined([cause_title(*key) for key in reason.instead])
    do = "does" if len(reason.instead) == 1 else "do"
    return {**NOT_NAMED,
            "leads": "most probable, but too few resamples name it or it does not help on unseen runs",
            "likely": "may be there as well, but too few resamples name it",
            "within": "a value within the rig's stated uncertainty does as well",
            "resamples": f"named in {resamples(reason.value)}, too few" if reason.value else "no resample names it",
            "beaten": f"{others} in its place {do} better",
            "matched": f"{others} in its place {do} as well",
            "explains_less": f"explains less: 2 Δln L is {number(reason.value)} below the first's",
            "as_good": "as good as the first on these runs",
            "no_better": "no better than the first"}.get(reason.kind, "")

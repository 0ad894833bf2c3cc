"""Two delays that nothing tells apart, told as one latency of the loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.names import LATENCY

if TYPE_CHECKING:
    from station.diagnose.result import Cause, Diagnosis, DiagnosisResult, Rival

_DELAYS = {"input_delay", "encoder_delay"}


def as_told(result: DiagnosisResult) -> Diagnosis:
    """The diagnosis for people: encoder and input delay are one latency of the loop where nothing tells them apart.

    That is so without an accelerometer, where the table of equivalences says that they are the same.
    """
    found, twins = result.diagnosis, delay_twins(result)
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


def delay_twins(result: DiagnosisResult) -> tuple[Cause, Rival] | None:
    """A named delay and the other one in its place, where both are the same to every test."""
    from station.diagnose.equivalences import TABLE  # slow to import

    same = next(row.sentence for row in TABLE if row.name == "delays")
    delays = [c for c in result.diagnosis.causes if c.effect in _DELAYS]
    if result.rig.accelerometer is not None or same not in result.equivalences or len(delays) != 1:
        return None
    twin = next((r for r in delays[0].rivals if r.effect in _DELAYS), None)
    return None if twin is None else (delays[0], twin)

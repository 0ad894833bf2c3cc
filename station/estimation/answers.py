"""Whether sensors answer the commands as the rig file says, but for what no fit mends: a wrong sign, a wrong unit.

With y what was read, y(1) its prediction and y(0) that of a motor which does nothing,

    g = d'e / d'd,   r = d'e / (|d| |e|),   d = y(1) - y(0),   e = y - y(0),

both less their parts along y(c) - y(1), what a constant torque changes besides (partial regression: Frisch and Waugh,
Econometrica 1, 1933), g is the least-squares gain from command to reading in units of the rig's own, r how surely it is
one.  For a command that holds a weight, or an amplifier's bias, moves nothing: of a slow test it may be the most of it,
and as the torque that it stands against is not the rig's, the angle goes the other way than by the rig file.  The angle
is predicted a few hundredths of a second ahead, where neither a loop nor a spring has had time to answer, the
acceleration from the commands alone.  Only of tests that drive the rig in rows that count: where a loop holds a
reference that never moves, commands answer the readings, and g is that loop's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from station.errors import WorkError
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.prediction import Predictor

CORRELATED = 0.5
"""Correlation from which on a sign is certain: tests of the measured rigs have 0.91 or more for the angle and 0.67 for
the acceleration, those of some hundred made rigs 0.08 (most above 0.6) and 0.5 at least, none less than 0."""
IMPOSSIBLE, SUSPECT = 30.0, 3.0
"""Factors by which a gain is off that no rig has (a radian is 57 degrees, a thousandth a thousand), and that no rig has
whose constants are wrong by their usual uncertainty (gain and inertia by 30 % each are off by 2.9 at 2.5 sigmas)."""
IDLE = np.array([0.0, 0.0, -1.0, 0.0])
"""What a run has of its own (``Dataset.own``) less where the motor does nothing of its command."""
CONSTANT = np.array([0.0, 0.0, 0.0, 1.0])
"""What it has more where a constant torque acts besides, per count of command."""
READINGS = ("angle", "acceleration")
MENDED = "mend the rig file, or the column of the log"
SCALES = {"angle": "counts and not rad or degrees, encoder.counts_per_revolution, motor.gain in N m per count, "
                   "inertias in kg m^2",
          "acceleration": "counts and not m/s^2, accelerometer.gain in counts per m/s^2"}


@dataclass(frozen=True)
class Answer:
    """How one reading of one run answers its commands."""

    run: str
    reading: str
    gain: float
    sureness: float

    @property
    def against(self) -> bool:
        """Whether it moves the other way, by about as much."""
        return self.sureness < -CORRELATED and not self.off_by(IMPOSSIBLE)

    def off_by(self, factor: float) -> bool:
        """Whether it moves so many times as much, or as little, whichever way."""
        return abs(self.sureness) > CORRELATED and not 1.0 / factor < abs(self.gain) < factor

    @property
    def suspect(self) -> bool:
        """Whether it moves so many times as much, or as little, that its unit may be another.

        The prediction errs, too: what is true lies between g and g/r^2, by the regression of each on the other (Frisch,
        Statistical Confluence Analysis, 1934).
        """
        return self.off_by(SUSPECT) and replace(self, gain=self.gain / self.sureness**2).off_by(SUSPECT)


def answers(predictor: Predictor) -> list[Answer]:
    """Of every run that drives the rig, the angle first.

    The angle's block is that of the quickest observer, the acceleration's the last.  No amplifier cuts the commands, or
    a unit of theirs that is wrong would not show.
    """
    given = predictor.data
    largest = max(float(np.max(np.abs(run.command))) for run in given.runs)
    amplifier = given.rig.amplifier.model_copy(update={"limit": max(given.rig.amplifier.limit, largest)})
    data = replace(given, rig=given.rig.model_copy(update={"amplifier": amplifier}))
    predictor = predictor.on(data)
    space = parameters(data, Hypothesis(), {})
    driven, still, pushed = (predictor.runs(space, space.mean, data.own + more) for more in (0.0, IDLE, CONSTANT))
    found = []
    for r, (run, record) in enumerate(zip(data.runs, data.records, strict=True)):
        asked = (run.command if run.open_loop else run.reference)[record.window]
        if asked.size and np.ptp(asked) > 0.0:
            for reading, block in zip(READINGS, (0, -1)[: data.channels], strict=False):
                made, read, idle, more = (rows[block, record.window] for rows in (
                    driven[r], predictor.measured(r), still[r], pushed[r]))
                gain, sureness = _regressed(made, read, idle, more, block == -1)
                if math.isfinite(gain) and math.isfinite(sureness):
                    found.append(Answer(run.name, reading, gain, sureness))
    return found


def _regressed(driven: np.ndarray, read: np.ndarray, still: np.ndarray, pushed: np.ndarray, about_means: bool,
               ) -> tuple[float, float]:
    """g and r of y(1), y, y(0) and y(c) (n), ``about_means`` where a reading's zero is not known; not finite where
    nothing is told, or a simulation has run off."""
    with np.errstate(all="ignore"):
        rows = np.stack([driven - still, read - still, pushed - driven])
        if about_means:
            rows -= rows.mean(axis=1, keepdims=True)
        d, e, c = rows
        if c @ c > 0.0:
            d, e = d - (d @ c) / (c @ c) * c, e - (e @ c) / (c @ c) * c
        return float(d @ e / (d @ d)), float(d @ e / np.sqrt((d @ d) * (e @ e)))


def refuse_wrong_signs_and_units(found: list[Answer]) -> None:
    """WorkError where a reading answers the other way, or so much that its unit must be another."""
    for one in found:
        if one.off_by(IMPOSSIBLE):
            raise WorkError(f"{one.run}: the {one.reading} answers commands {abs(one.gain):.2g} times as much as the "
                            f"rig file says: a unit is wrong ({SCALES[one.reading]}); {MENDED}")
    turned = {one.reading: one for one in reversed(found) if one.against and _sign_is_sure(found, one.reading)}
    if len(turned) == len(READINGS):
        raise WorkError(f"{turned[READINGS[0]].run}: angle and acceleration both move the other way than the rig file "
                        f"says: command or motor.gain has the wrong sign; {MENDED}")
    for one in turned.values():
        sensor = "encoder, command or motor.gain" if one.reading == READINGS[0] else "accelerometer"
        raise WorkError(f"{one.run}: the {one.reading} moves the other way than the rig file says (correlation "
                        f"{one.sureness:.2f}): {sensor} has the wrong sign; {MENDED}")


def _sign_is_sure(found: list[Answer], reading: str) -> bool:
    """Whether most runs say of one reading which way it moves.

    Where they do not, a run that moves the other way is far from the rig in something else: of a beam a fifth as long
    as its file says, the acceleration follows or opposes the commands by how fast these are.
    """
    return abs(float(np.median([one.sureness for one in found if one.reading == reading]))) > CORRELATED


def unlikely(found: Sequence[Answer], explained: Sequence[Answer] = ()) -> list[str]:
    """A sentence for each reading that answers most runs much more or less than the rig file says, or else for each run
    of which it does.

    ``explained``: the answers of the rig with the effects that are stated.  What answers as that says needs no unit.
    """
    said = []
    for reading in READINGS:
        sure, again = ([one for one in rows if one.reading == reading and one.sureness > CORRELATED]
                       for rows in (found, explained))
        if not sure:
            continue
        usual = _usual(sure)
        met = {one.run for one in [*again, *([_usual(again)] if again else [])] if not one.suspect}
        off = [one for one in [usual, *sure] if one.suspect and one.run not in met]
        for one in [usual] if usual in off else off:
            where, others = (f"{one.run}: ", f", of the other runs {usual.gain:.2g} times") if one.run else ("", "")
            said.append(f"{where}the {reading} answers the commands {one.gain:.2g} times as much as the rig file "
                        f"says{others}; if that is a unit or a scale ({SCALES[reading]}), mend it")
    return said


def _usual(sure: Sequence[Answer]) -> Answer:
    """How one reading answers in most of the runs."""
    gain, sureness = np.median([(one.gain, one.sureness) for one in sure], axis=0)
    return Answer("", sure[0].reading, float(gain), float(sureness))

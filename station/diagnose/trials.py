"""Tests that the station could run next: which there are on a rig, what each asks of it, and which were run already."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from station.control.named import NAMED, SAMPLED_AT
from station.control.references import defaults, reference_from_test
from station.control.rounding import round_half_up
from station.estimation.cause import is_constant
from station.model.effects import effect_class
from station.rig import Rig
from station.runs.run import Run, RunMetadata

P = NAMED["p"]
SOFT = {**P, "gain": 1.0}
OPEN = NAMED["open"]
LEAD = NAMED["lead"]
BOTH = NAMED["lead-accel"]
USUAL_TURN, USUAL_LIMIT = 1024.0, 200.0
"""Counts per revolution of the encoder and the amplifier's limit that the amplitudes below and the compensators' gains
are meant for; with others they scale, so that the same angle asks for the same share of the limit."""
CLOSED: tuple[tuple[dict[str, Any], dict[str, Any]], ...] = (
    ({"kind": "step", "amplitude": 20}, P),
    ({"kind": "step", "amplitude": 60}, P),
    ({"kind": "step", "amplitude": 160}, P),
    ({"kind": "step", "amplitude": 60}, LEAD),
    ({"kind": "step", "amplitude": 200}, LEAD),
    ({"kind": "step", "amplitude": 200}, BOTH),
    ({"kind": "triangle", "amplitude": 40, "period": 2.0}, P),
    ({"kind": "triangle", "amplitude": 150}, P),
    ({"kind": "multisine", "amplitude": 60, "f1": 20.0, "tones": 24, "duration": 4.2}, SOFT),
    ({"kind": "multisine", "amplitude": 150, "f1": 10.0, "tones": 16, "duration": 4.2}, P),
    ({"kind": "sweep", "amplitude": 40, "f0": 0.3, "f1": 20.0, "duration": 6.4, "rest": 0.2, "spacing": "log"}, SOFT),
)
"""Tests of a closed loop; amplitudes in counts of the encoder."""
DRIVEN: tuple[dict[str, Any], ...] = (
    {"kind": "pulse", "amplitude": 0.2},
    {"kind": "pulse", "amplitude": 0.5},
    {"kind": "pulse", "amplitude": 1.0},
    {"kind": "pulse_train", "amplitude": 0.35, "spacing": 0.4, "pulses": 8},
    {"kind": "pulse_train", "amplitude": 0.9, "spacing": 0.4, "pulses": 8},
    {"kind": "prbs", "amplitude": 0.5, "hold": 0.05, "bits": 6, "duration": 3.4},
)
"""Tests of an open loop; amplitudes as shares of the amplifier's limit."""
OVERSHOOT = 1.6
"""Times its reference that a closed loop may go."""
ALIKE = 1.6
"""Ratio of amplitudes up to which two tests of one kind and controller count as the same."""


@dataclass(frozen=True)
class Trial:
    """One test that could be run."""

    test: dict[str, Any]
    controller: dict[str, Any]

    @property
    def closed(self) -> bool:
        """Whether a compensator acts."""
        return self.controller["kind"] != "open"

    @property
    def amplitude(self) -> float:
        """Counts, of the encoder or of the command."""
        return abs(float(self.test["amplitude"]))

    def sized(self, factor: float, most: float) -> Trial:
        """The same test at another amplitude, whole counts, at most ``most``."""
        amplitude = round_half_up(min(self.amplitude * factor, most))
        amplitude -= amplitude > most
        return Trial({**self.test, "amplitude": float(max(amplitude, 1))}, self.controller)

    def as_run(self, rig: Rig) -> Run:
        """The test as a run that has not happened: from encoder count 0, row i's command from row i - 1's readings."""
        reference = reference_from_test(self.test, rig.sample_rate)
        command = np.clip(reference, -rig.command_limit, rig.command_limit)
        still = np.zeros_like(reference)
        return Run("planned", np.arange(len(reference)) * rig.period, reference, command, still, still,
                   RunMetadata(controller=self.controller, test=self.test, command_row=-1))

    def complete(self) -> dict[str, Any]:
        """Every key of the test that the station can be given, and the controller."""
        keys = {"kind": None, **defaults(self.test["kind"]), **self.test}
        return {**{k: v for k, v in keys.items() if v is not None}, "controller": dict(self.controller)}

    def repeats(self, runs: Iterable[Run]) -> bool:
        """Whether one of the runs is this test, or nearly so."""
        def alike(run: RunMetadata) -> bool:
            if run.test.get("kind") != self.test["kind"] or _bare(run.controller) != _bare(self.controller):
                return False
            other = run.test.get("amplitude", defaults(self.test["kind"])["amplitude"])
            return (isinstance(other, int | float) and other != 0
                    and abs(math.log(abs(other) / self.amplitude)) <= math.log(ALIKE))

        return any(alike(run.metadata) for run in runs)


def _bare(controller: Mapping[str, Any]) -> dict[str, Any]:
    """A controller without what each run measures anew; numbers as a log may have rounded them."""
    return {key: round(value, 3) if isinstance(value, float) else value for key, value in controller.items()
            if key not in ("accel_zero", "rounding", "accel_numerator", "accel_denominator")}


def most(trial: Trial, rig: Rig) -> float:
    """Largest amplitude that makes sense: the rig's largest command, or a fifth of a turn of the reference."""
    return 0.2 * rig.encoder.counts_per_revolution if trial.closed else rig.command_limit


def trials(rig: Rig, causes: Sequence[tuple[str, str]] = ()) -> list[Trial]:
    """Tests worth a thought on this rig, and those that the effects among ``causes`` are best told by."""
    scale = rig.encoder.counts_per_revolution / USUAL_TURN
    strength = rig.amplifier.limit / USUAL_LIMIT / scale
    # The accelerometer's compensator has its coefficients given sampled, and suits no other rig.
    suits = (rig.accelerometer is not None and rig.sample_rate == SAMPLED_AT and rig.amplifier.limit == USUAL_LIMIT
             and rig.encoder.counts_per_revolution == USUAL_TURN)
    found = [Trial(test, _scaled(controller, strength)).sized(scale, math.inf) for test, controller in CLOSED
             if controller is not BOTH or suits]
    found += [Trial(test, OPEN).sized(rig.amplifier.limit, rig.command_limit) for test in DRIVEN]
    for name, _ in causes:
        told = {} if is_constant(name) else dict(effect_class(name).experiment)
        controller = NAMED.get(told.pop("controller", "open" if told.get("kind") in ("pulse", "pulse_train") else "p"))
        if told and controller is not None and (controller is not BOTH or suits):
            trial = Trial({"amplitude": defaults(told["kind"])["amplitude"], **told}, _scaled(controller, strength))
            found.append(trial.sized(scale if trial.closed else 1.0, most(trial, rig)))
    return [trial for k, trial in enumerate(found) if trial not in found[:k]
            and max(trial.test.get("f0", 0.0), trial.test.get("f1", 0.0)) < 0.4 * rig.sample_rate]


def _scaled(controller: dict[str, Any], strength: float) -> dict[str, Any]:
    """A compensator of another gain, three digits of it."""
    if "gain" not in controller or strength == 1.0:
        return controller
    return {**controller, "gain": float(f"{controller['gain'] * strength:.3g}")}

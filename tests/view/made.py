"""Diagnoses made up for the views' tests: a flexible arm in plain Python with friction, so that no part under test
of the model or of the diagnosis is needed to draw them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from station.diagnose.measures import nrmse
from station.diagnose.result import (
    Cause,
    ChannelGain,
    Diagnosis,
    DiagnosisResult,
    Disturbance,
    Estimate,
    Gain,
    NextExperiment,
    Prediction,
    RankedCause,
    Reason,
    Rival,
    RunComparison,
    RunFile,
    RunGain,
    Wrong,
)
from station.diagnose.thresholds import OUTSIDE
from station.model.effects import effect_class
from station.model.simulate import Simulation
from station.pictures.picture import Evidence
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata

RATE, NODES = 500.0, 5
FRICTION = 0.031


def move(reference: np.ndarray, gain: float, friction: float, stiffness: float = 1.0) -> Simulation:
    """An arm with one flexible mode under proportional control (gain 0: open loop), coulomb friction on its motor."""
    steps, h = 8, 1.0 / RATE / 8
    angle = speed = bend = bend_speed = 0.0
    per_count = 2.0 * np.pi / 1024
    columns = []
    for target in reference:
        encoder = np.floor(angle / per_count + 0.5)
        command = float(np.clip(gain * (target - encoder) if gain else target, -200, 200))
        for _ in range(steps):
            reaction = 9.0 * stiffness * bend + 0.06 * bend_speed
            torque = 0.0107 * command - 0.16 * speed + 0.05 * reaction
            if abs(speed) < 1e-3 and abs(torque) < friction:
                acceleration, speed = 0.0, 0.0
            else:
                acceleration = (torque - friction * np.sign(speed or torque)) / 0.02
            speed += h * acceleration
            angle += h * speed
            bend_speed += h * (-330.0 * stiffness * bend - 1.6 * bend_speed - 0.42 * acceleration)
            bend += h * bend_speed
        tip = 0.41 * acceleration - 330.0 * bend - 1.6 * bend_speed - 0.42 * acceleration
        columns.append((command, encoder, np.floor(1.15 * tip + 0.5), angle, bend))
    command, encoder, accel, angle, bend = np.array(columns).T
    along = np.linspace(0.0, 1.0, NODES)
    shape = np.outer(angle, 0.41 * along) + np.outer(bend, along**2)
    t = np.arange(len(reference)) / RATE
    return Simulation(t, reference, command, encoder, accel, shape=shape)


@cache
def comparisons() -> tuple[RunComparison, ...]:
    """Five runs of an arm with friction beside simulations without, re-fitted without, and with it."""
    rng = np.random.default_rng(20)
    n = 700
    t = np.arange(n) / RATE
    step, pulse = np.where(t < 0.1, 0.0, 1.0), np.where((t > 0.1) & (t < 0.35), 1.0, 0.0)
    sweep = np.sin(2 * np.pi * (0.5 + 2.2 * t) * t)
    tests = [("step-kp2", {"kind": "step", "amplitude": 50}, 2.0, 50 * step),
             ("step-kp1-large", {"kind": "step", "amplitude": 100}, 1.0, 100 * step),
             ("pulse-open", {"kind": "pulse", "amplitude": 60}, 0.0, 60 * pulse),
             ("pulse-open-back", {"kind": "pulse", "amplitude": -60}, 0.0, -60 * pulse),
             ("sweep-kp1", {"kind": "sweep", "amplitude": 40}, 1.0, np.round(40 * sweep))]
    made = []
    for name, test, gain, reference in tests:
        true = move(reference, gain, FRICTION)
        facts = RunMetadata(rig="sflr", test=test,
                            controller={"kind": "p", "gain": gain} if gain else {"kind": "open"})
        run = Run(name, true.t, reference, true.command, true.encoder,
                  np.round(true.accel + rng.normal(0.0, 2.0, n)), facts)
        made.append(RunComparison(run, move(reference, gain, 0.0), move(reference, gain, 0.004, 0.97),
                                  move(reference, gain, 0.0305, 1.003)))
    return tuple(made)


def gain_of(made: tuple[RunComparison, ...], channel: str) -> ChannelGain:
    """The gain as the diagnosis would state it, the mean over the runs."""
    def mean(role: str) -> float:
        return float(np.mean([nrmse(getattr(c.run, channel), getattr(getattr(c, role), channel)) for c in made]))
    return ChannelGain(nrmse_before=mean("before"), nrmse_after=mean("after"))


STEPS = {"measured": (24.0, 0.071, 1.15), "before": (38.0, 0.066, None), "after": (22.0, 0.07, 1.12)}


def friction_evidence() -> Evidence:
    """A cloud of torque residuals against velocity and the law through it."""
    rng = np.random.default_rng(3)
    velocity = rng.normal(0.0, 2.2, 3000)
    residual = -FRICTION * np.sign(velocity) + rng.normal(0.0, 0.02, 3000)
    x = np.array([velocity.min(), -1e-3, 1e-3, velocity.max()])
    return Evidence("Torque that the simulation lacks, against motor velocity", "speed", "motor velocity (rad/s)",
                    "torque residual (N m)", velocity, residual, x, -0.0306 * np.sign(x),
                    "A constant torque that changes sign with the velocity: Coulomb friction.")


def phase_evidence() -> Evidence:
    """Few points over frequency, as for a delay."""
    frequency = np.geomspace(0.5, 40.0, 25)
    phase = -360.0 * frequency * 0.004 + np.random.default_rng(4).normal(0.0, 1.5, 25)
    return Evidence("Phase by which the measured angle lags the simulated one", "frequency", "frequency (Hz)",
                    "phase (degrees)", frequency, phase, frequency, -360.0 * frequency * 0.004, "A line through zero.")


def prediction() -> Prediction:
    """What friction would change in a small step, and what the rig without it would do."""
    first = comparisons()[0]
    return Prediction(first.run.t, ("no cause", "coulomb_friction at motor"),
                      (first.before.encoder, first.after.encoder), (first.before.accel, first.after.accel))


def result(verdict: str = "explained", rig: Rig | None = None, runs: int = 5) -> DiagnosisResult:
    """A diagnosis of that verdict, all parts of the report filled as far as the verdict has them."""
    rig = rig or load_rig("sflr")
    made = comparisons()[:runs]
    torque = Estimate(value=0.0305, low=0.0291, high=0.0319, unit="N m")
    friction = Cause(effect="coulomb_friction", at="motor", probability=0.982, parameters={"torque": torque},
                     stability=0.93,
                     rivals=[Rival(effect="stribeck_friction", at="motor", probability=0.014),
                             Rival(effect="dead_zone", at="amplifier", probability=0.003)])
    mass = Cause(effect="parameter:tip.mass", at="", probability=0.91,
                 parameters={"value": Estimate(value=0.0092, low=0.0088, high=0.0097, unit="kg")})
    named = verdict in ("explained", "partly_explained", "ambiguous")
    causes = [friction, mass][: 2 if verdict == "partly_explained" else 1] if named else []
    if not named:
        made = tuple(RunComparison(c.run, c.before, c.refit, None) for c in made)
    effect = effect_class("coulomb_friction")(at="motor", torque=0.0305)
    encoder, accel = (gain_of(comparisons()[:runs], c) for c in ("encoder", "accel")) if runs else (None, None)
    if runs and not named:
        encoder, accel = (ChannelGain(nrmse_before=g.nrmse_before, nrmse_after=g.nrmse_before)
                          for g in (encoder, accel))
    step = comparisons()[0]
    over, true = (100.0 * (s.encoder.max() / 50.0 - 1.0) for s in (step.before, step.run))
    wrong = [Wrong(run="step-kp2", channel="encoder", measure="overshoot_percent", simulated=over, measured=true),
             Wrong(run="step-kp2", channel="encoder", measure="settling_time", simulated=None, measured=0.82),
             Wrong(run="sweep-kp1", channel="accel", measure="nrmse", simulated=0.31, measured=None,
                   where="near 3 Hz, slow parts")]
    diagnosis = Diagnosis(
        verdict=verdict, outside=OUTSIDE if verdict in ("partly_explained", "unexplained") else 0.0, causes=causes,
        wrong=wrong if verdict != "nothing_missing" else [],
        gain=Gain(held_out=[c.run.name for c in made], encoder=encoder, accel=accel,
                  explained_fraction=0.93 if named else None, runs=[RunGain(
                      run=c.run.name, ahead={"0.1 s": ChannelGain(nrmse_before=0.04, nrmse_after=0.011)},
                      **{name: dict(zip(("overshoot_percent", "rise_time", "settling_time"), figures, strict=True))
                         for name, figures in STEPS.items() if "step" in c.run.name})
                      for c in made]),
        runs=[RunFile(run=c.run.name, file_sha256=f"{k:064x}") for k, c in enumerate(made)], effort="full",
        disturbance=Disturbance(nominal=0.31, refitted=0.22, extended=0.04),
        next_experiment=NextExperiment(
            test={"kind": "pulse", "amplitude": 25, "duration": 2.0},
            why="At small commands friction sticks and a dead zone does not move at all; they differ by 31 counts."))
    ranking = [
        RankedCause("coulomb_friction", "motor", 0.982, 8123.0, 0.41, reason=Reason("named" if named else "leads")),
        RankedCause("stribeck_friction", "motor", 0.014, 8124.5, 0.40, "no better, with two parameters more",
                    reason=Reason("open", tried="no better, with two parameters more")),
        RankedCause("dead_zone", "amplifier", 0.003, 6120.0, 0.22, reason=Reason("explains_less", 2003.0)),
        RankedCause("quadratic_drag", "base", 2e-6, 811.0, 0.04, reason=Reason("explains_less", 7312.0)),
        RankedCause("parameter:tip.mass", "", 1e-9, 230.0, -0.03, reason=Reason("left_out")),
        RankedCause("input_delay", "amplifier", 0.0, 12.0, -0.01, reason=Reason("left_out"))]
    constants = {path: Estimate(value=v * 1.04, low=v * 0.97, high=v * 1.11, unit="",
                                state="determined" if i % 4 else "traded_off")
                 for i, (path, v) in enumerate(rig.constants().items())}
    refit = rig.with_constants({path: e.value for path, e in constants.items()})
    return DiagnosisResult(diagnosis, rig, refit, refit.with_effects([effect]) if named else refit, list(made),
                           ranking, (lambda: [friction_evidence(), phase_evidence()]) if named else list, constants,
                           ["Noise: 0.31 counts of angle, 2.1 counts of acceleration, from the stretches at rest."],
                           12.3)


HOSTILE = '</script><img src=x onerror="window.stolen=1"><b>&amp;' + "long-name-" * 12


def hostile() -> DiagnosisResult:
    """A diagnosis whose every text from a file tries to be markup."""
    full = result()
    comparisons = [replace(c, run=replace(c.run, name=HOSTILE, metadata=RunMetadata(
        rig=HOSTILE, test={"kind": HOSTILE}, controller={"kind": HOSTILE}))) for c in full.comparisons[:2]]
    wrong = [Wrong(run=HOSTILE, channel="encoder", measure=HOSTILE, simulated=1.0, measured=2.0, where=HOSTILE)]
    causes = [Cause(effect=HOSTILE, at=HOSTILE, probability=0.9, parameters={HOSTILE: Estimate(
        value=1.0, low=0.5, high=1.5, unit=HOSTILE)})]
    diagnosis = full.diagnosis.model_copy(update={
        "wrong": wrong, "causes": causes, "next_experiment": NextExperiment(test={"kind": HOSTILE}, why=HOSTILE)})
    evidence = [replace(e, title=HOSTILE, xlabel=HOSTILE, ylabel=HOSTILE, note=HOSTILE) for e in full.evidence]
    ranking = [RankedCause(HOSTILE, HOSTILE, 0.9, 1.0, None, HOSTILE,
                           reason=Reason("beaten", instead=((HOSTILE, HOSTILE),), tried=HOSTILE))]
    rig = full.rig.model_copy(update={"name": HOSTILE[:100]})
    return replace(full, diagnosis=diagnosis, comparisons=comparisons, draw=lambda: evidence, ranking=ranking, rig=rig,
                   extended_rig=rig, notes=[HOSTILE])

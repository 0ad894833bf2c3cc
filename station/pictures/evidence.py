"""Pictures specific to a cause: what was measured once the cause is taken out, and the fitted law drawn through it.

Points never know the law: torques are smoothed from the run with nothing assumed (station.pictures.missing), ratios
are measured over simulated channels.  The rig that they are taken against is the extended rig without the one cause,
so that other causes do not blur the picture; the sceptic's view at the end is against the re-fitted rig alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import signal
from scipy.ndimage import median_filter

from station.estimation.cause import constant_path, is_constant
from station.estimation.pool import Pool
from station.model.along import joint_torque, law_values
from station.model.effects import Effect, Stage, catalogue
from station.model.modal import modal_form
from station.model.simulate import Simulation, build, by_load, simulate_model
from station.pictures.missing import MissingTorque, missing_torque, resting
from station.rig import Rig
from station.runs.run import Run, RunMetadata

POINTS = 2000
"""Most points in a picture."""
BANDS = 40
SPREAD = 0.1
"""Largest standard error of a ratio in a band that is drawn, a share of its size: 0.9 dB, or 6 degrees."""
DRIFT = 0.5
"""Share of a joint's wind-up (rms) by which two accounts of it may differ where its spring's law is drawn."""
FEWEST = 4
"""Spectral lines, over all runs, that a band holds at least: fewer would look coherent by themselves."""
_DELAYS = (Stage.INPUT_DELAY, Stage.ENCODER_DELAY, Stage.ACCEL_DELAY)


@dataclass(frozen=True)
class Evidence:
    """A picture specific to a cause: points, and the law drawn through them."""

    title: str
    kind: str
    xlabel: str
    ylabel: str
    x: np.ndarray
    y: np.ndarray
    law_x: np.ndarray | None = None
    law_y: np.ndarray | None = None
    note: str = ""
    without_y: np.ndarray | None = None
    """The rig without the cause, at the places of the law, where the picture shows both."""

    @property
    def drawn(self) -> bool:
        """Whether there is anything to draw; where not, the note says why."""
        return len(self.x) > 0


class _Cause(NamedTuple):
    """A cause's title, the extended rig that holds it, the same rig without it, and the runs."""

    title: str
    extended: Rig
    without: Rig
    runs: list[Run]


def evidence(rig: Rig, extended_rig: Rig, runs: Sequence[Run], causes: Sequence[tuple[str, str]],
             pool: Pool | None = None) -> list[Evidence]:
    """The pictures of each cause (effect or "parameter:TABLE.KEY", at), then the sceptic's view of the worst run.

    ``rig``: re-fitted without any cause; ``extended_rig``: with all.  A cause that the extended rig does not hold is
    passed over.  Without causes the whole sceptic's view is given: the torque that is missing at the motor against
    time, speed, angle, command, load and frequency.  ``pool``: processes over which the runs are spread.
    """
    found = [picture for name, at in causes for picture in _pictures(rig, extended_rig, list(runs), name, at)]
    torques = list((pool or Pool()).map(partial(missing_torque, rig), runs))
    if torques:
        worst, run = max(zip(torques, runs, strict=True), key=lambda pair: float(np.mean(pair[0].torque ** 2)))
        found += _sceptics_view(worst, run)[: 1 if found else None]
    return found


def _sceptics_view(found: MissingTorque, run: Run) -> list[Evidence]:
    """One run's missing torque against time, speed, angle, command, load and frequency, no law assumed."""
    note = (f"Run {run.name}. Nothing is assumed but the rig without any cause: the torque missing at the motor is a "
            "random walk, smoothed from command, encoder and accelerometer; its standard deviation is "
            f"{np.median(found.sigma):.2g} N m. Jumps are rounded by the smoothing; what is wrong elsewhere in the rig "
            "shows here too.")
    if found.mistrust > 1.0:
        note += (f" No torque there explains the accelerometer, which was taken {found.mistrust:g} times noisier than "
                 "at rest.")
    title, label_y = "Torque missing at the motor, against", "torque missing at the motor"
    views = [_thin(f"{title} {kind}", kind, label, f"{label_y} (N m)", x, found.torque, note=note)
             for kind, label, x in (("time", "time (s)", found.t), ("speed", "motor speed (rad/s)", found.speed),
                                    ("angle", "motor angle (rad)", found.angle),
                                    ("command", "command (counts)", found.command),
                                    ("load", "load on the gears (N m)", found.load))]
    rate = 1.0 / (found.t[1] - found.t[0])
    frequency, density = signal.welch(found.torque, rate, nperseg=min(512, len(found.t)))
    shown = (frequency > 0.0) & (frequency < 0.25 * rate)
    return [*views, _thin(f"{title} frequency", "spectrum", "frequency (Hz)", f"{label_y} (N m/√Hz)",
                          frequency[shown], np.sqrt(density[shown]), note=note)]


def _pictures(rig: Rig, extended: Rig, runs: list[Run], name: str, at: str) -> list[Evidence]:
    """Of one cause: chosen by the effect's own ``picture`` and by the stage at which it acts."""
    if is_constant(name):
        path = constant_path(name)
        if path not in rig.constants() or path not in extended.constants():
            return []
        without = extended.with_constants({path: rig.constants()[path]})
        return _modes(_Cause(f"wrong {path}", extended, without, runs))
    effect = next((e for e in extended.effects if (e.name, e.at) == (name, at)), None)
    if effect is None:
        return []
    if effect.absolute is not None:
        zero = runs[0].metadata.zero_id
        runs = runs[:1] + [r for r in runs[1:] if zero and r.metadata.zero_id == zero]
    title = catalogue()[name].title or name if name in catalogue() else name
    cause = _Cause(title, extended, extended.with_effects([e for e in extended.effects if e is not effect]), runs)
    if effect.stage is Stage.CLOCK:
        return _clock(cause) + _frequency(cause, effect, ("gain",))
    if effect.stage in _DELAYS or effect.picture == "frequency" and effect.stage is Stage.COMMAND:
        return _frequency(cause, effect, ("phase",))
    if effect.stage is Stage.ACCEL_FILTER:
        return _frequency(cause, effect, ("gain", "phase"))
    if effect.stage is Stage.ACCEL_INPUT:
        return _centripetal(cause, effect)
    if effect.stage is Stage.ACCEL_COUNTS:
        return _readings(cause, effect)
    if effect.stage is Stage.ENCODER:
        return _eccentricity(cause, effect)
    if effect.stage in (Stage.GAP, Stage.SPRING):
        return _joint(cause, effect)
    if effect.stage is Stage.COMMAND:
        return _command(cause)
    if by_load(extended, effect):
        return _load(cause, effect)
    if effect.stage in (Stage.TORQUE, Stage.FRICTION) and effect.picture in ("speed", "angle"):
        return _torque(cause, effect)
    return _torque_in_time(cause, effect)


def _thin(title: str, kind: str, xlabel: str, ylabel: str, x: np.ndarray, y: np.ndarray,
          law: tuple[np.ndarray, np.ndarray] | None = None, note: str = "") -> Evidence:
    """A picture of at most POINTS points."""
    every = slice(None, None, max(-(-len(x) // POINTS), 1))
    law_x, law_y = law or (None, None)
    return Evidence(title, kind, xlabel, ylabel, x[every], y[every], law_x, law_y, note)


def _estimates(cause: _Cause, at: str) -> list[MissingTorque]:
    """Of every run; by the encoder alone where no torque at this place explains the accelerometer of some run.

    Else the beam that the model has wrong would be made up for by torque, and that would bury the law.
    """
    found = [missing_torque(cause.without, run, at) for run in cause.runs]
    if all(m.mistrust == 1.0 for m in found):
        return found
    return [missing_torque(cause.without, run, at, accelerometer=False) for run in cause.runs]


def _joined(found: Sequence[MissingTorque]) -> MissingTorque:
    """The rows of all runs, one run after the other, with the first run's step and mistrust."""
    rows: dict[str, Any] = {name: np.concatenate([getattr(m, name) for m in found])
                            for name, first in vars(found[0]).items() if isinstance(first, np.ndarray)}
    return replace(found[0], by_accel=any(m.by_accel for m in found), **rows)


def _torque_note(cause: _Cause, found: MissingTorque, line: str = "Line: the fitted law.") -> str:
    alone = "" if cause.extended.accelerometer is None or found.by_accel else ", by command and encoder alone,"
    return (f"Points: torque smoothed from {_count(cause.runs)}{alone} against the extended rig without this effect, "
            f"its shape not assumed; standard deviation {np.median(found.sigma):.2g} N m, jumps rounded. {line}")


def _count(runs: Sequence[Run]) -> str:
    return "1 run" if len(runs) == 1 else f"{len(runs)} runs"


def _grid(x: np.ndarray) -> np.ndarray:
    """400 places over the range of x, and both sides of 0."""
    low, high = float(np.min(x)), float(np.max(x))
    grid = np.linspace(low, high, 400)
    tiny = 1e-9 * max(abs(low), abs(high), 1e-9)
    return np.sort(np.concatenate([grid, [-tiny, tiny]])) if low < 0.0 < high else grid


def _torque(cause: _Cause, effect: Effect) -> list[Evidence]:
    """Missing torque at a part against its speed, of which alone friction is a law, or its angle."""
    found = _joined(_estimates(cause, effect.at))
    by_speed = effect.stage is Stage.FRICTION or effect.picture == "speed"
    x, against = (found.speed, "speed") if by_speed else (found.angle, "angle")
    grid, law = _grid(x), None
    if not effect.states:
        if effect.stage is Stage.FRICTION:
            law = grid, -np.sign(grid) * law_values(cause.extended, effect, np.abs(grid))
        else:
            law = grid, law_values(cause.extended, effect, *((0.0, grid) if by_speed else (grid, 0.0)))
    label = f"{effect.at} speed (rad/s)" if by_speed else f"{effect.at} angle (rad)"
    rest = " At rest anything between its two sides may hold." if effect.stage is Stage.FRICTION else ""
    return [_thin(f"Torque missing at the {effect.at}, against its {against}: {cause.title}", against,
                  label, "missing torque (N m)", x, found.torque, law, _torque_note(cause, found) + rest)]


def _torque_in_time(cause: _Cause, effect: Effect) -> list[Evidence]:
    """Missing torque at the effect's part against time, where the effect names no better picture."""
    at = effect.at if effect.at in ("motor", "base", "drive", "clamp") else "motor"
    found = _estimates(cause, at)
    worst = max(found, key=lambda m: float(np.mean(m.torque**2)))
    if effect.stage is Stage.FRICTION:
        law = -np.sign(worst.speed) * law_values(cause.extended, effect, np.abs(worst.speed), 0.0, np.abs(worst.load))
    else:
        law = law_values(cause.extended, effect, worst.angle, worst.speed)
    note = _torque_note(cause, _joined(found), "The run that misses most. Line: the fitted law along its motion.")
    return [_thin(f"Torque missing at the {at}, against time: {cause.title}", "time", "time (s)",
                  "missing torque (N m)", worst.t, worst.torque, (worst.t, law), note)]


def _load(cause: _Cause, effect: Effect) -> list[Evidence]:
    """Friction in proportion to load: what opposes the motor's motion against the load on its gears."""
    found = _joined(_estimates(cause, "motor"))
    load, moving = np.abs(found.load), np.abs(found.speed) > 0.02 * np.max(np.abs(found.speed))
    grid = _grid(load)
    law = None if effect.states else (grid, law_values(cause.extended, effect, 1.0, 0.0, grid))
    load_is = ("the torque in the drive" if cause.extended.drive is not None else
               "the motor's torque less what acts on the axis from outside (gravity, a beam)")
    return [_thin(f"Torque that opposes the motor, against the load on its gears: {cause.title}", "load",
                  "size of the load on the gears (N m)", "torque missing against the motion (N m)", load[moving],
                  (-np.sign(found.speed) * found.torque)[moving], law,
                  _torque_note(cause, found) + f" The load is {load_is}; rows at rest are left out.")]


def _joint(cause: _Cause, effect: Effect) -> list[Evidence]:
    """The drive or clamp against its wind-up: a spring by its torque, play by the share of the torque that it carries.

    Play is drawn as a share because a damper's torque, which has no place on the axis, may outweigh the spring's.
    """
    at, h = effect.at, cause.extended.period
    each = _estimates(cause, at)
    seen = [k for k, one in enumerate(each) if _wind_up_is_seen(cause, effect, cause.runs[k], one)]
    if not seen:
        return [_unseen_wind_up(cause, at)]
    cause = cause._replace(runs=[cause.runs[k] for k in seen])
    found, joint = _joined([each[k] for k in seen]), getattr(cause.extended, at)
    angle, speed = found.angle, found.speed
    total = joint_torque(cause.without, at, angle, speed, h) - found.torque
    label = f"{'motor - base' if at == 'drive' else 'base - beam root'} (rad)"
    source = f"Points: spring and damper of the {at} plus what is missing there, smoothed from {_count(cause.runs)}"
    if effect.stage is Stage.GAP:
        linear = joint.stiffness * angle + joint.damping * speed
        clear = np.abs(linear) > 0.05 * np.max(np.abs(linear))
        share = joint_torque(cause.extended, at, angle, speed, h)[clear] / linear[clear]
        return [_thin(f"Share of its torque that the {at} carries, against its wind-up: {cause.title}", "deflection",
                      label, f"torque of the {at} over the same without play", angle[clear],
                      total[clear] / linear[clear], _running_median(angle[clear], share),
                      f"{source}, over what it would carry without play; rows with less than 5 % of the largest torque "
                      "are left out. The smoothing rounds the edges of the gap and fills it in part. Line: the "
                      "fitted law on the same motion, its median.")]
    grid = _grid(angle)
    doubt = ("" if at == "drive" else " The sensors tell this torque better than the wind-up, which is estimated "
             "towards that of a linear clamp: where the law is steep, points lie inside it.")
    return [_thin(f"Torque of the {at} against its wind-up: {cause.title}", "deflection", label,
                  f"torque of the {at} less its damper (N m)", angle, total - joint.damping * speed,
                  (grid, joint_torque(cause.extended, at, grid, np.zeros(len(grid)), h)),
                  f"{source}; the damper's part is taken off. Line: the fitted law.{doubt}")]


def _wind_up_is_seen(cause: _Cause, effect: Effect, run: Run, found: MissingTorque) -> bool:
    """Whether the sensors tell a joint's wind-up in a run well enough to draw its law against it.

    No sensor reads the motor.  Its place is worked out from the command, and a small torque that the model lacks makes
    it drift.  Two accounts meet the readings alike: a torque missing in the joint (``found``), and with the cause in
    its place one at the motor.  They must put the wind-up closer together than the play is wide, or of a spring than
    DRIFT of the wind-up itself (rms).
    """
    other = missing_torque(cause.extended, run, "motor", along=effect.at, accelerometer=found.by_accel)
    allowed = effect.values()["gap"] if "gap" in effect.values() else DRIFT * _rms(other.angle)
    return _rms(found.angle - other.angle) <= allowed


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _unseen_wind_up(cause: _Cause, at: str) -> Evidence:
    """Why there is no picture of a joint's law."""
    nothing = np.zeros(0)
    return Evidence(f"Torque of the {at} against its wind-up: {cause.title}", "none", "", "", nothing, nothing,
                    note=f"Not drawn: these runs do not show the wind-up of the {at}. No sensor reads the motor's own "
                         "angle, and what little torque the model lacks there lets its estimate drift by more than "
                         "the law bends. This speaks neither for the cause nor against it.")


def _running_median(x: np.ndarray, y: np.ndarray, width: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Median of y over neighbours in x."""
    order = np.argsort(x)
    every = max(len(x) // 400, 1)
    return x[order][::every], median_filter(y[order], size=width, mode="nearest")[::every]


def _chain(rig: Rig, command: np.ndarray) -> np.ndarray:
    """The static part of the amplifier's chain."""
    out = np.clip(command, -rig.command_limit, rig.command_limit)
    for effect in sorted((e for e in rig.effects if e.stage is Stage.COMMAND and not e.states), key=lambda e: e.order):
        out = law_values(rig, effect, out, 0.0, rig.amplifier.limit)
    return out


def _command(cause: _Cause) -> list[Evidence]:
    """Missing torque at the motor, in counts, against the command."""
    each = _estimates(cause, "motor")
    found = _joined(each)
    late = sum(e.values()["time"] for e in cause.without.effects if e.stage is Stage.INPUT_DELAY)
    command = np.concatenate([np.interp(m.t - late, m.t, m.command, left=0.0) for m in each])
    grid = _grid(command)
    law = grid, _chain(cause.extended, grid) - _chain(cause.without, grid)
    return [_thin(f"Command that is missing, against the command: {cause.title}", "command", "command (counts)",
                  "missing torque over motor gain (counts)", command, found.torque / cause.extended.motor.gain, law,
                  _torque_note(cause, found, "Line: what the fitted chain adds to the command."))]


def _command_driven(rig: Rig, run: Run) -> Simulation:
    """The run's logged command through the rig; the right comparison for a sensor, closed loop or not."""
    start, offset = resting(rig, run)
    alone = replace(run, metadata=RunMetadata(start=run.metadata.start))
    return simulate_model(build(rig), alone, rounding=False, start_angle=start, accel_offset=offset)


def _readings(cause: _Cause, effect: Effect) -> list[Evidence]:
    """Measured against simulated accelerometer."""
    runs = [run for run in cause.runs if run.accel is not None]
    x = np.concatenate([_command_driven(cause.without, run).accel for run in runs])
    grid = _grid(x)
    law = None if effect.states else (grid, law_values(cause.extended, effect, grid))
    return [_thin(f"Accelerometer, measured against simulated: {cause.title}", "acceleration",
                  "simulated without the effect (counts)", "measured (counts)", x,
                  np.concatenate([run.accel for run in runs]), law,
                  f"Points: {_count(runs)}, simulated from the logged command. Line: the fitted law; without the "
                  "effect points would lie on the diagonal.")]


def _centripetal(cause: _Cause, effect: Effect) -> list[Evidence]:
    """What the accelerometer reads too much, against the base's speed squared."""
    rig = cause.extended
    assert rig.accelerometer is not None and rig.beam is not None
    runs = [run for run in cause.runs if run.accel is not None]
    speed = np.concatenate([missing_torque(cause.without, run, accelerometer=False).base_speed for run in runs])
    y = np.concatenate([run.accel - _command_driven(cause.without, run).accel for run in runs])
    grid = np.linspace(0.0, float(np.max(np.abs(speed))), 200)
    law = None if effect.states else (grid**2, law_values(rig, effect, grid, 0.0, rig.beam.length))
    return [_thin(f"Acceleration read beyond the simulated, against speed squared: {cause.title}", "speed",
                  "base speed squared (rad²/s²)", "measured - simulated (m/s²)", speed**2, y / rig.accelerometer.gain,
                  law, f"Points: {_count(runs)}; the speed is smoothed from command and encoder, the acceleration "
                  "simulated from the logged command. Line: the fitted law.")]


def _eccentricity(cause: _Cause, effect: Effect) -> list[Evidence]:
    """The encoder's error against the angle: the fit's residual with this effect's own part put back."""
    x, y, model = [], [], build(cause.extended)
    for run in cause.runs:
        start, offset = resting(cause.extended, run)
        reading = simulate_model(model, run, rounding=False, start_angle=start, accel_offset=offset).encoder
        angle = reading * cause.extended.angle_per_count
        x.append(angle)
        y.append(run.encoder - reading + law_values(cause.extended, effect, angle))
    angle = np.concatenate(x)
    grid = _grid(angle)
    return [_thin(f"Error of the encoder, against the angle: {cause.title}", "angle", "base angle (rad)",
                  "encoder error (counts)", angle, np.concatenate(y), (grid, law_values(cause.extended, effect, grid)),
                  f"Points: measured minus simulated, {_count(cause.runs)}, with this effect's fitted part put back (a "
                  "partial residual: the angle comes from the extended rig, it cannot come from the encoder that is in "
                  "doubt). Line: the fitted law.")]


def _clock(cause: _Cause) -> list[Evidence]:
    """Host clock against device clock, where a run holds both."""
    timed = [run for run in cause.runs if run.host_time is not None and run.device_time is not None]
    if not timed:
        return []
    run = max(timed, key=len)
    device = run.device_time - run.device_time[0]
    drift = run.host_time - run.host_time[0] - device
    slope = math.prod(e.values()["ratio"] for e in cause.extended.effects if e.stage is Stage.CLOCK) - 1.0
    grid = np.array([0.0, device[-1]])
    return [_thin(f"Host clock minus device clock: {cause.title}", "time", "device time (s)", "drift (ms)", device,
                  1e3 * drift, (grid, 1e3 * slope * grid),
                  f"Run {run.name}. Line: the fitted ratio; latency of single samples shows as scatter above it.")]


class _Ratios(NamedTuple):
    """Measured, extended and without the cause over the same input, (m) in bands, in the channel that shows it best."""

    channel: str
    frequency: np.ndarray
    measured: np.ndarray
    extended: np.ndarray
    without: np.ndarray


def _ratios(cause: _Cause, over_command: bool, weigh: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> _Ratios | None:
    """Over the command or over the rig without the cause; shown is the channel of the largest sum of what ``weigh``
    says of the extended rig and of that without the cause."""
    sources: list[Sequence[Run | Simulation]] = [
        cause.runs, *([_command_driven(rig, run) for run in cause.runs] for rig in (cause.extended, cause.without))]
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


def _decibel(ratio: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.maximum(np.abs(ratio), 1e-6))


def _degrees(ratio: np.ndarray) -> np.ndarray:
    return np.degrees(np.unwrap(np.angle(ratio)))


_QUANTITIES = {"gain": ("Size", "measured over simulated (dB)", "0.9 dB", _decibel),
               "phase": ("Phase", "phase of measured over simulated (degrees)", "6 degrees", _degrees)}
"""Word, label and SPREAD of each, and how it is had of a ratio."""


def _frequency(cause: _Cause, effect: Effect, quantities: tuple[str, ...]) -> list[Evidence]:
    """Measured over simulated response against frequency, in the channel on which the cause bears most."""
    found = _ratios(cause, False, lambda extended, without: np.abs(extended - without))
    if found is None:
        return []
    pictures = []
    for quantity in quantities:
        word, label, limit, of = _QUANTITIES[quantity]
        line, how = of(found.extended), "Line: the extended rig over the same, estimated alike."
        if quantity == "phase" and effect.stage in _DELAYS:
            line = -360.0 * found.frequency * next(iter(effect.values().values()))
            how = "Below 0 the measured is late. Line: -360 degrees times frequency times the fitted delay."
        pictures.append(Evidence(
            f"{word} of the measured {_SENSORS[found.channel]} against the simulated, over frequency: {cause.title}",
            "frequency", "frequency (Hz)", label, found.frequency, of(found.measured), found.frequency, line,
            f"Points: cross over power spectra of {_count(cause.runs)}, simulated from the logged command without "
            f"this cause; bands with a standard error above {limit} are left out. {how}"))
    return pictures


def _modes(cause: _Cause) -> list[Evidence]:
    """What a wrong constant moves: the response to the command over frequency, measured and of both rigs."""
    found = _ratios(cause, True, lambda extended, without: np.abs(_decibel(extended) - _decibel(without)))
    if found is None:
        return []
    sensor = _SENSORS[found.channel]
    unit = "counts per count" if found.channel == "accel" else "counts per sample and count"
    moved = "; ".join(f"{a:.3g} Hz becomes {b:.3g} Hz" for a, b in
                      zip(_resonances(cause.without), _resonances(cause.extended), strict=False))
    modes = f" Modes below {0.25 * cause.extended.sample_rate:g} Hz: {moved}." if moved else ""
    return [Evidence(
        f"Response of the {sensor} to the command, over frequency: {cause.title}", "frequency", "frequency (Hz)",
        f"{sensor} over command (dB, {unit})", found.frequency, _decibel(found.measured), found.frequency,
        _decibel(found.extended),
        f"Points: cross over power spectra of {_count(cause.runs)}; bands with a standard error above 0.9 dB are left "
        f"out. Lines: both rigs from the logged command, estimated alike.{modes}", _decibel(found.without))]


_SENSORS = {"encoder": "angle", "accel": "acceleration"}


def _channels(cause: _Cause) -> list[str]:
    """The channels that the rig and all its runs have."""
    lacks = cause.extended.accelerometer is None or any(r.accel is None for r in cause.runs)
    return ["encoder"] if lacks else ["encoder", "accel"]


def _resonances(rig: Rig) -> list[float]:
    """Undamped frequencies (Hz) of the oscillating modes below a quarter of the sample rate, lowest first."""
    values = modal_form(build(rig.with_effects([])).assembly).eigenvalues.ravel()
    found = sorted({round(abs(v) / (2.0 * math.pi), 6) for v in values if abs(v.imag) > 1e-6 * abs(v)})
    return [f for f in found if f < 0.25 * rig.sample_rate]


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
            frequency, spectrum = signal.csd(a, b, rate, window=("tukey", 0.1), nperseg=len(x), nfft=longest,
                                             detrend=False)
            sums[row] += spectrum * len(x)
    lines = sum(len(x) for x, _ in pairs) / longest
    fewest = max(math.ceil(FEWEST / lines), 1)
    ratio = (0.3 * longest) ** (1.0 / BANDS)
    rows, end = [], 1
    while frequency[end] < 0.3 * rate:
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

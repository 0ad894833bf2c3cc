"""Runs, a nominal rig and everything that a hypothesis may move, as one weighted least-squares problem.

Residuals are (measured - simulated) times a scale per sample, the simulation unrounded so that it is smooth in its
parameters.  The scale is sqrt(share)/sigma; sigma^2 holds sensor noise, rounding, and what rounding inside the loop
feeds back (``calibrate``).  While the encoder stands still its rounding error stands still too, so many samples say no
more than one: ``share`` is the number of independent rounding errors per sample.  The rig's
constants enter as w with log(c/c_nominal) = L w, L L^T their prior covariance, so that their prior is |w|^2; every
other parameter has a prior of its own.  Per run the starting angle and the accelerometer's offset are nuisances,
estimated always.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from station.control.compensators import commanded
from station.diagnose.noise import QUANTISATION, correlation_time, noise_sigmas, rest_rows, rounding_shares
from station.model.effects import Effect, ParameterInfo, Stage
from station.model.simulate import Model, Simulation, build, simulate_model
from station.rig import Rig
from station.runs.run import Run

TRUNCATION, LONGEST, LONGEST_GAP = 0.1, 1e-3, 5e-4
"""Accuracy of the simulations in a search: modes left out (counts), longest step (s), and that where a gap closes with
a blow (s); below 0.1 count."""
QUICK, FINE, ROUGH = (TRUNCATION, LONGEST, LONGEST_GAP), (0.01, 5e-4, 2e-4), (1.0, 2e-3, 1e-3)
"""The same, that of the simulations from which values are stated, and that where all models are far from the noise."""
ELEMENTS = 8
"""Fewest beam elements of the fits: with fewer the mesh's own error would look like physics."""
FARTHEST = 8.0
"""Largest logarithm of a constant over its nominal value that is ever simulated."""
MISFIT = 3.0
"""Variance of what is left, over the noise's, from which on it is taken for a misfit."""
FEATURES = 60.0
"""Independent errors that a misfit counts for, per run and channel: a few seconds of a few hertz."""
REALISATIONS = 16
DIVERGED = 1e9
"""Counts at which a model's loop has run away."""
WIDE = 1.5
"""Prior sigma of the logarithm of a constant that a hypothesis sets free, and of an effect's size."""


@dataclass(frozen=True)
class Coordinate:
    """One parameter of an effect as the fit moves it: value = exp(x), or origin + scale x."""

    effect: int
    name: str
    info: ParameterInfo
    log: bool
    scale: float
    origin: float = 0.0

    def to_value(self, x: float) -> float:
        """The parameter's value, kept within its bounds."""
        value = math.exp(min(max(x, -80.0), 80.0)) if self.log else self.origin + self.scale * x
        if self.info.periodic:
            return (value + math.pi) % (2.0 * math.pi) - math.pi
        return min(max(value, self.info.low), self.info.high)

    def to_x(self, value: float) -> float:
        """Inverse of ``to_value``."""
        return math.log(max(value, 1e-300)) if self.log else (value - self.origin) / self.scale


@dataclass(frozen=True)
class Hypothesis:
    """A set of causes: effects (class, place) on top of the rig's own, and constants set free."""

    effects: tuple[tuple[type[Effect], str], ...] = ()
    constants: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """For tables and progress."""
        names = [f"{cls.name}@{at}" for cls, at in self.effects] + [f"parameter:{c}" for c in self.constants]
        return " + ".join(names) or "nothing"

    def causes(self) -> list[tuple[str, str]]:
        """(effect, at) of every cause, as the diagnosis file names them."""
        return [(cls.name, at) for cls, at in self.effects] + [(f"parameter:{c}", "") for c in self.constants]

    def __add__(self, other: Hypothesis) -> Hypothesis:
        return Hypothesis(self.effects + other.effects, self.constants + other.constants)


@dataclass
class Layout:
    """Where the parameters of one hypothesis stand in a vector, and their prior."""

    hypothesis: Hypothesis
    paths: list[str]
    root: np.ndarray
    coordinates: list[Coordinate]
    zeros: int
    """Further encoder zeros (beyond the first) whose absolute angle is unknown."""
    gap_places: int
    prior_mean: np.ndarray
    prior_precision: np.ndarray

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.prior_mean.size


class Problem:
    """The data side; see the module."""

    def __init__(self, rig: Rig, runs: Sequence[Run], threads: int = 2, windows: Sequence[slice] | None = None,
                 ) -> None:
        """``windows``: the rows of each run that count (all of them by default)."""
        self.windows = list(windows) if windows is not None else [slice(None)] * len(runs)
        self.rig, self.runs = rig.with_elements(ELEMENTS), list(runs)
        self.paths = list(rig.constants())
        encoder, accel, self.noise_rows = noise_sigmas(self.runs)
        self.noise = (encoder, accel)
        self.sigma = np.array([math.sqrt(encoder**2 + QUANTISATION), math.sqrt(accel**2 + QUANTISATION)])
        self.has_accel = rig.accelerometer is not None and all(r.accel is not None for r in self.runs)
        self.measured = [np.stack([r.encoder, r.accel]) if self.has_accel else r.encoder[None, :] for r in self.runs]
        self.share = [self._shares(r, w) for r, w in zip(self.runs, self.windows, strict=True)]
        self.scale = [np.sqrt(share) / self.sigma[: self.channels, None] for share in self.share]
        self.temper = np.ones((len(self.runs), self.channels))
        self.chatter = [np.zeros_like(share) for share in self.share]
        self.by_command, self.accuracy = True, QUICK
        self._driven = [_driven(r) for r in self.runs]
        self.start = np.array([self._start_angle(r) for r in self.runs])
        self.offset = np.array([self._offset(r) for r in self.runs])
        zero_ids = [r.metadata.zero_id or f"own {i}" for i, r in enumerate(self.runs)]
        groups = list(dict.fromkeys(zero_ids))
        self.zero_group = [groups.index(z) for z in zero_ids]
        self.clock = clock_evidence(self.runs)
        self.pool = ThreadPoolExecutor(threads)

    def _shares(self, run: Run, window: slice) -> np.ndarray:
        """Independent errors per sample (channels, n)."""
        rounded = np.ones_like(run.encoder) if self.noise[0] > 0.3 else rounding_shares(run.encoder)
        share = np.stack([rounded, np.ones_like(rounded)])[: self.channels]
        counts = np.zeros(len(rounded))
        counts[window] = 1.0
        return share * counts

    @property
    def samples(self) -> np.ndarray:
        """Independent samples per run."""
        return np.array([share.sum() for share in self.share])

    def calibrate(self, layout: Layout, x: np.ndarray, start: np.ndarray, offset: np.ndarray) -> None:
        """See on the model what rounding inside a closed loop does, and allow for it.

        Rounding makes the command chatter; chatter against the limit or against friction has a mean.  REALISATIONS
        pairs of simulations, with and without rounding, started within one count of each other, give that mean, which
        is added to every simulation, and the scatter about it, which is added to the noise (times how long it lasts).
        Rigs driven by the logged command know of no such thing: the chatter is in the log.  A run in which rounding
        alone makes the model's loop diverge keeps what was allowed for before.
        """
        model = self.model(layout, x)
        rng = np.random.default_rng(1)

        def pair(task: tuple[int, float, float]) -> np.ndarray:
            r, angle, shift = task
            both = [self.simulate_run(model, layout, x, r, start[r] + angle, offset[r] + shift, rounding=flag)
                    for flag in ("inside", False)]
            return np.stack([getattr(both[0], c) - getattr(both[1], c) for c in ("encoder", "accel")[: self.channels]])

        for r, run in enumerate(self.runs):
            if commanded(run.metadata.controller):
                continue
            shifts = rng.uniform(-0.5, 0.5, (REALISATIONS, 2)) * [self.rig.angle_per_count, 1.0]
            differences = np.array(list(self.pool.map(pair, [(r, *shift) for shift in shifts])))
            if not np.all(np.abs(differences) < DIVERGED):
                continue
            self.chatter[r] = differences.mean(axis=0)
            for c in range(self.channels):
                scatter = differences[:, c] - self.chatter[r][c]
                power = float(np.mean(scatter**2)) * REALISATIONS / (REALISATIONS - 1)
                lasting = float(np.mean([correlation_time(row) for row in scatter]))
                fed_back = power * lasting
                self.scale[r][c] = np.sqrt(self.share[r][c] / (self.sigma[c] ** 2 + fed_back) / self.temper[r, c])

    def weigh(self, residuals: list[np.ndarray]) -> None:
        """Weigh runs and channels alike where a model misses something.

        A misfit is no noise: it is larger, it lasts, and samples do not make it more certain.  Each run and channel in
        which it stands out counts as FEATURES independent errors of the size that is left there, so that no one
        channel's misfit decides alone.
        """
        for r, (e, share) in enumerate(zip(residuals, self.share, strict=True)):
            for c in range(self.channels):
                left = float(e[c] @ e[c])
                if left > MISFIT * float(share[c].sum()):
                    self.temper[r, c] *= left / FEATURES
                    self.scale[r][c] *= math.sqrt(FEATURES / left)

    def unweigh(self) -> None:
        """Back to the noise's own weights."""
        for r in range(len(self.runs)):
            self.scale[r] *= np.sqrt(self.temper[r])[:, None]
        self.temper[:] = 1.0

    def near_reading(self, start: np.ndarray) -> np.ndarray:
        """Starting angles (rad), kept within one count of what the encoder read: no misfit may move them further."""
        return np.clip(start, self.start - self.rig.angle_per_count, self.start + self.rig.angle_per_count)

    def _start_angle(self, run: Run) -> float:
        return float(np.mean(run.encoder[: max(min(rest_rows(run), 100), 1)])) * self.rig.angle_per_count

    def _offset(self, run: Run) -> float:
        return float(np.mean(run.accel[: max(rest_rows(run), 1)])) if self.has_accel else 0.0

    def beginning(self, seconds: float) -> Problem:
        """The same problem with only so much of every run as follows its first command; driven by command."""
        ends = [int(np.argmax(run.command != 0.0)) + math.ceil(seconds * run.sample_rate) for run in self.runs]
        short = Problem(self.rig, [run.slice(0, end) for run, end in zip(self.runs, ends, strict=True)],
                        windows=self.windows)
        short.pool, short.clock, short.accuracy = self.pool, self.clock, self.accuracy
        short.scale = [scale[:, :end] for scale, end in zip(self.scale, ends, strict=True)]
        return short

    @property
    def channels(self) -> int:
        """1 without an accelerometer, else 2."""
        return 2 if self.has_accel else 1

    def layout(self, hypothesis: Hypothesis, guess: dict[int, dict[str, float]]) -> Layout:
        """Parameters of a hypothesis; ``guess`` gives each effect's sizes, the centres of their priors."""
        covariance = self.rig.log_covariance(self.paths)
        for path in hypothesis.constants:
            i = self.paths.index(path)
            covariance[i, i] += WIDE**2
        root = np.linalg.cholesky(covariance)
        mean, precision = [0.0] * len(self.paths), [1.0] * len(self.paths)
        coordinates = []
        shifted = False
        gaps = 0
        for k, (cls, at) in enumerate(hypothesis.effects):
            usual = cls.guesses(self.rig, at)
            for name, info in cls.parameters().items():
                value = guess[k][name]
                coordinate = _coordinate(k, name, info, value, [g[name] for g in usual])
                log = coordinate.log
                coordinates.append(coordinate)
                if cls.stage is Stage.CLOCK and self.clock is not None:
                    mean.append(coordinate.to_x(self.clock[0]))
                    unit = self.clock[0] if coordinate.log else coordinate.scale
                    precision.append((unit / self.clock[1]) ** 2)
                    continue
                mean.append(coordinate.to_x(value))
                precision.append(WIDE**-2 if log else (0.1 if info.periodic else 0.25))
            shifted |= cls.absolute is not None
            gaps += cls.stage.value == "gap"
        zeros = max(self.zero_group) if shifted else 0
        gap_places = len(self.runs) if gaps else 0
        mean += [0.0] * (zeros + gap_places)
        precision += [0.25] * zeros + [1.0] * gap_places
        return Layout(hypothesis, self.paths, root, coordinates, zeros, gap_places, np.array(mean),
                      np.array(precision))

    def rig_of(self, layout: Layout, x: np.ndarray) -> Rig:
        """The rig that a parameter vector describes."""
        n = len(self.paths)
        nominal = self.rig.constants()
        logs = np.clip(layout.root @ x[:n], -FARTHEST, FARTHEST)
        rig = self.rig.with_constants({p: nominal[p] * math.exp(v) for p, v in zip(self.paths, logs, strict=True)})
        values: list[dict[str, float]] = [{} for _ in layout.hypothesis.effects]
        for coordinate, value in zip(layout.coordinates, x[n:], strict=False):
            values[coordinate.effect][coordinate.name] = coordinate.to_value(value)
        effects = [cls.model_construct(at=at, **_ordered(cls, v))
                   for (cls, at), v in zip(layout.hypothesis.effects, values, strict=True)]
        return rig.with_effects((*self.rig.effects, *effects)) if effects else rig

    def model(self, layout: Layout, x: np.ndarray) -> Model:
        """The rig that a parameter vector describes, made ready for the many simulations of a fit."""
        truncation, longest, longest_gap = self.accuracy
        return build(self.rig_of(layout, x), truncation, longest_gap if layout.gap_places else longest)

    def simulate_run(self, model: Model, layout: Layout, x: np.ndarray, index: int, start: float,
                     offset: float, rounding: bool | Literal["inside"] = False, by_command: bool = False) -> Simulation:
        """One run on a built rig with its nuisances; ``start`` (rad) is what the encoder reads at sample 0.

        ``by_command`` drives the rig with the logged command instead of closing the loop.
        """
        extra = len(self.paths) + len(layout.coordinates)
        group = self.zero_group[index]
        zero = x[extra + group - 1] if layout.zeros and group else 0.0
        place = math.tanh(x[extra + layout.zeros + index]) if layout.gap_places else 0.0
        angle = _angle_that_reads(model.rig, start, zero)
        run = (self._driven if by_command else self.runs)[index]
        return simulate_model(model, run, rounding=rounding, start_angle=angle, accel_offset=offset,
                              zero=zero, gap_place=place)

    def outputs(self, layout: Layout, x: np.ndarray, start: np.ndarray, offset: np.ndarray,
                parallel: bool = False, by_command: bool | None = None) -> list[np.ndarray]:
        """Simulated channels per run, each (channels, n), scaled; ``parallel`` not from one of the pool's threads."""
        model = self.model(layout, x)
        by_command = self.by_command if by_command is None else by_command

        def one(i: int) -> np.ndarray:
            simulation = self.simulate_run(model, layout, x, i, start[i], offset[i], by_command=by_command)
            columns = (simulation.encoder, simulation.accel)[: self.channels]
            return (np.stack(columns) + self.chatter[i]) * self.scale[i]

        return list((self.pool.map if parallel else map)(one, range(len(self.runs))))


def _driven(run: Run) -> Run:
    """The same run as an open-loop test of its logged command."""
    return replace(run, reference=run.command,
                   metadata=run.metadata.model_copy(update={"controller": {"kind": "open"}}))


def _angle_that_reads(rig: Rig, reading: float, zero: float) -> float:
    """The base angle (rad) at which an encoder with an error of its own shows a reading (rad)."""
    errors = [e for e in rig.effects if e.stage is Stage.ENCODER]
    angle = reading
    for _ in range(5 if errors else 0):
        counts = sum(type(e).law(angle + zero, 0.0, 0.0, e.arguments(rig), (), 0.0) for e in errors)
        angle = reading - counts * rig.angle_per_count
    return angle


def clock_evidence(runs: Sequence[Run]) -> tuple[float, float] | None:
    """True over nominal sample period and its standard error, by regression of host_time on device_time.

    None where no run has both; a simulated device's virtual time is no clock.  The error is taken from the scatter of
    the residuals and, since receipt is never early, is not allowed below 20 parts per million.
    """
    slopes, weights = [], []
    for run in runs:
        virtual = getattr(run.metadata, "clock", None) == "virtual"
        if run.host_time is None or run.device_time is None or virtual:
            continue
        x, y = run.device_time - run.device_time.mean(), run.host_time - run.host_time.mean()
        slope = float(x @ y / (x @ x))
        spread = float(np.std(y - slope * x)) / math.sqrt(float(x @ x))
        slopes.append(slope)
        weights.append(max(spread, 2e-5) ** -2)
    if not slopes:
        return None
    return float(np.average(slopes, weights=weights)), float(np.sum(weights)) ** -0.5


def _coordinate(effect: int, name: str, info: ParameterInfo, value: float, usual: list[float]) -> Coordinate:
    """How a fit moves one parameter, started from ``value``.

    Positive sizes by their logarithm; a size about a neutral value (a ratio about 1, a signed offset about 0) in units
    of its first guess; a place (a rest angle) in units of usual places; phases in rad.
    """
    neutral = info.neutral
    if info.positive and not info.periodic and (neutral is None or neutral == 0.0 or math.isinf(neutral)):
        return Coordinate(effect, name, info, True, 1.0)
    if info.periodic:
        return Coordinate(effect, name, info, False, 1.0)
    sizes = [abs(u - (neutral or 0.0)) for u in usual]
    least = min((s for s in sizes if s > 0.0), default=1.0)
    if neutral is None:
        return Coordinate(effect, name, info, False, max(abs(value), least))
    return Coordinate(effect, name, info, False, max(abs(value - neutral), 1e-6 * least), neutral)


def _ordered(cls: type[Effect], values: dict[str, float]) -> dict[str, float]:
    """Keep what a class demands of its parameters together (static_torque >= coulomb_torque)."""
    if "static_torque" in values:
        values["static_torque"] = max(values["static_torque"], values["coulomb_torque"])
    return values

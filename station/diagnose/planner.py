"""Which tests a laboratory would run, and the best of them.

Of tests of nearly equal worth the shorter and gentler one is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from station.diagnose.forecasts import Belief, Forecast
from station.diagnose.result import Prediction
from station.diagnose.thresholds import DECIDES
from station.diagnose.trials import OVERSHOOT, Trial, most
from station.estimation.noise import correlation_time, rounding_shares
from station.estimation.pool import Pool
from station.model.simulate import Model, Simulation, simulate_model
from station.rig import Rig
from station.runs.run import Run

STEP = 0.5
"""Longest step along a direction of the posterior, prior sigmas or logarithm."""
TRAVEL = 0.5
"""Of a turn: as far as a test may move the arm."""
FURTHER = 2.0
"""Times as far as any run went: as far as the next one may, where the rig file does not say how far the rig can go."""
SPEED_OVER = 0.016
"""Seconds over which a speed is told: eight ticks at 500 Hz, as the board's guard tells it."""
LITTLE = 0.05
"""Of a turn: as far as a test may go whatever the runs did."""
SLACK = 0.1
"""Share of the best worth that a shorter or gentler test may lack."""
AGAIN = 0.5
"""What the worth of a test is multiplied by that was run already."""
REFINED = (0.7, 1.4)
"""Amplitudes tried about the best test's, as factors."""
FOLLOWS = 3.0
"""Times its amplitude that a closed loop goes at most which follows, and share of it, inverse, in which it has calmed
down at the end."""
BEYOND_STEP, CALM = 0.3, 0.025
"""And so much more, rad: what a small step may overshoot by, and what friction leaves."""
LAST = 0.3
"""Seconds at a step's end in which the loop must have calmed down."""
LONG = 4.0
"""Seconds: so long a test costs as much as one that takes the arm a turn, or holds the command at its limit."""
ASIDE = 0.4
"""Counts by which a start is moved to either side, so that a loop's readings are rounded otherwise."""


@dataclass(frozen=True)
class Worth:
    """A trial, judged."""

    trial: Trial
    value: float
    cost: float
    why: str
    prediction: Prediction
    distance: float = 0.0
    """Largest D of a pair."""
    shown: int = 0
    """Effects that would show, and could not have shown in the runs so far."""

    @property
    def decides(self) -> bool:
        """Whether it is expected to tell two rivals apart."""
        return self.distance >= DECIDES


Judge = Callable[[list[Trial]], list[Worth]]
"""What the trials are worth that a rig bears."""


class Planner:
    """The noise and the rig that trials are judged with."""

    def __init__(self, rig: Rig, sigma: np.ndarray, pool: Pool, runs: Sequence[Run] = ()) -> None:
        """``sigma``: standard deviation of encoder and accelerometer (counts), the latter left out without one."""
        self.rig, self.sigma, self.pool = rig, sigma, pool
        self.runs = sorted(runs, key=len, reverse=True)

    @cached_property
    def reach(self) -> float:
        """As far as a test may take the arm from where it begins, counts: TRAVEL, and not beyond ``limits.travel``.

        Where the rig file has none, an axis may have ends that nobody knows: FURTHER, but LITTLE in any case.  As far
        as a run went it may go again.
        """
        turn, limits = self.rig.encoder.counts_per_revolution, self.rig.limits
        if limits is not None and limits.travel is not None:
            return min(TRAVEL * turn, limits.travel / self.rig.angle_per_count)
        if not self.runs:
            return TRAVEL * turn
        went = max(float(np.max(np.abs(run.encoder - run.encoder[0]))) for run in self.runs)
        return max(went, min(TRAVEL * turn, max(FURTHER * went, LITTLE * turn)))

    @cached_property
    def pace(self) -> float:
        """As fast as a test may take the arm, counts in SPEED_OVER: ``limits.speed``, at which the device
        stops it."""
        limits = self.rig.limits
        if limits is None or limits.speed is None:
            return np.inf
        return limits.speed * SPEED_OVER / self.rig.angle_per_count

    def fastest(self, encoder: np.ndarray) -> float:
        """Counts by which it moves at most in the rows of ``SPEED_OVER``; ``encoder`` (n)."""
        rows = max(round(SPEED_OVER * self.rig.sample_rate), 1)
        return float(np.max(np.abs(encoder[rows:] - encoder[:-rows]), initial=0.0)) / rows * (
            SPEED_OVER * self.rig.sample_rate)

    def simulated(self, model: Model, run: Run, rounding: bool | Literal["inside"] = False,
                  aside: float = 0.0) -> Simulation:
        """A run's test from where it began, or so many counts beside it."""
        start = (float(run.encoder[0]) + aside) * self.rig.angle_per_count
        return simulate_model(model, run, rounding=rounding, start_angle=start)

    def outputs(self, found: Simulation) -> np.ndarray:
        """(channels, n)."""
        return np.stack([found.encoder, found.accel][: len(self.sigma)])

    def forecasts(self, belief: Belief, runs: Sequence[Run]) -> list[Forecast]:
        """What a hypothesis predicts of every run."""
        shrink = np.minimum(1.0, STEP / np.maximum(np.max(np.abs(belief.axes), axis=0), 1e-12))
        places = [belief.x, *(belief.x + (belief.axes * shrink).T)]

        def simulated(x: np.ndarray) -> list[Simulation]:
            model = belief.model(x)
            return [self.simulated(model, run) for run in runs]

        found = []
        for here, *others in zip(*self.pool.map(simulated, places), strict=True):
            mean = self.outputs(here)
            moved = [(self.outputs(other) - mean) / s for other, s in zip(others, shrink, strict=True)]
            found.append(Forecast(mean, np.array(moved).reshape(len(moved), *mean.shape), here.command))
        return found

    def scales(self, model: Model, run: Run, mean: np.ndarray) -> np.ndarray:
        """Weight of every sample (channels, n): see ``dataset`` for shares; rounding is fed back."""
        rounded = rounding_shares(np.floor(mean[0] + 0.5))
        share = np.stack([rounded, np.ones_like(rounded)])[: len(self.sigma)]
        variance = self.sigma**2
        if run.metadata.controller["kind"] != "open":
            here, there = ([self.outputs(self.simulated(model, run, flag, aside)) for flag in ("inside", False)]
                           for aside in (-ASIDE, ASIDE))
            scatter = (here[0] - here[1]) - (there[0] - there[1])
            variance = variance + 0.5 * np.array([np.mean(row**2) * correlation_time(row) for row in scatter])
        return np.sqrt(share / variance[:, None])

    def behaves(self, trial: Trial, forecast: Forecast, share: float = 1.0) -> bool:
        """Whether a laboratory would run it: finite, within that share of the reach and the pace, and a closed loop
        follows."""
        if not (np.all(np.isfinite(forecast.mean)) and np.all(np.isfinite(forecast.spread))):
            return False
        farthest = np.max(np.abs(forecast.mean[0]))
        slack, calm = np.array([BEYOND_STEP, CALM]) / self.rig.angle_per_count
        if farthest > share * self.reach or trial.closed and farthest > FOLLOWS * trial.amplitude + slack:
            return False
        if self.fastest(forecast.mean[0]) > share * self.pace:
            return False
        if trial.test["kind"] == "step":
            end = forecast.mean[0, -round(LAST * self.rig.sample_rate):]
            return bool(np.ptp(end) < trial.amplitude / FOLLOWS + calm)
        return True

    def judged(self, trial: Trial, run: Run, forecast: Forecast, value: float, why: str, names: tuple[str, str],
               means: tuple[np.ndarray, np.ndarray], distance: float = 0.0, shown: int = 0) -> Worth:
        """A trial of some value.

        Its cost is its length in units of LONG, and how hard and how far it drives the rig as ``forecast`` has it;
        ``means``: what the two hypotheses ``names`` predict, for drawing.
        """
        command = float(np.sqrt(np.mean(forecast.command**2))) / self.rig.amplifier.limit
        cost = (run.t[-1] / LONG + command
                + float(np.max(np.abs(forecast.mean[0]))) / self.rig.encoder.counts_per_revolution)
        encoder, *accel = zip(*means, strict=True)
        prediction = Prediction(run.t, names, encoder, accel[0] if accel else None)
        return Worth(trial, self.worth(trial, value), cost, why, prediction, distance, shown)

    def best(self, judge: Judge, start: list[Trial]) -> Worth | None:
        """The best of the trials, made as small as the reach asks, and of amplitudes about the best one's; of equals
        the shorter and gentler."""
        sized = [trial.sized(1.0, self.most(trial)) for trial in start]
        start = [trial for k, trial in enumerate(sized) if trial not in sized[:k]]
        judged = judge(start)
        if not judged:
            return None
        leading = max(judged, key=lambda w: w.value).trial
        finer = [leading.sized(factor, self.most(leading)) for factor in REFINED]
        judged += judge([trial for trial in finer if trial not in start])
        top = max(w.value for w in judged)
        return min((w for w in judged if w.value >= top - SLACK * abs(top)), key=lambda w: w.cost)

    def most(self, trial: Trial) -> float:
        """Largest amplitude: a closed loop's reference leaves room for its overshoot within the reach."""
        largest = most(trial, self.rig)
        return min(largest, self.reach / OVERSHOOT) if trial.closed else largest

    def worth(self, trial: Trial, value: float) -> float:
        """Less where it was run already."""
        return AGAIN * value if trial.repeats(self.runs) else value

"""The next experiment: of the tests that the station can run, the one that is worth most, and what it should show.

Where causes are rivals, that is the test which tells them apart.  Hypothesis i predicts outputs y_i; its constants and
sizes are uncertain, so that its prediction is Gaussian about y_i with covariance S_i = I + J_i C_i J_i', in units of
the noise, C_i the posterior of its fit.  What the log odds of i against j are expected to gain by the mean is

    D_ij = (y_i - y_j)' (S_i^-1 + S_j^-1)/2 (y_i - y_j)

(Box and Hill 1967; Hunter and Reiner 1965 without the covariances): what a refit of the constants would absorb counts
for nothing.  exp(-D/8) bounds the share of errors that two equally likely rivals would still leave, so a test's worth
is the sum over pairs of p_i p_j (1 - exp(-D_ij/8)), over that of p_i p_j.

Where nothing points anywhere yet, it is the test that makes the catalogue visible.  With G the Gram matrix of what the
effects at usual sizes change in the runs so far, in units of the noise and beyond what constants within their stated
uncertainty could do, and G' that of the same runs and the new one, the worth is ln det(1 + G'/k) - ln det(1 + G/k), k
the chi^2 at which an effect shows (the D-optimal design): effects that look alike count but once.

Of tests of nearly equal worth the shorter and gentler one is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag

from station.diagnose.candidates import candidates
from station.diagnose.odds import Odds
from station.diagnose.result import NextExperiment, Prediction, Verdict
from station.diagnose.selection import Selection
from station.diagnose.thresholds import DECIDES, SETTLED, UNLIKELY, VISIBLE
from station.diagnose.trials import OVERSHOOT, Trial, most, trials
from station.estimation.cause import Key
from station.estimation.dataset import tests_of
from station.estimation.fitted import Fit
from station.estimation.likelihood import NUISANCES
from station.estimation.noise import ACCEL_DEFAULT, QUANTISATION, correlation_time, rounding_shares
from station.estimation.parameters import prior_covariance
from station.estimation.pool import SIZE, Pool
from station.estimation.prediction import SEARCH
from station.model.effects import Effect, Stage, catalogue
from station.model.simulate import Model, Simulation, build, simulate_model
from station.rig import Rig
from station.runs.run import Run

LEADING = 4
"""Sets of causes that are weighed."""
LOOKED = 8
"""Tests whose forecasts are worked out with their uncertainty, where rivals are to be told apart."""
FAR = 300.0
"""Scale of chi^2 without regard to refits, by which these are picked."""
AXES = 10
"""Directions of the posterior, widest first, whose predictions are worked out."""
STEP = 0.5
"""Longest step along one, prior sigmas or logarithm."""
TRAVEL = 0.5
"""Of a turn: as far as a test may move the arm."""
FURTHER = 2.0
"""Times as far as any run went: as far as the next one may, where the rig file does not say how far the rig can go."""
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
PAST = 8
"""Runs whose part in what is known already is worked out, the longest."""
PRIOR_REACH = 2.0
"""Times the reach that a test may take where the stated uncertainty may put the rig."""
PRIOR_DRAWS = 6
"""Draws from the rig's stated uncertainty on which the first test must behave."""


@dataclass(frozen=True)
class Choice:
    """What to do next, and what the rivals say will come of it."""

    next: NextExperiment
    """For the file: the test, or none and why no test would decide."""
    prediction: Prediction | None
    plan: NextExperiment
    """The test that is worth most even so: the same, or where none decides, the one that shows most of what these
    runs could not have shown."""
    unseen: int = 0
    """Effects of a usual size that the plan would show and the runs so far could not have shown."""


@dataclass(frozen=True)
class Belief:
    """One hypothesis as its data leave it: ``model(x)`` builds its rig; the columns of ``axes`` (p, k) are one
    posterior sigma along each direction that is open."""

    words: str
    x: np.ndarray
    axes: np.ndarray
    model: Callable[[np.ndarray], Model]

    @property
    def still(self) -> Belief:
        """The same as if nothing were uncertain: its forecasts cost one simulation each."""
        return replace(self, axes=np.zeros((len(self.x), 0)))


@dataclass(frozen=True)
class Forecast:
    """What a hypothesis predicts of one trial, counts: ``mean`` (channels, n), ``spread`` (k, channels, n)."""

    mean: np.ndarray
    spread: np.ndarray
    command: np.ndarray


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

        Where the rig file has none, an axis may have ends that nobody knows: FURTHER, but LITTLE in any case.
        """
        turn, limits = self.rig.encoder.counts_per_revolution, self.rig.limits
        if limits is not None and limits.travel is not None:
            return min(TRAVEL * turn, limits.travel / self.rig.angle_per_count)
        if not self.runs:
            return TRAVEL * turn
        went = max(float(np.max(np.abs(run.encoder - run.encoder[0]))) for run in self.runs)
        return min(TRAVEL * turn, max(FURTHER * went, LITTLE * turn))

    def outputs(self, found: Simulation) -> np.ndarray:
        """(channels, n)."""
        return np.stack([found.encoder, found.accel][: len(self.sigma)])

    def forecasts(self, belief: Belief, runs: Sequence[Run]) -> list[Forecast]:
        """What a hypothesis predicts of every run."""
        shrink = np.minimum(1.0, STEP / np.maximum(np.max(np.abs(belief.axes), axis=0), 1e-12))
        places = [belief.x, *(belief.x + (belief.axes * shrink).T)]

        def simulated(x: np.ndarray) -> list[Simulation]:
            model = belief.model(x)
            return [simulate_model(model, run, rounding=False) for run in runs]

        found = []
        for here, *others in zip(*self.pool.map(simulated, places), strict=True):
            mean = self.outputs(here)
            moved = [(self.outputs(other) - mean) / s for other, s in zip(others, shrink, strict=True)]
            found.append(Forecast(mean, np.array(moved).reshape(len(moved), *mean.shape), here.command))
        return found

    def scales(self, model: Model, run: Run, mean: np.ndarray) -> np.ndarray:
        """Weight of every sample (channels, n): see ``dataset`` for shares; rounding is fed back."""
        rounded = rounding_shares(np.round(mean[0]))
        share = np.stack([rounded, np.ones_like(rounded)])[: len(self.sigma)]
        variance = self.sigma**2
        if run.metadata.controller["kind"] != "open":
            angle = 0.4 * self.rig.angle_per_count
            here, there = ([self.outputs(simulate_model(model, run, rounding=flag, start_angle=start))
                            for flag in ("inside", False)] for start in (-angle, angle))
            scatter = (here[0] - here[1]) - (there[0] - there[1])
            variance = variance + 0.5 * np.array([np.mean(row**2) * correlation_time(row) for row in scatter])
        return np.sqrt(share / variance[:, None])

    def behaves(self, trial: Trial, forecast: Forecast, share: float = 1.0) -> bool:
        """Whether a laboratory would run it: finite, within that share of the reach, and a closed loop follows."""
        if not (np.all(np.isfinite(forecast.mean)) and np.all(np.isfinite(forecast.spread))):
            return False
        farthest = np.max(np.abs(forecast.mean[0]))
        slack, calm = np.array([BEYOND_STEP, CALM]) / self.rig.angle_per_count
        if farthest > share * self.reach or trial.closed and farthest > FOLLOWS * trial.amplitude + slack:
            return False
        if trial.test["kind"] == "step":
            end = forecast.mean[0, -round(LAST * self.rig.sample_rate):]
            return bool(np.ptp(end) < trial.amplitude / FOLLOWS + calm)
        return True

    def judged(self, trial: Trial, run: Run, forecast: Forecast, value: float, why: str, names: tuple[str, str],
               means: tuple[np.ndarray, np.ndarray], distance: float = 0.0, shown: int = 0) -> Worth:
        """A trial of some value.

        Its cost is its length in units of 4 s, and how hard and how far it drives the rig as ``forecast`` has it;
        ``means``: what the two hypotheses ``names`` predict, for drawing.
        """
        command = float(np.sqrt(np.mean(forecast.command**2))) / self.rig.amplifier.limit
        cost = (run.t[-1] / 4.0 + command
                + float(np.max(np.abs(forecast.mean[0]))) / self.rig.encoder.counts_per_revolution)
        encoder, *accel = zip(*means, strict=True)
        prediction = Prediction(trial.complete(), run.t, run.reference, names, encoder, accel[0] if accel else None)
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


def _nuisances(scale: np.ndarray) -> np.ndarray:
    """Rows (channels, channels n) of what starting angle and offset may do, scaled by ``scale`` (channels, n)."""
    return block_diag(*(sigma * weights for sigma, weights in zip(NUISANCES, scale, strict=False)))


def absorbed(change: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """change (m, n), or one row, times S^-1 = (I + spread' spread)^-1, ``spread`` (k, n): what no refit takes up."""
    inner = np.eye(len(spread)) + spread @ spread.T
    return change - (np.linalg.solve(inner, spread @ change.T)).T @ spread


def between(planner: Planner, beliefs: Sequence[Belief], odds: Sequence[float]) -> Judge:
    """Judge trials by how they tell hypotheses apart; ``odds`` are the hypotheses' probabilities."""
    pairs = [(i, j) for j in range(len(beliefs)) for i in range(j)]
    weights = np.array([odds[i] * odds[j] for i, j in pairs])
    weights /= weights.sum()

    def leading(tried: list[Trial]) -> list[Trial]:
        """The tests in which the hypotheses differ most as they stand, LOOKED of them."""
        runs = [trial.as_run(planner.rig) for trial in tried]
        still = [planner.forecasts(belief.still, runs) for belief in beliefs]
        scores = []
        for trial, forecasts in zip(tried, zip(*still, strict=True), strict=True):
            here = [forecast.mean / planner.sigma[:, None] for forecast in forecasts]
            apart = np.nan_to_num([np.sum((here[i] - here[j]) ** 2) for i, j in pairs], posinf=0.0)
            scores.append(planner.worth(trial, float(weights @ (1.0 - np.exp(-apart / FAR)))))
        return [tried[r] for r in sorted(np.argsort(-np.array(scores), kind="stable")[:LOOKED])]

    def judge(tried: list[Trial]) -> list[Worth]:
        tried = leading(tried) if len(tried) > LOOKED else tried
        runs = [trial.as_run(planner.rig) for trial in tried]
        every = zip(*(planner.forecasts(belief, runs) for belief in beliefs), strict=True)
        first = beliefs[0].model(beliefs[0].x)
        found = []
        for trial, run, here in zip(tried, runs, every, strict=True):
            if not all(planner.behaves(trial, forecast) for forecast in here):
                continue
            scale = planner.scales(first, run, here[0].mean)
            nuisances = _nuisances(scale)
            spreads = [np.concatenate([(forecast.spread * scale).reshape(len(forecast.spread), scale.size), nuisances])
                       for forecast in here]
            distances = []
            for i, j in pairs:
                apart = ((here[i].mean - here[j].mean) * scale).ravel()
                distances.append(0.5 * float(apart @ (absorbed(apart, spreads[i]) + absorbed(apart, spreads[j]))))
            resolved = 1.0 - np.exp(-np.maximum(distances, 0.0) / 8.0)
            p = int(np.argmax(weights * resolved))
            i, j = pairs[p]
            why = (f"{beliefs[i].words} and {beliefs[j].words} differ here by chi^2 = {distances[p]:.0f} beyond what "
                   "refitted constants could absorb")
            found.append(planner.judged(trial, run, here[0], float(weights @ resolved), why,
                                        (beliefs[i].words, beliefs[j].words), (here[i].mean, here[j].mean),
                                        distance=max(distances)))
        return found
    return judge


def told(spread: np.ndarray, change: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """(k + m, k + m) what one run says of constants and effects, its own nuisances taken out; runs add.

    From scaled rows (k, n), (m, n) and the nuisances' (channels, n).
    """
    rows = np.concatenate([spread, change])
    return absorbed(rows, nuisances) @ rows.T


def visible(known: np.ndarray, k: int) -> np.ndarray:
    """(m, m) what the effects change that the k constants within their uncertainty (unit prior) do not, of what runs
    tell (k + m, k + m); 1 where an effect shows."""
    cross = known[:k, k:]
    return (known[k:, k:] - cross.T @ np.linalg.solve(np.eye(k) + known[:k, :k], cross)) / VISIBLE


def showing(planner: Planner, base: Belief, effects: Sequence[tuple[str, Effect]], drawn: Sequence[Belief] = (),
            share: float = 1.0) -> Judge:
    """Judge trials by how much of the catalogue they make visible that the planner's runs did not.

    ``base``: where the rig stands, its axes the uncertainty before any run.  ``effects``: words and the effect at a
    usual size.  ``drawn``: where else the rig may stand; a trial must behave there too, within that ``share`` of the
    reach.
    """
    first = base.model(base.x)
    k, m = base.axes.shape[1], len(effects)
    nothing = np.zeros((k + m, k + m))
    rigs = [first.rig.with_effects((*first.rig.effects, effect)) for _, effect in effects]

    def looked(runs: Sequence[Run]) -> list[tuple[Forecast, list[np.ndarray], np.ndarray]]:
        """Per run the forecast, the outputs with each effect, and what it tells (k + m, k + m)."""
        here = planner.forecasts(base, runs)

        def outputs_of(rig: Rig) -> list[np.ndarray]:
            model = _built(rig)
            return [planner.outputs(simulate_model(model, run, rounding=False)) for run in runs]

        changed = list(planner.pool.map(outputs_of, rigs))
        found = []
        for r, run in enumerate(runs):
            outputs, says = [every[r] for every in changed], nothing
            if np.all(np.isfinite(here[r].mean)):
                scale = planner.scales(first, run, here[r].mean)
                change = np.stack([((output - here[r].mean) * scale).ravel() for output in outputs])
                change[~np.all(np.isfinite(change), axis=1)] = 0.0
                spread = np.nan_to_num((here[r].spread * scale).reshape(-1, scale.size), posinf=0.0, neginf=0.0)
                says = told(spread, change, _nuisances(scale))
            found.append((here[r], outputs, says))
        return found

    past = sum((says for _, _, says in looked(planner.runs[:PAST])), nothing)
    known = visible(past, k)
    old = np.diag(known)
    before = np.linalg.slogdet(np.eye(m) + known)[1]

    def judge(tried: list[Trial]) -> list[Worth]:
        runs = [trial.as_run(planner.rig) for trial in tried]
        daring = [planner.forecasts(other.still, runs) for other in drawn]
        found = []
        for r, (trial, run, (here, outputs, says)) in enumerate(zip(tried, runs, looked(runs), strict=True)):
            if not (planner.behaves(trial, here)
                    and all(planner.behaves(trial, forecasts[r], share) for forecasts in daring)):
                continue
            both = visible(past + says, k)
            new = np.diag(both)
            shown = int(np.sum((new >= 1.0) & (old < 1.0)))
            e = int(np.argmax(np.log1p(new) - np.log1p(old)))
            why = (f"{shown} of {m} effects of a usual size would show that the runs so far could not have shown"
                   if planner.runs and shown else f"{int(np.sum(new >= 1.0))} of {m} effects of a usual size would show"
                   ) + f", {effects[e][0]} gains most"
            found.append(planner.judged(trial, run, here, float(np.linalg.slogdet(np.eye(m) + both)[1] - before), why,
                                        (base.words, f"with {effects[e][0]}"), (here.mean, outputs[e]), shown=shown))
        return found
    return judge


def _built(rig: Rig) -> Model:
    gap = any(effect.stage is Stage.GAP for effect in rig.effects)
    return build(rig, SEARCH[0], SEARCH[2] if gap else SEARCH[1])


def belief(search: Selection, found: Fit) -> Belief:
    """A fitted hypothesis as its data leave it."""
    values, vectors = np.linalg.eigh(found.covariance)
    widest = np.argsort(-values)[:AXES]
    axes = vectors[:, widest] * np.sqrt(np.maximum(values[widest], 0.0))
    return Belief(_words(found.key), found.x, axes, partial(search.predictor.model, found.space))


def _addable(rig: Rig, held: frozenset[Key] = frozenset()) -> list[tuple[str, Effect]]:
    """Every effect that could join a rig, at the middle of its usual sizes."""
    return [(_words([c.key]), c.effect.model_construct(None, at=c.at, **c.guesses[(len(c.guesses) - 1) // 2]))
            for c in candidates(rig)
            if c.effect is not None and c.key not in held and c.effect.stage is not Stage.CLOCK]


def _sigma(search: Selection) -> np.ndarray:
    """Noise of a planned run; where a model misses something, the size of that, spread over its samples."""
    data, best = search.predictor.data, search.best()
    left = np.mean(np.maximum(best.squares / np.maximum(search.weighing.independent, 1.0), 1.0), axis=0)
    return data.sigma * np.sqrt([left[search.predictor.channel == c][-1] for c in range(data.channels)])


def choose(search: Selection, odds: Odds, verdict: Verdict) -> Choice:
    """What to do next, by the odds of the sets of causes that were fitted."""
    data = search.predictor.data
    planner = Planner(data.rig, _sigma(search), search.predictor.pool, tests_of(data.runs))
    best, top = odds.sets[0]
    rivals = [(keys, p) for keys, p in odds.sets[:LEADING] if p >= UNLIKELY * top]
    undecidable = None
    if top < SETTLED and len(rivals) > 1 and verdict not in ("not_enough_data", "unexplained"):
        causes = sorted({key for keys, _ in rivals for key in keys})
        beliefs = [belief(search, search.fits[keys]) for keys, _ in rivals]
        found = planner.best(between(planner, beliefs, [p for _, p in rivals]), trials(data.rig, causes))
        if found is not None and found.decides:
            return _choice(replace(found, why=found.why + _telling(best)), planner)
        if verdict == "ambiguous":
            undecidable = (f"{beliefs[0].words} and {beliefs[1].words} predict the same in every test that "
                           "this station can run, within what refitted constants absorb"
                           + (f" (chi^2 = {found.distance:.1f} at most)" if found is not None else ""))
    # The rig as fitted without its effects, which cost time, and as uncertain as before any run.
    fit, space = search.fits[best], search.fits[frozenset()].space
    plain = Belief("the rig as fitted", space.carried(fit.space, fit.x), np.eye(space.size),
                   partial(search.predictor.model, space))
    judge = showing(planner, plain, _addable(data.rig, best), [belief(search, fit)])
    plan = _choice(planner.best(judge, trials(data.rig)), planner)
    if undecidable is not None:
        return replace(plan, next=NextExperiment(test=None, why=undecidable), prediction=None)
    return plan


def first_test(rig: Rig) -> Choice:
    """The first test of a rig that nothing is known of but its file: the one that makes most of the catalogue visible
    and behaves wherever the stated uncertainty may put the rig."""
    rig = rig.meshed()
    paths, nominal = list(rig.constants()), np.array(list(rig.constants().values()))
    root = np.linalg.cholesky(prior_covariance(rig, paths))

    def model(x: np.ndarray) -> Model:
        return _built(rig.with_constants(dict(zip(paths, nominal * np.exp(root @ x), strict=True))))

    accel = [np.hypot(ACCEL_DEFAULT, np.sqrt(QUANTISATION))] if rig.accelerometer is not None else []
    base = Belief("the rig as its file says", np.zeros(len(paths)), np.eye(len(paths)), model)
    drawn = [replace(base, x=x) for x in np.random.default_rng(0).normal(size=(PRIOR_DRAWS, len(paths)))]
    planner = Planner(rig, np.array([np.sqrt(QUANTISATION), *accel]), Pool(SIZE, __name__))
    found = (planner.best(showing(planner, base, _addable(rig), drawn, PRIOR_REACH), trials(rig))
             or planner.best(showing(planner, base, _addable(rig)), trials(rig)))
    return _choice(found, planner)


def _choice(found: Worth | None, planner: Planner) -> Choice:
    if found is None:
        none = NextExperiment(test=None, why="no test of this station keeps this rig within "
                                             f"{planner.reach:.0f} counts of where it begins")
        return Choice(none, None, none)
    asked = NextExperiment(test=found.trial.complete(), why=found.why)
    return Choice(asked, found.prediction, asked, found.shown)


def _telling(keys: frozenset[Key]) -> str:
    """What to look for in a test that tells effects from their rivals, in the effects' own words."""
    known = catalogue()
    words = [f"{known[name].title}: {known[name].telling}" for name, _ in sorted(keys)
             if name in known and known[name].telling]
    return f" ({'. '.join(words)})" if words else ""


def _words(keys: Iterable[Key]) -> str:
    return " + ".join(sorted(f"{name} at {at}" if at else name for name, at in keys)) or "no cause"

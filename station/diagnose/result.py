"""What a diagnosis says: the file's form (schema station-diagnosis/1) and what a report draws beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from station import __version__, markup
from station.diagnose.measures import nrmse
from station.estimation.identifiability import State
from station.model.simulate import Simulation
from station.rig import Rig
from station.runs.columns import SENSORS
from station.runs.run import Run

if TYPE_CHECKING:
    from station.pictures.picture import Evidence

Channel = Literal["encoder", "accel"]
CHANNELS: tuple[Channel, ...] = SENSORS
Share = Annotated[float, AfterValidator(lambda share: min(share, 1.0))]
"""At most 1, which a sum of shares may exceed by its rounding errors."""
Verdict = Literal["explained", "partly_explained", "unexplained", "nothing_missing", "ambiguous", "not_enough_data"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Wrong(_Table):
    """One thing that the nominal simulation gets wrong."""

    run: str
    channel: Channel
    measure: str
    simulated: float | None
    measured: float | None
    where: str | None = None


class Estimate(_Table):
    """A fitted value with its 95 % interval and how well the runs determine it."""

    value: float
    low: float
    high: float
    unit: str
    state: State = "determined"
    spread: float | None = None
    """Standard deviation between runs where they differ; None where one value does for all."""


class Rival(_Table):
    """Another cause that could stand in a cause's place."""

    effect: str
    at: str
    probability: Share


class Cause(_Table):
    """A named cause: its own probability of being present, its parameters, and its rivals."""

    effect: str
    at: str
    probability: Share
    parameters: dict[str, Estimate]
    stability: Share = 1.0
    """Share of resamples of the data in which it is named."""
    rivals: list[Rival] = Field(default_factory=list)


class ChannelGain(_Table):
    """nrmse over the held-out runs, before and after."""

    nrmse_before: float
    nrmse_after: float


class RunGain(_Table):
    """One run that the fit behind it has not seen."""

    run: str
    seconds_ahead: float | None = None
    """How far ahead the run is predicted where its loop cannot be simulated; None: its errors are of the whole loop."""
    encoder: ChannelGain | None = None
    accel: ChannelGain | None = None
    ahead: dict[str, ChannelGain] = Field(default_factory=dict)
    """The encoder, predicted so far ahead."""
    measured: dict[str, float | None] = Field(default_factory=dict)
    before: dict[str, float | None] = Field(default_factory=dict)
    after: dict[str, float | None] = Field(default_factory=dict)
    """Overshoot, rise and settling of a step."""
    repeats: dict[str, float] = Field(default_factory=dict)
    """Where other runs repeat this test, by how much they differ: per channel in the measure of an nrmse, of a step's
    figures the standard deviation."""


class Gain(_Table):
    """What the extended rig buys on runs that no fit has seen."""

    held_out: list[str]
    encoder: ChannelGain | None = None
    accel: ChannelGain | None = None
    explained_fraction: float | None = None
    runs: list[RunGain] = Field(default_factory=list)


class Disturbance(_Table):
    """Standard deviation of the torque that is missing at the motor, as a share of the command's rms torque; re-fitted
    and extended, without what the motor does more or less in each run by itself."""

    nominal: float
    refitted: float
    extended: float


class OwnOfRun(_Table):
    """What the motor does more in one run than its command and the rig say."""

    run: str
    share: float
    """Of the command."""
    constant: float
    """Counts of the command."""


class BetweenRuns(_Table):
    """By how much runs differ in what the motor does more than its command and the rig say: standard deviations, None
    where these runs do not show that they differ."""

    share: float | None = None
    """Of the command."""
    constant: float | None = None
    """Counts of the command."""
    probability: dict[str, float] = Field(default_factory=dict)
    """That runs differ so, of ``share`` and ``constant`` as far as they are told."""
    stability: dict[str, float] = Field(default_factory=dict)
    """Share of resamples of the data that show it."""
    runs: list[OwnOfRun] = Field(default_factory=list)
    """Each run's own, where they differ."""


class NextExperiment(_Table):
    """The test that would separate the leading rivals most, or None and why none would."""

    test: dict[str, Any] | None
    why: str


class Ranked(_Table):
    """A candidate, named or not."""

    effect: str
    at: str
    probability: Share
    note: str = ""


class RunFile(_Table):
    """A run that was used, and its file where it came from one."""

    run: str
    file_sha256: str | None = None


class Diagnosis(_Table):
    """The diagnosis file."""

    schema_: str = Field(default="station-diagnosis/1", alias="schema")
    verdict: Verdict
    wrong: list[Wrong] = Field(default_factory=list)
    causes: list[Cause] = Field(default_factory=list)
    gain: Gain
    next_experiment: NextExperiment | None = None
    outside: float = 0.0
    """Probability kept for something that no effect describes: more than noise is left where it is not 0."""
    disturbance: Disturbance | None = None
    between_runs: BetweenRuns | None = None
    ranking: list[Ranked] = Field(default_factory=list)
    rig: str = ""
    runs: list[RunFile] = Field(default_factory=list)
    effort: str = ""
    version: str = __version__

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    def to_json(self) -> str:
        """The file's text."""
        return self.model_dump_json(by_alias=True, indent=1)


@dataclass(frozen=True)
class RunComparison:
    """One run beside three simulations, none of which has seen it."""

    run: Run
    before: Simulation
    refit: Simulation
    after: Simulation | None
    seconds_ahead: float | None = None
    """As ``RunGain`` has it."""
    part: slice = field(default_factory=lambda: slice(None))
    """The rows that it is judged by: of a run that is alone one half."""
    window: np.ndarray | None = None
    """(n) whether each counts, in that part; by default all that were logged do."""
    zero: float = 0.0
    """Absolute angle of the encoder's count 0, rad, by the fit of all runs."""
    not_closed: str = ""
    """Why its loop cannot be closed again, as a clause."""

    def zeroed(self, angle_per_count: float) -> Run:
        """The run with its angle counted from where the rig's effects count theirs, as all runs of the diagnosis."""
        moved = self.zero / angle_per_count
        return replace(self.run, encoder=self.run.encoder + moved,
                       reference=self.run.reference + (0.0 if self.run.open_loop else moved),
                       metadata=self.run.metadata.model_copy(update={"zero_id": "absolute"}))

    @property
    def channels(self) -> list[str]:
        """The channels that were measured and simulated."""
        return [c for c in CHANNELS if getattr(self.run, c) is not None and getattr(self.before, c) is not None]

    @property
    def rows(self) -> np.ndarray:
        """(n) whether each row counts."""
        return self.run.logged if self.window is None else self.window

    def variance(self, channel: str) -> float:
        """Of a channel about its mean, summed over the rows, counts^2."""
        measured = getattr(self.run, channel)[self.rows]
        return float(np.sum((measured - measured.mean()) ** 2))

    def errors(self, channel: str) -> list[float | None]:
        """nrmse before, re-fitted and after; None where there is no such simulation or the channel never moves."""
        rows = self.rows
        found = [nrmse(getattr(self.run, channel)[rows], getattr(s, channel)[rows]) if s is not None else math.inf
                 for s in (self.before, self.refit, self.after)]
        return [error if math.isfinite(error) else None for error in found]


NOT_NAMED = {"left_out": "does not help on unseen runs",
             "too_large": "it may have to be larger than such a thing can be",
             "may_be_none": "its own 95 % interval holds that it is not there"}
"""In words, by ``Reason.kind``, what keeps a candidate from being named that may add enough."""


@dataclass(frozen=True)
class Reason:
    """What decides where a candidate stands, with the numbers that are told of it."""

    kind: Literal["named", "leads", "likely", "too_little", "left_out", "within", "too_large", "may_be_none",
                  "resamples", "beaten", "matched", "explains_less", "as_good", "no_better", "open"]
    """It is named; it leads the ranking, or is likely, and is not named; adds less than it must; runs left out speak
    against it; it is a constant within its stated uncertainty, or an effect that may have to be larger than it can be;
    its own interval holds that it is not there; too few resamples name it; others in its place do better, or as well;
    it explains less than the first, is as good, or no better; nothing says."""
    value: float = 0.0
    """What it must add, the share of resamples that name it, or by how much less of 2 ln L it explains."""
    instead: tuple[tuple[str, str], ...] = ()
    """The others in its place."""
    tried: str = ""
    """Beside what it was tried, in words, where that is told."""
    adds: float | None = None
    """Twice what it adds to the log evidence there, where that is told and both were fitted."""


@dataclass(frozen=True)
class RankedCause:
    """One candidate and why it stands where it does."""

    effect: str
    at: str
    probability: float
    delta_chi2: float
    """Twice what it adds to the log evidence, alone or as part of its note's set."""
    held_out_gain: float | None
    """Share of the re-fitted rig's error on unseen runs that it takes away, by fits that left them out."""
    note: str = ""
    stability: float = 0.0
    """Share of resamples of the data in which it is named."""
    reason: Reason = Reason("open")


@dataclass(frozen=True)
class Prediction:
    """What two hypotheses predict of a test that has not been run, counts, from encoder count 0."""

    t: np.ndarray
    names: tuple[str, str]
    encoder: tuple[np.ndarray, np.ndarray]
    accel: tuple[np.ndarray, np.ndarray] | None


@dataclass(frozen=True)
class Choice:
    """What to do next, and what the rivals say will come of it."""

    next: NextExperiment = field(default_factory=lambda: NextExperiment(test=None, why=""))
    """For the file: the test, or none and why no test would decide."""
    prediction: Prediction | None = None
    plan: NextExperiment = field(default_factory=lambda: NextExperiment(test=None, why=""))
    """The test that is worth most even so: the same, or where none decides, the one that shows most of what these
    runs could not have shown."""
    unseen: int = 0
    """Effects of a usual size that the plan would show and the runs so far could not have shown."""


@dataclass(frozen=True)
class DiagnosisResult:
    """A diagnosis with all that a report needs."""

    diagnosis: Diagnosis
    rig: Rig
    refit_rig: Rig
    extended_rig: Rig
    comparisons: list[RunComparison]
    ranking: list[RankedCause] = field(default_factory=list)
    draw: Callable[[], list[Evidence]] = list
    """Makes the pictures, which a diagnosis that is not looked at does without."""
    constants: dict[str, Estimate] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0
    choose: Callable[[], Choice] = Choice
    """Works out the next test, for which a verdict that asks for none does without."""
    equivalences: list[str] = field(default_factory=list)
    """What is known to be the same as the causes named, in sentences."""
    amiss: list[str] = field(default_factory=list)
    """What is amiss with the logs or the rig file, before any physics: a sentence each."""

    def refitted(self, channel: str) -> float | None:
        """nrmse over all runs with the constants re-fitted alone, by fits that left each run out, as ``gain`` has it
        before and after; None where a run has none."""
        total = spread = 0.0
        for one in self.comparisons:
            if channel in one.channels:
                size, error = one.variance(channel), one.errors(channel)[1]
                if size and error is None:
                    return None
                total, spread = total + (error or 0.0) ** 2 * size, spread + size
        return math.sqrt(total / spread) if spread else None

    @property
    def choice(self) -> Choice:
        """The best further test, also where the verdict asks for none or none would decide."""
        return self.choose()

    @cached_property
    def evidence(self) -> list[Evidence]:
        """The pictures of each cause, then the sceptic's view."""
        return self.draw()

    def _repr_html_(self) -> str:
        found = self.diagnosis
        causes = [(f"{c.effect} {c.at}".strip(), f"{c.probability:.2f}", key,
                   f"{e.value:.4g} ({e.low:.4g} to {e.high:.4g}) {e.unit}")
                  for c in found.causes for key, e in c.parameters.items()]
        gains = [(channel, f"{g.nrmse_before:.3f}", f"{g.nrmse_after:.3f}")
                 for channel, g in (("encoder", found.gain.encoder), ("accel", found.gain.accel)) if g is not None]
        return (markup.table(("cause", "probability", "parameter", "value (95 %)"), causes,
                             f"{found.rig}: {found.verdict.replace('_', ' ')}")
                + markup.table(("nrmse on unseen runs", "before", "after"), gains))

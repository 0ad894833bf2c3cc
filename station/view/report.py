"""The report of a diagnosis: one HTML file that explains itself, works offline and asks nobody for anything."""

from __future__ import annotations

import difflib
import hashlib
import math
import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

import station
from station.diagnose.odds import RESAMPLES, SEED
from station.diagnose.result import DiagnosisResult, Estimate, RunComparison
from station.diagnose.thresholds import STABLE
from station.pictures.picture import Evidence
from station.view import figures, wording
from station.view.html import render, write_page
from station.view.residuals import residuals

FIRST_RANKED, MAX_RANKED = 6, 20
"""Rivals shown at once, and with those that are folded away; the rest are counted."""
SECTIONS = {"wrong": "What is wrong", "cause": "The cause", "rivals": "Rivals", "parameters": "Parameters",
            "gains": "Gain, run by run", "stability": "Stability", "remains": "What remains",
            "next": "Next experiment", "how": "How it was computed"}
"""The list of contents: anchors and titles in the page's order."""
_LIBRARIES = ("numpy", "scipy", "numba", "control", "plotly")


def write_report(result: DiagnosisResult, path: str | Path, overwrite: bool = True) -> None:
    """Write the report of a diagnosis to ``path``; WorkError where the file cannot be written."""
    write_page(path, report_html(result), overwrite)


def report_html(result: DiagnosisResult, written: datetime | None = None) -> str:
    """The report's HTML, Plotly's script included; all text that comes from files is escaped.

    ``written``: the date that it states, by default now.
    """
    page = _Page(result, written or datetime.now(UTC))
    return render("report.html.j2", page=page, figures=page.figures)


@dataclass(frozen=True)
class GainRow:
    """Errors (nrmse) of one channel of one run: as the rig file says, re-fitted, with the causes."""

    run: int
    name: str
    channel: str
    before: float | None
    refit: float | None
    after: float | None
    repeats: float | None
    """By how much repeats of its test differ, in the same measure."""


@dataclass(frozen=True)
class ConstantRow:
    """One re-fitted constant beside the rig file's, as logarithms of their ratio for the drawing."""

    path: str
    nominal: float
    estimate: Estimate | None
    value: float
    sigma: float

    def away(self, value: float) -> float:
        """Distance of a value from the rig file's in its stated standard deviations."""
        ratio = value / self.nominal
        return math.log(ratio) / self.sigma if ratio > 0.0 and self.sigma > 0.0 else math.inf

    @property
    def span(self) -> list[float] | None:
        """The interval on the drawing, where it has one."""
        if self.estimate is None:
            return None
        ends = sorted((self.away(self.estimate.low), self.away(self.estimate.high)))
        return [self.clip(end) for end in ends] if all(map(math.isfinite, ends)) else None

    @staticmethod
    def clip(sigmas: float) -> float:
        """A place on the drawing, which spans four standard deviations either way."""
        return min(max(sigmas, -3.9), 3.9)


class _Page:
    """What the template asks for, in the order of the page; figures are kept by name until the script draws them."""

    def __init__(self, result: DiagnosisResult, written: datetime) -> None:
        self.result = result
        self.written = written.astimezone(UTC)
        self.sections = SECTIONS
        self.draws, self.seed, self.asked = RESAMPLES, SEED, STABLE
        self.residuals = residuals(result)
        self.diagnosis = wording.as_told(result)
        self.rig = result.rig
        self.sentence = wording.verdict_sentence(self.diagnosis, result.rig, wording.far_off(result))
        self.figures: dict[str, go.Figure] = {}
        self.hero = figures.hero_choice(result)
        if self.hero is not None:
            self.figures["hero"] = figures.hero(*self.hero)
        for index, evidence in enumerate(result.evidence):
            if evidence.drawn:
                self.figures[f"evidence-{index}"] = figures.evidence_figure(evidence)
        drawn = [(comparison.run, figures.simulations(comparison)) for comparison in result.comparisons]
        self.points = figures.points_per_line(sum(figures.lines_of(*one) for one in drawn))
        for index, one in enumerate(drawn):
            self.figures[f"run-{index}"] = figures.run_figure(*one, self.points)
        if self.residuals:
            self.figures["spectrum"] = figures.spectrum_figure(self.residuals, result.rig.sample_rate)
            self.figures["whiteness"] = figures.whiteness_figure(self.residuals)
            self.figures["crossing"] = figures.crossing_figure(self.residuals)
        asked = self.diagnosis.next_experiment
        if asked is not None and asked.test is not None and result.choice.prediction is not None:
            self.figures["next"] = figures.prediction_figure(result.choice.prediction)

    @staticmethod
    def agreement(evidence: Evidence) -> str:
        """How the points of a picture bear out the law drawn through them, where that can be said by one number."""
        share = figures.law_share(evidence)
        if share is None:
            return ""
        return f"Fitted to the points' medians the law would have {wording.number(share, 2)} times its size."

    @cached_property
    def hero_facts(self) -> list[tuple[str, str]]:
        """What the hero's run gets wrong: the measure, and simulated against measured, in words."""
        if self.hero is None:
            return []
        shown = (self.hero[0].run.name, self.hero[1])
        return [wording.fact(w) for w in self.diagnosis.wrong if (w.run, w.channel) == shown][:2]

    @cached_property
    def predicted(self) -> dict[str, float]:
        """Of the runs that are predicted and not simulated as a whole, how many seconds ahead."""
        return {c.run.name: c.seconds_ahead for c in self.result.comparisons if c.seconds_ahead is not None}

    @cached_property
    def hashes(self) -> dict[str, str | None]:
        """SHA-256 of the runs' files by the name of the run, or of its half where a run is alone."""
        kept = {row.run: row.file_sha256 for row in self.diagnosis.runs}
        names = [c.run.name for c in self.result.comparisons]
        return {name: kept.get(name, kept.get(name.rsplit(" (", 1)[0])) for name in names}

    @cached_property
    def has_after(self) -> bool:
        return any(c.after is not None for c in self.result.comparisons)

    @cached_property
    def evidence(self) -> tuple[list[tuple[int, Evidence]], list[tuple[int, Evidence]]]:
        """The pictures with their numbers: those specific to the causes, and those that assume none.

        The last is the torque that is missing without any cause; without causes the first is shown, the others folded.
        """
        numbered = list(enumerate(self.result.evidence))
        first = len(numbered) - 1 if self.diagnosis.causes and len(numbered) > 1 else 1
        return numbered[:first], numbered[first:]

    @cached_property
    def ranking(self) -> list[tuple[Any, str]]:
        """The candidates and why each stands where it does."""
        return wording.ranked(self.result, MAX_RANKED)

    @cached_property
    def first_ranked(self) -> int:
        """Candidates shown at once: at least the named ones, which stand first."""
        return max(FIRST_RANKED, len(self.diagnosis.causes) + 2)

    @cached_property
    def notes(self) -> tuple[list[str], list[str]]:
        """What the diagnosis noted on resamples, and the rest."""
        about = [note for note in self.result.notes if "resamples" in note]
        rest = [note for note in self.result.notes if note not in about]
        return list(map(wording.plain, about)), list(map(wording.plain, rest))

    @cached_property
    def gain_rows(self) -> list[GainRow]:
        rows, repeats = [], {row.run: row.repeats for row in self.diagnosis.gain.runs}
        for number, c in enumerate(self.result.comparisons, start=1):
            for channel in c.channels:
                before, refit, after = c.errors(channel)
                rows.append(GainRow(number, c.run.name, wording.CHANNELS[channel], before, refit, after,
                                    repeats.get(c.run.name, {}).get(channel)))
        return rows

    @cached_property
    def any_repeats(self) -> bool:
        """Whether any run's test was done again."""
        return any(row.repeats is not None for row in self.gain_rows)

    @cached_property
    def gain_scale(self) -> float:
        """The largest error of the gain table, the width of its drawings."""
        return max([e for r in self.gain_rows for e in (r.before, r.refit, r.after) if e is not None], default=1e-12)

    @cached_property
    def remains(self) -> str:
        """What is left, in a sentence."""
        return wording.remains_sentence(self.diagnosis, sum(r.larger for r in self.residuals), len(self.residuals))

    @cached_property
    def unpredicted(self) -> list[int]:
        """Numbers of the runs that have no residual one sample ahead."""
        told = {r.number for r in self.residuals}
        return [n for n in range(1, len(self.result.comparisons) + 1) if n not in told]

    @cached_property
    def constant_rows(self) -> list[ConstantRow]:
        nominal, fitted = self.rig.constants(), self.result.extended_rig.constants()
        estimates = self.result.constants
        return [ConstantRow(path, value, estimates.get(path), fitted[path],
                            math.sqrt(self.rig.log_covariance([path])[0, 0]))
                for path, value in nominal.items() if path in fitted]

    @cached_property
    def panels(self) -> int:
        """Channels drawn in the figures of what remains."""
        return len({r.channel for r in self.residuals})

    @cached_property
    def rig_changes(self) -> list[tuple[str, str]]:
        """What the extended rig changes in the rig file: lines with '+', '-' or ' ' before them."""
        lines = difflib.unified_diff(self.rig.to_toml().splitlines(), self.result.extended_rig.to_toml().splitlines(),
                                     n=1, lineterm="")
        return [(line[:1], line) for line in lines if not line.startswith(("---", "+++"))]

    @cached_property
    def rig_hash(self) -> str:
        """SHA-256 of the rig as Station writes it."""
        return hashlib.sha256(self.rig.to_toml().encode()).hexdigest()

    @cached_property
    def versions(self) -> str:
        return ", ".join([f"Station {station.__version__}", f"Python {platform.python_version()}",
                          *(f"{name} {metadata.version(name)}" for name in _LIBRARIES)])

    @cached_property
    def timing(self) -> list[tuple[str, list[str], str, list[tuple[str, int]]]]:
        """Of each run whose log tells it: how fast samples were answered (us: median, 99 %, 99.9 %, longest), the
        share of ticks that had no command in time, and the histogram's filled bins."""
        found = []
        for comparison in self.result.comparisons:
            known = comparison.run.metadata.entries()
            latency, counts, histogram = (known.get(key) for key in ("latency", "counts", "histogram"))
            try:
                times = [f"{1e6 * float(latency[key]):.0f}" for key in ("median", "p99", "p999", "max")]
                share = f"{100.0 * counts['unanswered'] / max(counts['samples'], 1):.2g} %"
                bins = [(f"{1e6 * float(edge):.0f}", int(count)) for edge, count in
                        zip(histogram["edges"], histogram["counts"], strict=True) if count]
            except (TypeError, KeyError, ValueError):  # another program's log, or an older one
                continue
            found.append((comparison.run.name, times, share, bins))
        return found

    @staticmethod
    def describe(comparison: RunComparison) -> dict[str, str]:
        """How a run was made, in words."""
        run, facts = comparison.run, comparison.run.metadata
        return {"began": str(facts.entries().get("began") or "")[:16].replace("T", " "),
                "test": wording.test_words(facts.test) if facts.test else "test not stated",
                "controller": wording.test_words(facts.controller),
                "samples": f"{len(run.t)} at {run.sample_rate:.0f} Hz", "start": facts.start,
                "use": "held out" + ("" if comparison.seconds_ahead is None else
                                        f", predicted {comparison.seconds_ahead:g} s ahead")}

"""A diagnosis and a comparison as tables on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from station.diagnose.result import Diagnosis, DiagnosisResult, RunComparison
from station.errors import printable
from station.view import wording

RANKED = 6
"""Candidates shown."""


def print_diagnosis(result: DiagnosisResult, console: Console, rig: str = "RIG") -> None:
    """Verdict, what is wrong, causes, rivals and why they lost, gain and next experiment.

    ``rig``: how the rig was named on the command line, for the next one.
    """
    found = wording.as_told(result)
    console.print(_plain(wording.verdict_sentence(found, result.rig, wording.far_off(result))), style="bold")
    for sentence in result.amiss:
        console.print(_plain(f"First: {sentence}."), style="yellow")
    if found.wrong:
        console.print(_table("What the simulation gets wrong", ["run", "measure", "simulated", "measured"],
                             [(w.run, *wording.measure(w)) for w in found.wrong]))
    if found.causes:
        rows = [(wording.cause_title(c.effect, c.at), wording.probability(c.probability),
                 wording.resamples(c.stability), name.replace("_", " "), wording.interval(e))
                for c in found.causes for name, e in c.parameters.items()]
        console.print(_table("Causes", ["cause", "probability", "named in", "parameter",
                                        "value (95 % interval)"], rows))
        for cause in found.causes:
            if rest := wording.rest_sentence(cause, found.outside):
                console.print(_plain(f"{wording.cause_title(cause.effect, cause.at)}: {rest}"))
        if kept := wording.outside_sentence(found.outside):
            console.print(_plain(kept))
    for sentence in result.equivalences:
        console.print(_plain(f"{sentence} No test can tell them apart."))
    if result.ranking:
        console.print(_table("Candidates", ["candidate", "probability", "2 Δln L", "gain", "why it stands here"], [
            (wording.cause_title(c.effect, c.at), wording.probability(c.probability), wording.number(c.delta_chi2),
             wording.percent(c.held_out_gain), why) for c, why in wording.ranked(result, RANKED)]))
    if result.comparisons:
        print_comparison(result.comparisons, console, {row.run: row.repeats for row in found.gain.runs})
    _print_ahead(found, console)
    if told := wording.disturbance(found):
        console.print(_plain(told))
    if differ := wording.between_runs(found):
        console.print(_plain(differ))
    if strained := wording.strained(result):
        console.print(_plain(strained))
    if gone := wording.gone(found):
        console.print(wording.sentence(f"on runs that no fit has seen, {gone}"))
    for told in wording.beyond(result):
        console.print(_plain(told))
    if found.next_experiment is not None:
        for line in f"Next: {wording.next_test(found.next_experiment, rig)}".splitlines():
            console.print(_plain(line), soft_wrap=True)


def print_comparison(comparisons: Sequence[RunComparison], console: Console,
                     repeats: Mapping[str, Mapping[str, float]]) -> None:
    """The error (nrmse) of each run and channel: as the rig file says, re-fitted, and with the causes; beside it by
    how much ``repeats`` (run, channel) of its test differ, where there are any."""
    rows = []
    extra = ["between repeats"] if any(repeats.values()) else []
    for c in comparisons:
        for channel in c.channels:
            errors = [wording.percent(error) for error in c.errors(channel)]
            between = [wording.percent(repeats.get(c.run.name, {}).get(channel)) for _ in extra]
            rows.append((c.run.name, wording.CHANNELS[channel], *errors, *between))
    console.print(_table("Error on runs that no fit has seen, share of the signal",
                         ["run", "channel", "before", "re-fitted", "after", *extra], rows))
    for told in wording.predicted_ahead(comparisons):
        console.print(_plain(told))


def _print_ahead(found: Diagnosis, console: Console) -> None:
    """The angle predicted a time ahead, and the measures of step tests, before and after."""
    times = wording.ahead_times(found)
    if not times:
        return
    steps, new = wording.any_step(found), "after" if found.causes else "re-fitted"
    columns = ["run", *(f"{time} ahead" for time in times)]
    rows = []
    for row in found.gain.runs:
        gains = [row.ahead.get(time) for time in times]
        cells = ["–" if g is None else f"{wording.percent(g.nrmse_before)} → {wording.percent(g.nrmse_after)}"
                 for g in gains]
        told = [wording.step_words(row.measured, row.repeats), *map(wording.step_words, (row.before, row.after))]
        rows.append((row.run, *cells, *(told if steps else ())))
    console.print(_table(f"Error of the angle predicted ahead, before → {new}"
                         + ("; overshoot, rise and settling time" if steps else ""),
                         columns + (["measured", "before", new] if steps else []), rows))


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*(_plain(cell) for cell in row))
    return table


def _plain(text: str) -> Text:
    """Text from files as it is: no markup, and no character that a terminal obeys."""
    return Text(printable(text))

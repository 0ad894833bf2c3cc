"""The page of a campaign: confusion matrix, reliability diagram, gains and every case, in one file."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from station.view import wording
from station.view.figures import empty
from station.view.html import render, write_page

_VERDICTS = {**wording.VERDICTS, "": "none"}
_SYMBOLS = {"encoder": ("circle", "after"), "accel": ("diamond", "before")}


def write_campaign(summary: dict[str, Any], path: str | Path, title: str = "campaign") -> None:
    """Write the page of a campaign's summary; WorkError where the file cannot be written."""
    write_page(path, campaign_html(summary, title))


def campaign_html(summary: dict[str, Any], title: str = "campaign") -> str:
    """The page; all text that comes from plans and rigs is escaped."""
    page = _Page(summary, title)
    return render("campaign.html.j2", "campaign.css", page=page, figures=page.figures)


class _Page:
    """What the template asks for."""

    def __init__(self, summary: dict[str, Any], title: str) -> None:
        self.found, self.title = summary, title
        self.figures: dict[str, go.Figure] = {}
        self.calibration = summary["calibration"]["stated"]
        if self.calibration["bins"]:
            self.figures["reliability"] = reliability_figure(self.calibration)
        if any(case["gain"] for case in summary["table"]):
            self.figures["gains"] = gain_figure(summary["table"])

    @property
    def sentence(self) -> str:
        """What came of it, in one line."""
        found = self.found
        text = f"{found['cases']} case{'' if found['cases'] == 1 else 's'} diagnosed"
        single = found["shares"]["single causes named first"]
        clean = found["shares"]["clean rigs accused"]
        parts = []
        if single["of"]:
            parts.append(f"of {single['of']} single hidden causes {single['count']} were named first")
        if clean["of"]:
            accused = f"{clean['count']} {'was' if clean['count'] == 1 else 'were'} accused"
            parts.append(f"of {clean['of']} clean rigs {accused}")
        return "; ".join([text, *parts]) + "."

    @property
    def shares(self) -> list[tuple[str, dict[str, Any]]]:
        """Those that have something to count."""
        return [(name, value) for name, value in self.found["shares"].items() if value["of"]]

    @property
    def confusion_rows(self) -> list[tuple[str, list[tuple[str, int, float, bool]]]]:
        """Per row: what was hidden, and of each column its name, count, share of the row, and whether it is right."""
        table = self.found["confusion"]
        rows = []
        for hidden, counts in zip(table["rows"], table["counts"], strict=True):
            total = max(sum(counts), 1)
            rows.append((hidden, [(column, count, count / total, right(hidden, column))
                                  for column, count in zip(table["columns"], counts, strict=True)]))
        return rows

    @staticmethod
    def words_of(name: str) -> str:
        """A cause or verdict of the summary in words."""
        if name in _VERDICTS:
            return _VERDICTS[name]
        effect, _, at = name.partition("@")
        return wording.cause_title(effect, at)

    def causes(self, case: dict[str, Any]) -> list[tuple[str, str, bool | None]]:
        """Named causes with their probability, and whether each is one that was hidden (None: nobody knows)."""
        return [(self.words_of(one["cause"]), wording.probability(one["probability"]),
                 None if case["hidden"] is None else one["cause"] in case["hidden"]) for one in case["causes"]]

    def hidden(self, case: dict[str, Any]) -> str:
        """What was hidden, in words."""
        if case["hidden"] is None:
            return "not known"
        return ", ".join(map(self.words_of, case["hidden"])) or "nothing"


def right(hidden: str, column: str) -> bool:
    """Whether a column of the confusion matrix is what its row should be met by."""
    if hidden == "clean":
        return column == "nothing_missing"
    if hidden == "outside the catalogue":
        return column == "unexplained"
    return hidden == column


def reliability_figure(calibration: dict[str, Any]) -> go.Figure:
    """How often what was stated came true, per tenth, with 95 % Wilson intervals."""
    bins = calibration["bins"]
    figure = empty(hovermode="closest")
    figure.add_trace(go.Scatter(x=[0, 1], y=[0, 1], mode="lines", name="as stated", meta={"role": "bound"},
                                line={"dash": "dot", "width": 1.4}, hoverinfo="skip"))
    figure.add_trace(go.Scatter(
        x=[b["stated"] for b in bins], y=[b["share"] for b in bins], mode="markers", name="found, with 95 % interval",
        meta={"role": "points"}, marker={"size": 9, "symbol": "circle"},
        customdata=[[b["count"], b["of"]] for b in bins],
        error_y={"type": "data", "array": [b["high"] - b["share"] for b in bins],
                 "arrayminus": [b["share"] - b["low"] for b in bins], "thickness": 1.6, "width": 4},
        hovertemplate="stated %{x:.3f}, true %{y:.3f}: %{customdata[0]} of %{customdata[1]}<extra></extra>"))
    figure.update_xaxes(title_text="stated probability (mean of each tenth)", range=[-0.02, 1.02])
    figure.update_yaxes(title_text="share that was there", range=[-0.02, 1.02])
    return figure


def gain_figure(cases: list[dict[str, Any]]) -> go.Figure:
    """Error on held-out runs, before against after, a point per case and channel."""
    figure = empty(hovermode="closest")
    lowest, highest = [], []
    for channel, (symbol, role) in _SYMBOLS.items():
        rows = [(case["case"], case["gain"][channel]) for case in cases if channel in case["gain"]]
        rows = [(name, gain) for name, gain in rows if gain["nrmse_before"] > 0.0 and gain["nrmse_after"] > 0.0]
        if not rows:
            continue
        before, after = ([gain[key] for _, gain in rows] for key in ("nrmse_before", "nrmse_after"))
        lowest.append(min(*before, *after))
        highest.append(max(*before, *after))
        figure.add_trace(go.Scatter(
            x=before, y=after, mode="markers", name=wording.CHANNELS[channel], meta={"role": role},
            marker={"size": 7, "symbol": symbol}, text=[escape(name) for name, _ in rows],
            hovertemplate="%{text}: %{x:.3g} > %{y:.3g}<extra></extra>"))
    if lowest:
        ends = [min(lowest), max(highest)]
        figure.add_trace(go.Scatter(x=ends, y=ends, mode="lines", name="no gain", meta={"role": "bound"},
                                    line={"dash": "dot", "width": 1.4}, hoverinfo="skip"))
    figure.update_xaxes(title_text="error before (nrmse, rig file)", type="log")
    figure.update_yaxes(title_text="error after (nrmse, extended rig)", type="log")
    return figure

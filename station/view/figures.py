"""The report's figures: Plotly figures without colours, which the page adds for light, dark and paper.

A trace or annotation says its role (measured, before, refit, after, law, points, bound) in ``meta`` or ``name``;
roles differ by dash and symbol too, so that no figure needs colour to be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from types import MappingProxyType

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy import signal

from station.diagnose.result import DiagnosisResult, Prediction, RunComparison
from station.model.simulate import Simulation
from station.pictures.picture import Evidence
from station.runs.run import Run
from station.view.labels import place_labels
from station.view.residuals import Residual
from station.view.wording import CHANNELS, plain

MAX_POINTS = 4000
"""Points of a line that stands alone; longer ones keep the extremes of each stretch."""
BUDGET = 1_100_000
"""Characters that the lines of all runs may take together, so that a report stays below 3 MB with its script."""
LEAST = 200
"""Points that every line of a run has, however many runs there are."""

ROLES = {"measured": ("measured", "solid", 4.5), "before": ("before", "dash", 2.0),
         "refit": ("re-fitted", "solid", 1.4), "after": ("after", "solid", 1.6)}
"""Name, dash and width of each line: a broad band is measured, a dashed line before, a thin one after."""
_LABELS = {"before": "simulated before", "measured": "measured", "after": "simulated after",
           "refit": "simulated, re-fitted", "reference": "reference"}
_UNITS = {"encoder": "encoder counts", "accel": "accelerometer counts"}
_POINT = 8
"""Characters of a point: six bytes, in base 64."""
_LAW_KINDS = {"speed", "angle", "load", "command"}
MANY = 300
"""Points from which on a picture shows their medians."""


def thin(t: np.ndarray, y: np.ndarray, limit: int = MAX_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most ``limit`` points of y(t), the lowest and highest of each stretch kept."""
    if len(y) <= limit:
        return t, y
    width = -(-len(y) // (limit // 2))
    whole = len(y) // width * width
    blocks = y[:whole].reshape(-1, width)
    starts = np.arange(len(blocks)) * width
    keep = np.unique(np.concatenate([starts + blocks.argmin(axis=1), starts + blocks.argmax(axis=1), [0, len(y) - 1]]))
    return t[keep], y[keep]


def simulations(comparison: RunComparison) -> dict[str, Simulation]:
    """The simulations to draw beside a run, by role: before and after, or before and re-fitted."""
    if comparison.after is not None:
        return {"before": comparison.before, "after": comparison.after}
    return {"before": comparison.before, "refit": comparison.refit}


def hero(comparison: RunComparison, channel: str) -> go.Figure:
    """One run, one channel: measured, simulated before and after, each labelled on its line.

    The reference joins them where the loop is closed and it rests at few levels, as in a step.
    """
    figure = empty()
    run = comparison.run
    lines = {"measured": getattr(run, channel)}
    lines |= {role: getattr(s, channel) for role, s in simulations(comparison).items()}
    for role, values in lines.items():
        figure.add_trace(_line(run.t, values, role, *ROLES[role]))
    rests = np.count_nonzero(np.diff(run.reference)) < 0.02 * len(run.t)
    if channel == "encoder" and rests and not run.open_loop:
        lines["reference"] = run.reference
        figure.add_trace(_line(run.t, run.reference, "reference", "reference", "dot", 1.4, legend=False))
    _label_lines(figure, run.t, lines)
    figure.update_xaxes(title_text="time (s)", range=[float(run.t[0]), float(run.t[-1])])
    figure.update_yaxes(title_text=f"{CHANNELS[channel]} ({_UNITS[channel]})")
    return figure


def points_per_line(lines: int) -> int:
    """Points that a line of a run may have, where all runs' lines together are so many: they share BUDGET."""
    return max(LEAST, BUDGET // (_POINT * max(lines, 1)))


def channels_of(run: Run, drawn: Mapping[str, Simulation]) -> list[str]:
    """The channels that a run and all simulations beside it have."""
    return [c for c in CHANNELS if all(getattr(one, c) is not None for one in (run, *drawn.values()))]


def lines_of(run: Run, drawn: Mapping[str, Simulation]) -> int:
    """Lines of its figure."""
    return len(channels_of(run, drawn)) * (1 + 2 * len(drawn))


def run_figure(run: Run, drawn: Mapping[str, Simulation], limit: int = MAX_POINTS,
               names: Mapping[str, str] = MappingProxyType({})) -> go.Figure:
    """One run: each channel measured and simulated, and under it the residuals of the simulations, ``drawn`` by role.

    ``names``: of roles, where they are not those of ROLES.
    """
    channels = channels_of(run, drawn)
    figure = _pairs(channels, "measured − simulated", run.t)
    for index, channel in enumerate(channels):
        measured = getattr(run, channel)
        figure.add_trace(_line(run.t, measured, "measured", *ROLES["measured"], legend=index == 0, limit=limit),
                         row=2 * index + 1, col=1)
        for role, simulation in drawn.items():
            simulated, (name, dash, width) = getattr(simulation, channel), ROLES[role]
            name = escape(names.get(role, name))
            figure.add_trace(_line(run.t, simulated, role, name, dash, width, legend=index == 0, limit=limit),
                             row=2 * index + 1, col=1)
            figure.add_trace(_line(run.t, measured - simulated, role, name, dash, 1.2, legend=False, limit=limit),
                             row=2 * index + 2, col=1)
    return figure


def evidence_figure(evidence: Evidence) -> go.Figure:
    """The picture specific to a cause: the points, their median where they are many, and the fitted law."""
    figure = empty(hovermode="closest")
    x, y = np.asarray(evidence.x, float), np.asarray(evidence.y, float)
    if evidence.kind in ("time", "spectrum"):
        figure.add_trace(_line(x, y, "measured", "measured", "solid", 1.6))
    else:
        many = len(x) > MANY
        figure.add_trace(go.Scatter(x=_floats(x), y=_floats(y), mode="markers", name="measured",
                                    meta={"role": "points"}, opacity=0.35 if many else 0.9,
                                    marker={"size": 4 if many else 7, "symbol": "circle"},
                                    hovertemplate="%{x:.4g}, %{y:.4g}<extra></extra>"))
        if many:
            centre, middle, low, high = _binned(x, y)
            figure.add_trace(go.Scatter(
                x=_floats(centre), y=_floats(middle), mode="markers", name="median and quartiles",
                meta={"role": "median"}, marker={"size": 8, "symbol": "diamond"},
                error_y={"type": "data", "array": _floats(high - middle), "arrayminus": _floats(middle - low),
                         "thickness": 1.5, "width": 3}, hovertemplate="%{x:.4g}, %{y:.4g}<extra></extra>"))
            _trim(figure, y, evidence.law_y)
    if evidence.without_y is not None:
        figure.add_trace(_line(evidence.law_x, evidence.without_y, "before", "without the cause", "dash", 2.0,
                               hover="%{x:.4g}, %{y:.4g}"))
    if evidence.law_x is not None and evidence.law_y is not None:
        name, role = ("fitted law", "law") if evidence.without_y is None else ("with the cause", "after")
        figure.add_trace(go.Scatter(x=_floats(evidence.law_x), y=_floats(evidence.law_y), mode="lines",
                                    name=name, meta={"role": role}, line={"width": 3, "dash": "solid"},
                                    hovertemplate="%{x:.4g}, %{y:.4g}<extra></extra>"))
    figure.update_xaxes(title_text=escape(evidence.xlabel))
    figure.update_yaxes(title_text=escape(evidence.ylabel))
    if evidence.kind in ("spectrum", "frequency") and len(x) and x.min() > 0.0:
        _log_x(figure, x)
    if evidence.kind == "spectrum" and len(y) and y.min() > 0.0:
        figure.update_yaxes(type="log")
    return figure


def law_share(evidence: Evidence) -> float | None:
    """By which factor the law of a picture fits the medians of its points best (least squares); 1 where they agree.

    Medians at rest and near it, the inner tenth of their range, do not count: there friction may hold anything, and
    smoothing rounds a jump.  None where points are few or the law is no torque or command that vanishes at rest.
    """
    if evidence.kind not in _LAW_KINDS or evidence.law_x is None or evidence.law_y is None or len(evidence.x) <= MANY:
        return None
    centre, middle, _, _ = _binned(np.asarray(evidence.x, float), np.asarray(evidence.y, float))
    law = np.interp(centre, evidence.law_x, evidence.law_y) * (np.abs(centre) > 0.1 * np.abs(centre).max())
    return float(law @ middle / (law @ law)) if law.any() else None


def prediction_figure(prediction: Prediction) -> go.Figure:
    """What two rivals predict of a test that has not been run: each channel, and under it how far they differ."""
    pairs = {"encoder": prediction.encoder} | ({"accel": prediction.accel} if prediction.accel is not None else {})
    figure = _pairs(list(pairs), "difference", prediction.t)
    looks = (("after", "solid", 2.4), ("before", "dash", 2.0))
    for index, pair in enumerate(pairs.values()):
        for name, (role, dash, width), values in zip(prediction.names, looks, pair, strict=True):
            figure.add_trace(_line(prediction.t, values, role, escape(plain(name)), dash, width, legend=index == 0),
                             row=2 * index + 1, col=1)
        figure.add_trace(_line(prediction.t, pair[0] - pair[1], "law", "difference", "solid", 1.2, legend=False),
                         row=2 * index + 2, col=1)
    return figure


def spectrum_figure(found: list[Residual], rate: float) -> go.Figure:
    """Spectra of the residuals averaged over the runs, before and after, with what the sensor's noise alone has.

    ``rate``: samples per second.
    """
    names = _channels_of(found)
    figure = _panels([f"{CHANNELS[c]} residual, counts/√Hz" for c in names])
    for row, channel in enumerate(names, start=1):
        these = [r for r in found if r.channel == channel]
        for role in ("before", "after"):
            frequency, density = _mean_density([getattr(r, role) for r in these], rate)
            figure.add_trace(_line(frequency, density, role, *ROLES[role], legend=row == 1,
                                   hover="%{x:.3g} Hz, %{y:.3g}"), row=row, col=1)
        white = np.full(len(frequency), these[0].noise / np.sqrt(rate / 2.0))
        figure.add_trace(_line(frequency, white, "bound", "noise and rounding alone", "dot", 1.5, legend=row == 1,
                               hover="%{y:.3g}"), row=row, col=1)
    _log_x(figure, frequency)
    figure.update_yaxes(type="log", exponentformat="none", dtick=1)
    figure.update_xaxes(title_text="frequency (Hz)", row=len(names), col=1)
    return figure


def whiteness_figure(found: list[Residual]) -> go.Figure:
    """Autocorrelation of each residual by lag, one line per run, between the bounds of white noise.

    The bounds are those of the shortest run.
    """
    names = _channels_of(found)
    figure = _panels([f"{CHANNELS[c]} residual: autocorrelation" for c in names])
    for row, channel in enumerate(names, start=1):
        tests = {r.number: r.whiteness for r in found if r.channel == channel}
        bound = max(t.bound for t in tests.values())
        _by_lag(figure, row, {number: (t.lags, t.values) for number, t in tests.items()}, bound, "99 % of white noise")
    figure.update_xaxes(title_text="lag (samples)", row=len(names), col=1)
    return figure


def crossing_figure(found: list[Residual]) -> go.Figure:
    """Correlation of each residual with the command by lag, as a multiple of that run's own 99 % band."""
    names = _channels_of(found)
    figure = _panels([f"{CHANNELS[c]} residual with the command: correlation over its band" for c in names])
    for row, channel in enumerate(names, start=1):
        lines = {r.number: (r.crossing.lags, r.crossing.values / r.crossing.bound)
                 for r in found if r.channel == channel}
        _by_lag(figure, row, lines, 1.0, "99 % of chance")
    figure.update_xaxes(title_text="samples by which the command came earlier", row=len(names), col=1)
    return figure


def _pairs(names: list[str], below: str, t: np.ndarray) -> go.Figure:
    """Two panels for each channel, its lines and ``below``, over one axis of time (s)."""
    titles = [title for c in names for title in (f"{CHANNELS[c]}, {_UNITS[c]}", f"{CHANNELS[c]}: {below}")]
    figure = _plain(make_subplots(rows=len(titles), cols=1, shared_xaxes=True, vertical_spacing=0.22 / len(titles),
                                  subplot_titles=titles))
    figure.update_xaxes(range=[float(t[0]), float(t[-1])])
    figure.update_xaxes(title_text="time (s)", row=len(titles), col=1)
    return figure


def _panels(titles: list[str]) -> go.Figure:
    return _plain(make_subplots(rows=len(titles), cols=1, vertical_spacing=0.16, subplot_titles=titles),
                  hovermode="closest", top=74)


def _by_lag(figure: go.Figure, row: int, lines: dict[int, tuple[np.ndarray, np.ndarray]], bound: float,
            name: str) -> None:
    """One line per run against the lag, and the band at ± ``bound``."""
    largest = max(float(np.abs(y).max()) for _, y in lines.values())
    for number, (lags, y) in lines.items():
        figure.add_trace(go.Scatter(
            x=lags, y=_floats(y), mode="lines+markers", name=f"run {number}", legendgroup=f"run {number}",
            showlegend=row == 1, meta={"role": "after"}, line={"width": 1},
            marker={"size": 6, "symbol": (number - 1) % 30},
            hovertemplate=f"run {number}, lag %{{x}}: %{{y:.2f}}<extra></extra>"), row=row, col=1)
    edge = 1.15 * max(largest, 1.5 * bound)
    figure.update_yaxes(range=[-edge, edge], row=row, col=1)
    for sign in (1.0, -1.0):
        figure.add_trace(_line(lags, np.full(len(lags), sign * bound), "bound", name, "dot", 1.5,
                               legend=row == 1 and sign > 0, hover="%{y:.2f}"), row=row, col=1)


def hero_choice(result: DiagnosisResult) -> tuple[RunComparison, str] | None:
    """The run and channel that show best what the simulation gets wrong.

    The first entry of ``wrong`` names them; otherwise the run with the largest error of its angle.
    """
    if not result.comparisons:
        return None
    by_name = {c.run.name: c for c in result.comparisons}
    for wrong in result.diagnosis.wrong:
        if wrong.run in by_name and wrong.channel in by_name[wrong.run].channels:
            return by_name[wrong.run], wrong.channel
    return max(result.comparisons, key=lambda c: c.errors("encoder")[0] or 0.0), "encoder"


def _channels_of(found: list[Residual]) -> list[str]:
    return [c for c in CHANNELS if any(r.channel == c for r in found)]


def _mean_density(errors: list[np.ndarray], rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequency, Hz, and amplitude density, units/√Hz, by Welch's method (Welch 1967, Hann, half overlap)."""
    segment = min(512, *map(len, errors))
    found = [signal.welch(error, rate, nperseg=segment) for error in errors]
    return found[0][0][1:], np.sqrt(np.mean([power[1:] for _, power in found], axis=0))


def _binned(x: np.ndarray, y: np.ndarray, bins: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    parts = np.array_split(np.argsort(x), bins)
    quartiles = np.array([np.percentile(y[p], [25, 50, 75]) for p in parts])
    return np.array([np.median(x[p]) for p in parts]), quartiles[:, 1], quartiles[:, 0], quartiles[:, 2]


def _log_x(figure: go.Figure, x: np.ndarray) -> None:
    """A logarithmic frequency axis with plain numbers, 1, 2 and 5 of each decade."""
    low, high = np.log10(np.min(x)), np.log10(np.max(x))
    ticks = [m * 10.0**e for e in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in (1, 2, 5)]
    figure.update_xaxes(type="log", range=[low - 0.02, high + 0.02], tickvals=ticks,
                        ticktext=[f"{tick:g}" for tick in ticks])


def _trim(figure: go.Figure, y: np.ndarray, law: np.ndarray | None) -> None:
    """Open on the middle 95 % of a cloud, the law included; a double click shows all."""
    low, high = np.percentile(y, [2.5, 97.5])
    if law is not None and len(law):
        low, high = min(low, float(np.min(law))), max(high, float(np.max(law)))
    if high > low:
        figure.update_yaxes(range=[low - 0.08 * (high - low), high + 0.08 * (high - low)])


def _label_lines(figure: go.Figure, t: np.ndarray, lines: dict[str, np.ndarray]) -> None:
    """Write each line's name beside it, preferably where the simulation before is far from the measured line."""
    apart = np.abs(lines["before"] - lines["measured"])
    texts = {role: _LABELS[role] for role in sorted(lines, key=list(_LABELS).index)}
    for role, place in place_labels(t, lines, texts, apart).items():
        figure.add_annotation(x=float(t[place.index]), y=float(lines[role][place.index]), text=texts[role], name=role,
                              ax=place.shift, ay=place.drop, showarrow=True, arrowhead=0, arrowwidth=1.2,
                              xanchor="left" if place.shift > 0 else "right")


def _line(x: np.ndarray, y: np.ndarray, role: str, name: str, dash: str, width: float, *, legend: bool = True,
          hover: str = "%{y:.1f}", limit: int = MAX_POINTS) -> go.Scatter:
    """A line; where it stands at even places these are not written, and whole numbers take two bytes."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if len(y) > limit * (3 if _even(x) else 1):
        x, y = thin(x, y, limit)
    places = {"x0": float(x[0]), "dx": float((x[-1] - x[0]) / (len(x) - 1))} if _even(x) else {"x": _floats(x)}
    return go.Scatter(**places, y=_short(y), mode="lines", name=name, legendgroup=role, showlegend=legend,
                      meta={"role": role}, line={"dash": dash, "width": width}, hovertemplate=hover)


def _even(x: np.ndarray) -> bool:
    """Whether x rises in equal steps."""
    if len(x) < 3:
        return False
    steps = np.diff(x)
    return bool(steps[0] > 0.0 and np.all(np.abs(steps - steps.mean()) < 1e-6 * steps.mean()))


def _short(values: np.ndarray) -> np.ndarray:
    """As 16-bit integers where that loses nothing, else as 32-bit floats."""
    whole = np.all(np.isfinite(values)) and np.all(values == np.round(values)) and np.all(np.abs(values) < 2**15)
    return values.astype(np.int16) if whole else _floats(values)


def _floats(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def empty(hovermode: str = "x unified") -> go.Figure:
    """A figure as the pages want it, with nothing in it."""
    return _plain(go.Figure(), hovermode, top=30)


def _plain(figure: go.Figure, hovermode: str = "x unified", top: int = 56) -> go.Figure:
    """The look that all figures have: the legend at the top, Plotly's buttons in a strip at the bottom (report.css)."""
    figure.update_layout(template="none", hovermode=hovermode, margin={"l": 56, "r": 12, "t": top, "b": 68},
                         legend={"orientation": "h", "x": 0, "xref": "container", "xanchor": "left", "y": 1.0,
                                 "yanchor": "top", "yref": "container"})
    figure.update_annotations(x=0, xanchor="left", font={"size": 13})
    figure.update_xaxes(zeroline=False, ticks="outside", title_standoff=6)
    figure.update_yaxes(zeroline=True, automargin=True)
    return figure

"""Bode figures: a measured response beside a rig's, and beside those of simulations of the same test."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from station.model.frequency import (
    FrequencyResponse,
    finite_element_response,
    measured_response,
    transfer_matrix_response,
)
from station.rig import Rig
from station.runs.run import Run

TITLES = {"encoder": "command → encoder", "accel": "command → accelerometer"}
COHERENT = 0.5
"""Below this coherence most of a reading has another source than the command: no response is drawn."""
LINES = {"finite elements": {"linestyle": "-", "linewidth": 1.6},
         "transfer matrices": {"linestyle": "--", "linewidth": 1.6}}


def bode_figure(rig: Rig, run: Run | None = None, *, lowest: float = 0.1, highest: float | None = None,
                points: int = 600) -> Figure:
    """Magnitude (dB), phase (deg) and, with a run, coherence against frequency (Hz), one column for each
    sensor.

    Conventions are python-control's: counts per count in dB, phase unwrapped from the lowest frequency on.
    The measured phase is drawn on the branch next to the model's, since noise makes unwrapping it a matter
    of luck.  With a run the frequencies are those that its command excites, unless ``lowest`` and
    ``highest`` (Hz) say less.
    """
    models, measured, top = responses(rig, run, lowest=lowest, highest=highest, points=points)
    sensors = ["encoder"] if models["finite elements"].accel is None else ["encoder", "accel"]
    rows = 2 if measured is None else 3
    return _bode(sensors, rows, lambda axes, sensor: _draw(axes, sensor, models, measured, top))


def responses(rig: Rig, run: Run | None = None, *, lowest: float = 0.1, highest: float | None = None,
              points: int = 600) -> tuple[dict[str, FrequencyResponse], FrequencyResponse | None, float]:
    """What the figure shows: the models' responses by name, the measured one if there is a run, the highest frequency.

    WorkError where the run is too short for a response, or has none.
    """
    measured = None if run is None else measured_response(run)
    top = 0.499 * rig.sample_rate if highest is None else min(highest, 0.499 * rig.sample_rate)
    if measured is not None and highest is None:
        top = min(top, excited(run))
    frequency = np.geomspace(lowest, top, points)
    return {"finite elements": finite_element_response(rig.meshed(), frequency),
            "transfer matrices": transfer_matrix_response(rig, frequency)}, measured, top


def response_table(response: FrequencyResponse) -> dict[str, list[float]]:
    """For programs: frequency (Hz), magnitude (dB) and phase (deg, -180 to 180) of each sensor, and coherences."""
    told = {"frequency": response.frequency.tolist()}
    for name, values in asdict(response).items():
        if values is None or name == "frequency":
            continue
        if np.iscomplexobj(values):
            told[f"{name}_db"] = (20.0 * np.log10(np.abs(values))).tolist()
            told[f"{name}_deg"] = np.rad2deg(np.angle(values)).tolist()
        else:
            told[name] = values.tolist()
    return told


def same_test_picture(accounts: Mapping[str, Run], colours: Mapping[str, str]) -> bytes:
    """A PNG of the responses that a measured run and simulations of its test show, each estimated in the same way.

    The first of ``accounts`` is the measured one; so an effect that no linear response has, such as friction, is seen
    in both.  Magnitude and phase are drawn where the coherence is at least ``COHERENT``.  The resolution is 0.25 Hz,
    coarser where the run is shorter than 16 s.  ``colours``: by account.
    WorkError where there is no response: a command or an encoder that never moves, too few rows.
    """
    measured = next(iter(accounts.values()))
    resolution = max(0.25, 4.0 * measured.sample_rate / len(measured.t))
    found = {name: measured_response(run, resolution) for name, run in accounts.items()}
    top = max(excited(measured), 4.0 * resolution)
    sensors = [s for s in TITLES if all(getattr(response, s) is not None for response in found.values())]
    figure = _bode(sensors, 3, lambda axes, sensor: _draw_accounts(axes, sensor, found, colours, top))
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=130)
    return picture.getvalue()


def _bode(sensors: Sequence[str], rows: int, draw: Callable[[np.ndarray, str], None]) -> Figure:
    """One column for each sensor, filled by ``draw`` (axes (rows), sensor): magnitude, phase and, third, coherence."""
    figure = Figure(figsize=(5.2 * len(sensors), 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, len(sensors), sharex=True, squeeze=False)
    for column, sensor in enumerate(sensors):
        draw(axes[:, column], sensor)
        axes[0, column].set_title(TITLES[sensor])
        axes[-1, column].set_xlabel("frequency, Hz")
    for row, label in enumerate(("magnitude, dB", "phase, deg", "coherence")[:rows]):
        axes[row, 0].set_ylabel(label)
    for axis in axes.flat:
        axis.grid(which="both", alpha=0.25)
    axes[0, 0].legend()
    return figure


def _beside(value: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Phase of ``value``, rad, on the branch next to ``near``."""
    return near + np.angle(value * np.exp(-1j * near))


def _draw_accounts(axes: np.ndarray, sensor: str, found: Mapping[str, FrequencyResponse], colours: Mapping[str, str],
                   top: float) -> None:
    near: np.ndarray | None = None
    for name, response in found.items():
        inside = response.frequency <= top
        frequency, value = response.frequency[inside], getattr(response, sensor)[inside]
        coherence = getattr(response, f"{sensor}_coherence")[inside]
        if near is None:
            near = _unwrapped(value, coherence >= COHERENT)
        phase = _beside(value, near)
        style = {"color": colours[name], "linewidth": 2.6 if name == "measured" else 1.4}
        for axis, line in ((axes[0], 20.0 * np.log10(np.abs(value))), (axes[1], np.rad2deg(phase))):
            axis.semilogx(frequency, np.where(coherence >= COHERENT, line, np.nan), label=name, **style)
        axes[2].semilogx(frequency, coherence, **style)
    axes[2].set_ylim(0.0, 1.05)
    for axis in axes:
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())


def _unwrapped(value: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Phase, rad, unwrapped over the certain rows alone; the others lie on straight lines between them."""
    rows = np.flatnonzero(certain)
    if not rows.size:
        return np.unwrap(np.angle(value))
    return np.interp(np.arange(len(value)), rows, np.unwrap(np.angle(value[rows])))


def excited(run: Run) -> float:
    """Highest frequency (Hz) at which the command's spectrum still reaches 1e-4 of its largest value."""
    spectrum = np.abs(np.fft.rfft(run.command - run.command.mean())) ** 2
    width = max(1, len(spectrum) // 200)
    smooth = np.convolve(spectrum, np.ones(width) / width, mode="same")
    return float(np.fft.rfftfreq(len(run.t), 1.0 / run.sample_rate)[np.flatnonzero(smooth > 1e-4 * smooth.max())[-1]])


def _draw(axes: np.ndarray, sensor: str, models: dict[str, FrequencyResponse],
          measured: FrequencyResponse | None, top: float) -> None:
    model = models["finite elements"]
    phase = np.unwrap(np.angle(getattr(model, sensor)))
    if measured is not None and getattr(measured, sensor) is not None:
        _points(axes, measured.frequency, getattr(measured, sensor), getattr(measured, f"{sensor}_coherence"),
                np.interp(measured.frequency, model.frequency, phase), model.frequency[0], top)
    for name, response in models.items():
        value = getattr(response, sensor)
        axes[0].semilogx(response.frequency, 20.0 * np.log10(np.abs(value)), label=name, **LINES[name])
        axes[1].semilogx(response.frequency, np.rad2deg(_beside(value, phase)), **LINES[name])


def _points(axes: np.ndarray, frequency: np.ndarray, value: np.ndarray, coherence: np.ndarray, near: np.ndarray,
            bottom: float, top: float) -> None:
    shown = (frequency >= bottom) & (frequency <= top)
    grey = 0.85 - 0.65 * coherence[shown]
    style = {"s": 7.0, "color": np.stack([grey, grey, grey], axis=1)}
    magnitude_axis, phase_axis, coherence_axis = axes
    magnitude_axis.scatter(frequency[shown], 20.0 * np.log10(np.abs(value[shown])), label="measured", **style)
    phase_axis.scatter(frequency[shown], np.rad2deg(_beside(value, near)[shown]), **style)
    coherence_axis.semilogx(frequency[shown], coherence[shown], color="0.35", linewidth=1.0)
    coherence_axis.set_ylim(0.0, 1.05)

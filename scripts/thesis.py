#!/usr/bin/env python3
"""Trutter's thesis told through Station: its figures and tables made again, theirs beside ours (docs/thesis.md).

    python scripts/thesis.py [DATA] [--check] [--figures FOLDER]

DATA holds the folder sflr of the laboratory's logs (default ../shared/data, or STATION_MEASURED).  Without options
the tables of docs/thesis.md and docs/thesis_model.md are written where they stand and the figures drawn, which takes
one diagnosis of the five logs (half a minute on two idle cores); with --check the tables are compared and nothing is
written.  What needs logs is left as it is where there are none, and said.

What the thesis printed stands here with its page: the text keeps some of its page numbers (30, 50, 59, 67, 79), and
what lies between is counted from there.  Of its figures the text keeps the captions alone.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from scripts import thesis_model  # noqa: E402
from scripts.plant_figures import ROOTS, pinned_free  # noqa: E402
from station import api  # noqa: E402
from station.model.frequency import FrequencyResponse, finite_element_response, measured_response  # noqa: E402
from station.model.linear import state_space  # noqa: E402
from station.model.lumped import run_chain  # noqa: E402
from station.model.simulate import build, simulate_model  # noqa: E402
from station.rig import Rig, load_rig  # noqa: E402
from station.runs.run import Run  # noqa: E402
from station.runs.step_response import overshoot, settling_time  # noqa: E402
from station.runs.store import load_run  # noqa: E402

LOGS = {"pulse": "OL_pulse", "p": "SFLR_P_control", "lead": "step_response_Gth_comp_no_accel",
        "lead_accel": "step_response_Gth_comp_Ga_opt", "sweep": "swept_sine"}
TABLE_3_1 = {1: (17.54438, 70.08705, None), 2: (15.51451, 55.82281, 135.55951), 5: (15.42203, 50.08486, 105.21056),
             10: (15.41846, 49.97323, 104.32186), 20: (15.41822, 49.96540, 104.25254),
             50: (15.41821, 49.96488, 104.24782), 100: (15.41821, 49.96486, 104.24770)}
"""Table 3.1, p. 38: natural frequencies of a pinned-free beam by number of elements."""
STEPS = {"p": ("5.2", "72", (38.20, None), (24.00, 1.250)), "lead": ("5.3", "75", (18.85, 1.980), (10.00, None)),
         "lead_accel": ("5.4", "78, 79", (20.74, 0.7080), (21.50, 0.6080))}
"""Tables 5.2 to 5.4: number, page, simulated and measured overshoot (%) and settling time (s; None: beyond 2 s)."""
TABLE_5_5 = {"open loop": ((2.29, 6.45, 128.31), (2.36, 1.92, 1.38)), "P": ((23.48, 18.80, 277.05), (2.16, 1.81, 1.69)),
             "lead": ((21.09, 22.57, 289.45), (2.25, 2.40, 1.77)),
             "lead + accelerometer": ((16.41, 18.62, 258.66), (2.52, 1.99, 1.82))}
"""Table 5.5, p. 81: seconds of a simulation, FEM with 1, 4, 10 elements and DT-TMM with 1, 5, 10."""
VELOCITY = 1000.0
"""Times the torque of one N m per count: so strong a motor is not held back by the arm, a source of velocity."""


class NoLogs(Exception):
    """The laboratory's logs are not on this machine."""


def data_folder(given: Path | None = None) -> Path:
    """Where the measured logs are looked for."""
    if given is not None:
        return given
    return Path(os.environ.get("STATION_MEASURED", ROOT.parent / "shared" / "data"))


@cache
def log(name: str) -> Run:
    """One of the laboratory's logs; NoLogs where it is not there."""
    folder = data_folder() / "sflr"
    found = sorted(folder.glob(f"{LOGS[name]}*.txt"))
    if not found:
        raise NoLogs(f"no log {LOGS[name]}* in {folder}; STATION_MEASURED names the folder that holds sflr/")
    return load_run(found[0])


# --- the models -----------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Response:
    """Encoder and accelerometer, counts."""

    encoder: np.ndarray
    accel: np.ndarray


def program_rig(elements: int) -> Rig:
    """The rig that the thesis's program is, to 1e-6 counts (docs/thesis_model.md)."""
    rig = thesis_model.same_in_radians(elements)
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"mesh": "as_stated"})})


def program(run: Run, elements: int = 4) -> Response:
    """The thesis's program in the test of a run: a tick's command comes from the same tick's readings, no rounding."""
    at_once = replace(run, metadata=run.metadata.model_copy(update={"command_row": 0}))
    made = simulate_model(build(program_rig(elements)), at_once, rounding=False)
    return Response(made.encoder, made.accel)


def chain_rig() -> Rig:
    """Krauss and Okasha's rig: the constants fitted for the DT-TMM, its actuator a source of velocity.

    omega/v = K |2 pi j + p|/(s + p) is a motor of inertia J and damping p J whose gain is K |2 pi j + p| J, so strong
    that the arm does not hold it back.  Constants: repository ryanGT/ben_fea_vs_exp.
    """
    rig, gain, pole = load_rig("sflr"), 0.0696301, 209.353
    inertia = VELOCITY / (gain * abs(2j * np.pi + pole))
    parts = {"motor": {"inertia": inertia, "damping": pole * inertia, "gain": VELOCITY},
             "drive": {"stiffness": 0.107970, "damping": 0.0794510},
             "beam": {"flexural_rigidity": 0.174576, "mass_per_length": 0.121712, "damping": 0.0},
             "tip": {"mass": 0.00605669}, "accelerometer": {"gain": 1.08026}}
    return rig.model_copy(update={name: getattr(rig, name).model_copy(update=values)
                                  for name, values in parts.items()})


def chain(run: Run, lumps: int = 10) -> Response:
    """The DT-TMM in the test of a run, one step of Newmark's rule a sample."""
    made = run_chain(chain_rig(), run, lumps)
    return Response(made.encoder, made.accel)


def nominal(run: Run) -> Response:
    """Station's rig `sflr`, starting angle and accelerometer offset as in a comparison."""
    made = api.compare("sflr", run).simulations[0]
    return Response(made.encoder, made.accel)


@cache
def extended() -> dict[str, Response]:
    """What the diagnosis makes of each log by a fit that has not seen it."""
    runs = {name: log(name) for name in LOGS}
    rows = {row.run.name: row for row in api.diagnose("sflr", list(runs.values())).comparisons}
    made = {name: rows[run.name].after or rows[run.name].refit for name, run in runs.items()}
    return {name: Response(s.encoder, s.accel) for name, s in made.items()}


def program_response(frequency: np.ndarray, elements: int = 4) -> FrequencyResponse:
    """The thesis's own frequency response: continuous, without the hold."""
    encoder, accel = np.asarray(state_space(program_rig(elements))(2j * np.pi * frequency))[:, 0]
    return FrequencyResponse(frequency, encoder, accel)


# --- the tables -----------------------------------------------------------------------------------------------------

def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def table_3_1() -> str:
    """Natural frequencies of a pinned-free beam, theirs / ours, and their error against the continuous beam."""
    rows = ["| elements | mode 1 | mode 2 | mode 3 | error of mode 3 |", "| --- | --- | --- | --- | --- |"]
    for n, theirs in TABLE_3_1.items():
        ours = pinned_free(n)[0]
        cells = [f"{_cell(t, 5) or '–'} / {ours[i]:.5f}" if i < len(ours) else "–" for i, t in enumerate(theirs)]
        error = f"{100.0 * (ours[2] / ROOTS[2]**2 - 1.0):.5f} %" if len(ours) > 2 else ""
        rows.append(f"| {n} | {' | '.join(cells)} | {error} |")
    exact = " | ".join(f"{root**2:.5f}" for root in ROOTS)
    return "\n".join([*rows, f"| continuous | {exact} | |"])


def shape_errors() -> str:
    """Figures 3.12 to 3.14: largest distance of the nodes from the analytic shape, tip at 1."""
    rows = ["| elements | mode 1 | mode 2 | mode 3 |", "| --- | --- | --- | --- |"]
    for n in (5, 10, 100):
        errors = [float(np.abs(nodes - exact).max()) for nodes, exact in (_shape(n, mode) for mode in range(3))]
        # Below that eigenvectors of fine meshes differ by rounding, from machine to machine.
        cells = ["below 1e-07" if error < 1e-7 else f"{error:.1e}" for error in errors]
        rows.append(f"| {n} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _shape(elements: int, mode: int) -> tuple[np.ndarray, np.ndarray]:
    """Deflection of the nodes and of the analytic shape there, 1 at the tip."""
    beta, x = ROOTS[mode], np.arange(elements + 1) / elements
    nodes = np.r_[0.0, pinned_free(elements)[1][1::2, mode]]
    return nodes / nodes[-1], _analytic(beta, x)


def _analytic(beta: float, x: np.ndarray) -> np.ndarray:
    shape = np.sin(beta * x) + np.sin(beta) / np.sinh(beta) * np.sinh(beta * x)
    return shape / (2.0 * np.sin(beta))


def bode_table() -> str:
    """Figures 4.6 and 4.7 in numbers."""
    rows = ["| | encoder's zero | beam's first peak | its second |", "| --- | --- | --- | --- |"]
    rows += [f"| {name} | {' | '.join(extremes(response))} |" for name, response in bode_responses().items()]
    return "\n".join(rows)


def extremes(response: FrequencyResponse) -> list[str]:
    """The encoder's zero and the first two peaks of the tip."""
    found = []
    for value, low, high, pick in ((response.encoder, 1.0, 4.0, np.argmin), (response.accel, 1.5, 8.0, np.argmax),
                                   (response.accel, 10.0, 25.0, np.argmax)):
        inside = np.flatnonzero((response.frequency >= low) & (response.frequency <= high))
        decibel = 20.0 * np.log10(np.abs(value[inside]))
        i = int(pick(decibel))
        found.append(f"{decibel[i]:.1f} dB at {response.frequency[inside[i]]:.2f} Hz")
    return found


def extended_sweep() -> FrequencyResponse:
    """The extended rig's sweep, estimated as the measured one is."""
    made = extended()["sweep"]
    found = measured_response(replace(log("sweep"), encoder=made.encoder, accel=made.accel))
    shown = (found.frequency >= 0.5) & (found.frequency <= 30.0)
    return FrequencyResponse(found.frequency[shown], found.encoder[shown], found.accel[shown])


def extended_table() -> str:
    """Pulse and frequency response by the extended rig, each run left out of the fit that made it."""
    run, ours = log("pulse"), nominal(log("pulse"))
    measured, _, linear = bode_responses().values()
    columns = [[f"{made.encoder.max():.0f} counts", f"{made.encoder[-1]:.0f} counts", *extremes(response)]
               for made, response in ((Response(run.encoder, run.accel), measured), (ours, linear),
                                      (extended()["pulse"], extended_sweep()))]
    titles = ("largest angle of the pulse", "angle at its end", "encoder's zero", "beam's first peak", "its second")
    return "\n".join(["| | measured | `sflr` | extended, run left out |", "| --- | --- | --- | --- |",
                      *(f"| {title} | {' | '.join(cells)} |"
                        for title, *cells in zip(titles, *columns, strict=True))])


def bode_responses() -> dict[str, FrequencyResponse]:
    """Measured, the program's and ours, at the frequencies of the measured one."""
    measured = measured_response(log("sweep"))
    shown = (measured.frequency >= 0.5) & (measured.frequency <= 30.0)
    f = measured.frequency[shown]
    return {"measured (swept sine, P)": FrequencyResponse(f, measured.encoder[shown], measured.accel[shown]),
            "thesis's program": program_response(f), "`sflr`": finite_element_response(load_rig("sflr").meshed(), f)}


def phase_bands() -> list[float]:
    """Degrees by which the measured encoder's phase lies above the model's: medians from 5 to 10, 18 and 30 Hz."""
    found = bode_responses()
    measured, model = found["measured (swept sine, P)"], found["`sflr`"]
    above = np.rad2deg(np.angle(measured.encoder / model.encoder))
    f = model.frequency
    return [float(np.median(above[(f >= low) & (f < high)])) for low, high in ((5, 10), (10, 18), (18, 30))]


def pulse_table() -> str:
    """Figures 5.1, 5.2 and 5.12 to 5.14: the open-loop pulse."""
    run = log("pulse")
    found = {"measured": Response(run.encoder, run.accel), "program, 4 elements (5.1, 5.13)": program(run),
             "program, 1 element (5.12)": program(run, 1), "program, 10 elements (5.14)": program(run, 10),
             "DT-TMM (5.2)": chain(run), "`sflr`": nominal(run)}
    rows = ["| | largest angle, counts | at its end, counts | largest acceleration, counts |",
            "| --- | --- | --- | --- |"]
    for name, made in found.items():
        accel = made.accel - made.accel[0]
        rows.append(f"| {name} | {made.encoder.max():.1f} | {made.encoder[-1]:.1f} | {np.abs(accel).max():.1f} |")
    return "\n".join(rows)


def step_table(name: str) -> str:
    """Tables 5.2 to 5.4: overshoot and settling time, theirs and ours."""
    run = log(name)
    number, page, simulated, measured = STEPS[name]
    rows = ["| | overshoot, % | settling time, s |", "| --- | --- | --- |"]

    def row(title: str, over: float, settles: float | None, digits: int = 3) -> None:
        rows.append(f"| {title} | {over:.2f} | {'> end' if settles is None else f'{settles:.{digits}f}'} |")

    def said(title: str, found: tuple[float, float | None]) -> None:
        row(f"{title}, as printed (table {number}, p. {page})", *found)

    def made(title: str, encoder: np.ndarray) -> None:
        row(title, overshoot(run.reference, encoder), settling_time(run.reference, encoder, run.t))

    said("measured", measured)
    made("measured, from the log", run.encoder)
    said("thesis, 4 elements", simulated)
    for n in (4, 1, 10):
        made(f"its program, {n} element{'s' if n > 1 else ''}", program(run, n).encoder)
    made("DT-TMM, 10 lumps", chain(run).encoder)
    made("`sflr`", nominal(run).encoder)
    return "\n".join(rows)


def settled(run: Run, encoder: np.ndarray, band: float) -> float:
    """From the log's first sample to the first after the last outside +-band counts, s."""
    return float(run.t[np.flatnonzero(np.abs(encoder - run.reference[-1]) > band)[-1]] + run.t[1])


def settling_bands() -> list[float]:
    """What the printed settling times are: P measured, lead simulated, lead + accelerometer simulated and measured;
    then the latter two by +-2 % from the step."""
    p, lead, both = log("p"), log("lead"), log("lead_accel")
    last = program(both).encoder
    return [settled(p, p.encoder, 1.0), settled(lead, program(lead).encoder, 1.0), settled(both, last, 1.0),
            settled(both, both.encoder, 2.0), settling_time(both.reference, both.encoder, both.t),
            settling_time(both.reference, last, both.t)]


def times_table() -> str:
    """Table 5.5: seconds of one simulation of 2 s on this machine, the best of five, compiling left out."""
    cases = {"open loop": "pulse", "P": "p", "lead": "lead", "lead + accelerometer": "lead_accel"}
    rows = ["| | theirs, FEM 1 / 4 / 10 elements, s | ours, ms | theirs, DT-TMM 1 / 5 / 10, s | ours, ms |",
            "| --- | --- | --- | --- | --- |"]

    def best(call) -> float:
        call()
        spent = []
        for _ in range(5):
            begun = time.perf_counter()
            call()
            spent.append(time.perf_counter() - begun)
        return 1e3 * min(spent)

    for title, name in cases.items():
        run, rig = log(name), load_rig("sflr")

        def elements(n: int, run=run, rig=rig) -> None:
            beam = rig.beam.model_copy(update={"elements": n, "mesh": "as_stated"})
            simulate_model(build(rig.model_copy(update={"beam": beam})), run)

        ours = [best(lambda n=n: elements(n)) for n in (1, 4, 10)]
        lumps = [best(lambda n=n, run=run: chain(run, n)) for n in (1, 5, 10)]
        fem, tmm = TABLE_5_5[title]
        cells = (" / ".join(f"{v:.2f}" for v in fem), " / ".join(f"{v:.1f}" for v in ours),
                 " / ".join(f"{v:.2f}" for v in tmm), " / ".join(f"{v:.0f}" for v in lumps))
        rows.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(rows)


# --- the figures ----------------------------------------------------------------------------------------------------

THEIRS = {"measured": {"color": "0.55", "linewidth": 2.2}, "program": {"color": "C1", "label": "thesis's program"},
          "chain": {"color": "C2", "linestyle": "--", "label": "DT-TMM"}}
OURS = {"measured": THEIRS["measured"], "nominal": {"color": "C0", "label": "sflr"},
        "extended": {"color": "C3", "linestyle": "--", "label": "extended, run left out"}}


def save(figure: Figure, path: Path) -> None:
    """As a small SVG that is the same whenever it is drawn."""
    settings = {"svg.fonttype": "none", "svg.hashsalt": "station", "path.simplify_threshold": 0.5}
    with matplotlib.rc_context(settings):
        figure.savefig(path, metadata={"Date": None, "Creator": None})
    path.write_text("\n".join(line.rstrip() for line in path.read_text(encoding="utf-8").splitlines()) + "\n",
                    encoding="utf-8")


def shapes_figure(path: Path) -> None:
    """Figures 3.12 to 3.14."""
    figure = Figure(figsize=(9.0, 2.6), layout="constrained")
    for mode, axis in enumerate(figure.subplots(1, 3)):
        x = np.linspace(0.0, 1.0, 101)
        axis.plot(x, _analytic(ROOTS[mode], x), label="analytic")
        axis.plot(np.arange(11) / 10.0, _shape(10, mode)[0], "o", markersize=4, label="10 elements")
        axis.set(xlabel="x / L", title=f"figure 3.{12 + mode}: mode {mode + 1}")
        axis.grid(alpha=0.3)
    figure.axes[0].set_ylabel("deflection, tip 1")
    figure.axes[0].legend(fontsize=8)
    save(figure, path)


def bode_figure(path: Path) -> None:
    """Figures 4.6 and 4.7; the extended rig by the same estimate as the measured one."""
    found = bode_responses()
    found["extended, left out"] = extended_sweep()
    styles = dict(zip(found, ({"color": "0.55", "marker": ".", "linestyle": "none"}, {"color": "C1"},
                              {"color": "C0", "linestyle": ":", "linewidth": 2.0},
                              {"color": "C3", "linestyle": "--"}), strict=True))
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for column, (sensor, title) in enumerate((("encoder", "figure 4.6: command → encoder"),
                                              ("accel", "figure 4.7: command → accelerometer"))):
        branch = np.unwrap(np.angle(getattr(found["thesis's program"], sensor)))
        for name, response in found.items():
            value = getattr(response, sensor)
            axes[0, column].semilogx(response.frequency, 20.0 * np.log10(np.abs(value)), label=name.replace("`", ""),
                                     **styles[name])
            axes[1, column].semilogx(response.frequency, np.rad2deg(branch + np.angle(value * np.exp(-1j * branch))),
                                     **styles[name])
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel("frequency, Hz")
    axes[0, 0].set_ylabel("magnitude, dB")
    axes[1, 0].set_ylabel("phase, deg")
    axes[0, 0].legend(fontsize=8)
    for axis in axes.flat:
        axis.grid(which="both", alpha=0.25)
    save(figure, path)


def time_figure(name: str, theirs: str, path: Path) -> None:
    """One test: measured beside theirs on the left, beside ours on the right."""
    run = log(name)
    found = {"measured": Response(run.encoder, run.accel), "program": program(run), "chain": chain(run),
             "nominal": nominal(run), "extended": extended()[name]}
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, (lines, title) in enumerate(((THEIRS, theirs), (OURS, "ours"))):
        for key, style in lines.items():
            _line(axes[0, column], run.t, found[key].encoder, {"label": key, **style})
            accel = found[key].accel
            _line(axes[1, column], run.t, accel - accel[:5].mean(), style)
        axes[0, column].set_title(title)
        axes[0, column].legend(fontsize=8)
        axes[1, column].set_xlabel("t, s")
    axes[0, 0].set_ylabel("encoder, counts")
    axes[1, 0].set_ylabel("accelerometer, counts")
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    save(figure, path)


def _line(axis: Axes, t: np.ndarray, values: np.ndarray, style: dict[str, object]) -> None:
    axis.plot(t[::2], values[::2], **{"linewidth": 1.2, **style})


def loops_figure(path: Path) -> None:
    """Figures 5.3, 5.4 and 5.9: the block diagrams, with what Station calls the parts."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    for axis, title, accelerometer, compensator in zip(
            figure.subplots(3, 1), ("figure 5.4: P", "figures 5.3, 5.4: lead", "figure 5.9: lead + accelerometer"),
            (False, False, True), ("Kp", "Gθ(z)", "Gθ(z)"), strict=True):
        axis.set(xlim=(0, 10), ylim=(0, 2.2))
        axis.axis("off")
        axis.set_title(title, fontsize=9, loc="left")
        boxes = [(4.0, compensator), (6.6, "rig")]
        for x, text in boxes:
            axis.add_patch(FancyBboxPatch((x, 1.15), 1.2, 0.6, boxstyle="round,pad=0.02", fill=False))
            axis.text(x + 0.6, 1.45, text, ha="center", va="center")
        begin = 1.7 if accelerometer else 2.75
        arrows = [((0.4, 1.45), (begin, 1.45), "reference"), ((3.1, 1.45), (4.0, 1.45), ""),
                  ((5.2, 1.45), (6.6, 1.45), "command"), ((7.8, 1.6), (9.7, 1.6), "encoder"),
                  ((9.2, 1.6), (9.2, 0.25), ""), ((9.2, 0.25), (2.9, 0.25), ""), ((2.9, 0.25), (2.9, 1.25), "−")]
        axis.text(2.9, 1.45, "Σ", ha="center", va="center", fontsize=13)
        if accelerometer:
            axis.text(1.9, 1.45, "Σ", ha="center", va="center", fontsize=13)
            axis.add_patch(FancyBboxPatch((4.0, 0.5), 1.2, 0.45, boxstyle="round,pad=0.02", fill=False))
            axis.text(4.6, 0.72, "Ga(z)", ha="center", va="center")
            arrows += [((2.1, 1.45), (2.75, 1.45), ""), ((7.8, 1.3), (8.6, 1.3), ""), ((8.6, 1.3), (8.6, 0.72), ""),
                       ((8.6, 0.72), (5.2, 0.72), "accelerometer"), ((4.0, 0.72), (1.9, 0.72), ""),
                       ((1.9, 0.72), (1.9, 1.25), "−")]
        for start, end, text in arrows:
            axis.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=9, shrinkA=0, shrinkB=0))
            axis.text((start[0] + end[0]) / 2 + (0.15 if start[0] == end[0] else 0.0),
                      (start[1] + end[1]) / 2 + (0.0 if start[0] == end[0] else 0.14), text, fontsize=8,
                      ha="left" if start[0] == end[0] else "center")
    save(figure, path)


def draw(folder: Path) -> list[str]:
    """All figures; what could not be drawn, and why."""
    shapes_figure(folder / "thesis_shapes.svg")
    loops_figure(folder / "thesis_loops.svg")
    thesis_model.draw(thesis_model.table([1, 2, 3, 4, 5, 6, 8, 10]), folder / "thesis_elements.svg")
    try:
        bode_figure(folder / "thesis_bode.svg")
        for name, numbers in (("pulse", "5.1, 5.2"), ("p", "5.5, 5.6"), ("lead", "5.7, 5.8"),
                              ("lead_accel", "5.10, 5.11")):
            time_figure(name, f"theirs: figures {numbers}", folder / f"thesis_{name}.svg")
    except NoLogs as error:
        return [f"figures 4.6, 4.7 and 5.1 to 5.11 are left as they are: {error}"]
    return []


MAKERS = {"thesis.table_3_1": table_3_1, "thesis.shapes": shape_errors, "thesis.bode": bode_table,
          "thesis.pulse": pulse_table, "thesis.p": lambda: step_table("p"), "thesis.lead": lambda: step_table("lead"),
          "thesis.lead_accel": lambda: step_table("lead_accel"), "thesis.settling": settling_bands,
          "thesis.times": times_table,
          "thesis.extended": extended_table}
"""What makes the marked blocks of docs/thesis.md (scripts/kept_numbers.py)."""


def main() -> int:
    """Write or compare the tables, draw the figures."""
    from scripts import kept_numbers

    parser = argparse.ArgumentParser(description="The thesis's figures and tables, theirs beside ours")
    parser.add_argument("data", nargs="?", type=Path, help="folder that holds sflr/")
    parser.add_argument("--check", action="store_true", help="compare the tables; write nothing")
    parser.add_argument("--figures", type=Path, default=ROOT / "docs" / "figures", help="where the figures go")
    options = parser.parse_args()
    if options.data is not None:
        os.environ["STATION_MEASURED"] = str(options.data.resolve())
    names = [name for name in kept_numbers.known() if name.startswith("thesis")]
    status = kept_numbers.run(names, check=options.check)
    if not options.check:
        for line in draw(options.figures):
            print(line)
    return status


if __name__ == "__main__":
    from scripts import thesis  # the same module as scripts/kept_numbers.py uses, so that nothing is done twice

    sys.exit(thesis.main())

"""The plant's figures for the documentation, and what makes the numbers that stand beside them.

    python scripts/plant_figures.py [--out docs/figures] [--logs FOLDER]

The numbers are written into docs/physics.md by `python scripts/numbers` (scripts/kept_numbers.py).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import control
import numpy as np
import scipy.linalg
import scipy.optimize
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from station.control.compensators import Compensator
from station.control.design import modes, transfer_function
from station.model.beam import beam_matrices
from station.model.effects.backlash import Backlash
from station.model.effects.coulomb_friction import CoulombFriction
from station.model.effects.load_friction import LoadFriction
from station.model.effects.stribeck_friction import StribeckFriction
from station.model.linear import natural_frequencies, state_space
from station.model.lumped import lumped_assembly, run_chain
from station.model.simulate import build, simulate_model
from station.model.transfer_matrix import chain_response
from station.model.transfer_matrix import natural_frequencies as continuous_frequencies
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from station.runs.store import load_run
from station.view.bode import bode_figure

ROOTS = [scipy.optimize.brentq(lambda x: np.tan(x) - np.tanh(x), x - 0.3, x + 0.3) for x in (3.927, 7.069, 10.210)]
"""beta L of a pinned-free beam's first modes."""
L2 = 0.00714375
"""Beam beyond the laboratory rig's sensor, m."""


def with_elements(rig: Rig, elements: int) -> Rig:
    """The same rig with another number of elements."""
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})


def pinned_free(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Natural frequencies and shapes of the thesis's beam, the rigid mode left out."""
    mass, stiffness = (m[1:, 1:] for m in beam_matrices(1.0, 1.0, 1.0, elements))
    squared, shapes = scipy.linalg.eigh(stiffness, mass)
    return np.sqrt(squared[1:]), shapes[:, 1:]


def beam_figure(path: Path) -> None:
    """Frequency error against element length, and the first three shapes against theory."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    errors, shapes = figure.subplots(1, 2)
    counts = np.array([2, 3, 4, 6, 8, 12, 16, 24, 32])
    for mode, beta in enumerate(ROOTS):
        found = [pinned_free(n)[0][mode] / beta**2 - 1.0 if 2 * n > mode else np.nan for n in counts]
        errors.loglog(1.0 / counts, found, "o-", markersize=3, label=f"mode {mode + 1}")
        nodes = np.arange(11) / 10.0
        x = np.linspace(0.0, 1.0, 200)
        shape = np.sin(beta * x) + np.sin(beta) / np.sinh(beta) * np.sinh(beta * x)
        deflection = np.r_[0.0, pinned_free(10)[1][1::2, mode]]
        line = shapes.plot(x, shape / shape[-1], label=f"mode {mode + 1}")[0]
        shapes.plot(nodes, deflection / deflection[-1], "o", markersize=4, color=line.get_color())
    errors.loglog(1.0 / counts, 0.3 * (1.0 / counts) ** 4, "k:", label="fourth power")
    errors.set(xlabel="element length / beam length", ylabel="relative frequency error")
    shapes.set(xlabel="x / L", ylabel="deflection")
    errors.xaxis.set_minor_formatter(NullFormatter())
    for axis in (errors, shapes):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path)


LUMPS = (5, 10, 20, 40, 80)


def lumped_errors(finest: int = 32, lumps: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The discrete-time transfer matrix method: steps a sample, largest encoder error of a lead step (counts) for each,
    and the first four frequencies' relative errors for each of LUMPS."""
    rig, rows = load_rig("sflr"), 300
    reference, zero = np.where(np.arange(rows) >= 10, 100.0, 0.0), np.zeros(rows)
    lead = {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}
    run = Run("step", np.arange(rows) / 500.0, reference, zero, zero, zero,
              RunMetadata(controller=lead, command_row=-1))
    plant = control.sample_system(state_space(rig, lumped_assembly(rig, lumps)), rig.period, method="zoh")
    compensator = Compensator.from_spec(lead, rig.sample_rate, rig.amplifier.limit)
    x, exact = np.zeros(plant.nstates), np.zeros(rows)
    for i in range(rows):
        exact[i] = plant.C[0] @ x
        seen = exact[i - 1] if i else 0.0
        x = plant.A @ x + plant.B[:, 0] * compensator.step(reference[i], seen, 0.0)
    steps = 2 ** np.arange(int(np.log2(finest)) + 1)
    in_time = np.array([np.abs(run_chain(rig, run, lumps, int(s)).encoder - exact).max() for s in steps])
    wanted = continuous_frequencies(rig, 100.0)
    in_space = []
    for n in LUMPS:
        parts = lumped_assembly(rig, n)
        squared = scipy.linalg.eigh(parts.stiffness, parts.mass, eigvals_only=True)
        in_space.append(np.sqrt(squared[1:5]) / (2 * np.pi) / wanted - 1.0)
    return steps, in_time, np.array(in_space)


def lumped_numbers() -> list[float]:
    """One step a sample (ms), its error (counts) in a step of 100 counts; by ten lumps, fall of the frequencies (%)."""
    _, in_time, in_space = lumped_errors(finest=1)
    return [2.0, in_time[0], 100.0, *(-100.0 * in_space[LUMPS.index(10)])]


def lumped_figure(path: Path) -> None:
    """Error of the step and error of the lumps, apart."""
    steps, in_time, in_space = lumped_errors()
    counts = np.array(LUMPS)
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(2.0 / steps, in_time, "o-", label="lead step, 10 lumps")
    left.loglog(2.0 / steps, in_time[0] / steps**2.0, "k:", label="second power")
    left.set(xlabel="step, ms", ylabel="encoder error, counts")
    for mode in range(4):
        right.loglog(counts, np.abs(in_space[:, mode]), "o-", label=f"mode {mode + 1}")
    right.loglog(counts, 3.0 / counts**2.0, "k:", label="second power")
    right.set(xlabel="lumps", ylabel="relative frequency error")
    right.xaxis.set_minor_formatter(NullFormatter())
    for axis in (left, right):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path)


def steps_figure(path: Path) -> None:
    """Dry friction and a gap: how far a pulse and a step with the lead differ from the same with very small steps."""
    rig, rows, finest = load_rig("sflr"), 600, 6.25e-6
    hit, up = (np.where((np.arange(rows) >= 10) & (np.arange(rows) < end), size, 0.0)
               for end, size in ((60, 120.0), (rows, 100.0)))
    zero, lead = np.zeros(rows), {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}
    runs = [Run(name, np.arange(rows) / rig.sample_rate, reference, reference, zero, zero, RunMetadata(controller=spec))
            for name, reference, spec in (("pulse", hit, {"kind": "open"}), ("step", up, lead))]
    shown = {"Coulomb friction, 0.05 N m": CoulombFriction(at="motor", torque=0.05),
             "Stribeck friction, 0.1 to 0.05 N m": StribeckFriction(at="motor", static_torque=0.1, coulomb_torque=0.05,
                                                                    stribeck_velocity=0.4),
             "load friction, 0.3": LoadFriction(at="drive", fraction=0.3),
             "backlash, 0.04 rad": Backlash(at="drive", gap=0.04)}
    steps = rig.period / np.array([1, 2, 4, 10, 20, 40])
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)

    def outputs(arm: Rig, longest: float) -> np.ndarray:
        model = build(arm, longest=longest)
        made = [simulate_model(model, run, rounding=False) for run in runs]
        return np.array([[s.encoder, s.accel] for s in made])

    for name, effect in shown.items():
        arm = rig.with_effects([effect])
        exact = outputs(arm, finest)
        errors = np.array([np.abs(outputs(arm, h) - exact).max(axis=(0, 2)) for h in steps])
        print(name, "largest error by step (ms): encoder, accelerometer, counts:",
              {f"{1e3 * h:.3g}": [float(f"{e:.2g}") for e in row] for h, row in zip(steps, errors, strict=True)})
        for axis, row in zip(axes, errors.T, strict=True):
            axis.loglog(1e3 * steps, row, "o-", markersize=4, label=name)
    for axis, channel, size in zip(axes, ("encoder", "accelerometer"), (0.1, 1.0), strict=True):
        axis.loglog(1e3 * steps, size * (steps / steps[0]) ** 2, "k:", label="second power")
        axis.set(xlabel="step, ms", ylabel=f"largest {channel} error, counts")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
    axes[1].legend(fontsize=8, loc="lower right")
    figure.savefig(path)


def frequency_table() -> str:
    """Undamped natural frequencies of sflr by elements, and of the continuous beam."""
    rig = load_rig("sflr")
    rows = ["| elements | natural frequencies of `sflr`, Hz, undamped |", "| --- | --- |"]
    found = {str(n): natural_frequencies(with_elements(rig, n))[1:7] for n in (4, 10, 20, 200)}
    found["continuous"] = continuous_frequencies(rig, 250.0)[:6]
    return "\n".join([*rows, *(f"| {n} | {', '.join(f'{f:.4f}' for f in hertz)} |" for n, hertz in found.items())])


def meshed_elements() -> list[float]:
    """The elements that sflr gets."""
    return [float(load_rig("sflr").meshed().beam.elements)]


def mesh_table() -> str:
    """Readings before rounding, against those of a mesh of 64 elements."""
    rig = load_rig("sflr")
    rows = np.arange(1000)
    t, zero = rows * rig.period, np.zeros(1000)
    p = {"kind": "p", "gain": 2.0}
    lines = ["| test | 4 elements, encoder / accelerometer | 8 | 16 |", "| --- | --- | --- | --- |"]
    for name, reference, spec in (
            ("pulse of 60 counts, open loop", np.where((rows >= 100) & (rows < 150), 60.0, 0.0), {"kind": "open"}),
            ("step of 50 counts, P", np.where(rows >= 100, 50.0, 0.0), p),
            ("sweep of 30 counts to 40 Hz, P", np.where(rows >= 50, 30.0 * np.sin(20.0 * np.pi * t * t), 0.0), p)):
        run = Run(name, t, reference, reference, zero, zero, RunMetadata(controller=spec, command_row=-1))
        made = {n: simulate_model(build(with_elements(rig, n)), run, rounding=False) for n in (4, 8, 16, 64)}
        cells = [f"{np.abs(made[n].encoder - made[64].encoder).max():.4f} / "
                 f"{np.abs(made[n].accel - made[64].accel).max():.4f}" for n in (4, 8, 16)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def transfer_table() -> str:
    """Largest difference in magnitude from the continuous beam up to 100 Hz, zeros included."""
    rig = load_rig("sflr")
    hertz = np.geomspace(0.1, 100.0, 2000)
    exact = chain_response(rig, 2j * np.pi * hertz)
    scale = rig.motor.gain * np.array([1.0 / rig.angle_per_count, rig.accelerometer.gain])
    lines = ["| elements | base, dB | tip, dB |", "| --- | --- | --- |"]
    for n in (4, 10, 20):
        found = state_space(with_elements(rig, n))(2j * np.pi * hertz)[:, 0]
        error = np.abs(20 * np.log10(np.abs(found / (scale[:, None] * np.array([exact.base, exact.tip]))))).max(axis=1)
        lines.append(f"| {n} | {error[0]:.4f} | {error[1]:.4f} |")
    return "\n".join(lines)


def overhang_numbers() -> list[float]:
    """What the beam beyond the sensor would change: its length (mm), frequencies (Hz), their fall (%), the range looked
    at (Hz) and the median change of the magnitudes (dB), base and tip."""
    rig = load_rig("sflr")
    with_it, without = continuous_frequencies(rig, 250.0, L2)[:4], continuous_frequencies(rig, 250.0)[:4]
    hertz = np.geomspace(0.1, 100.0, 2000)
    exact, beyond = chain_response(rig, 2j * np.pi * hertz), chain_response(rig, 2j * np.pi * hertz, L2)
    change = [float(np.median(np.abs(20 * np.log10(np.abs(getattr(beyond, name) / getattr(exact, name))))))
              for name in ("base", "tip")]
    return [1e3 * L2, *with_it, *(100.0 * (1.0 - with_it / without)), *change, 0.1, 100.0]


def zero_and_mode_numbers() -> list[float]:
    """The tip's real zeros (1/s), the poles of sflr: real ones (Hz), pairs (Hz and damping ratio)."""
    plant = state_space(load_rig("sflr"))
    zeros = transfer_function(plant, "accel", below=600.0).zeros
    real = np.sort(zeros[(np.abs(zeros.imag) < 1e-3 * np.abs(zeros)) & (zeros.real > 1.0)].real)
    found = [(mode.frequency, mode.damping) for mode in modes(plant) if mode.frequency > 1e-3]
    alone = [frequency for frequency, damping in found if damping >= 1.0 - 1e-9]
    pairs = [value for frequency, damping in found if damping < 1.0 - 1e-9 for value in (frequency, damping)]
    return [*real[:2], *alone[:3], *pairs[:4]]


def main() -> None:
    """Draw the figures."""
    parser = argparse.ArgumentParser(description="The plant's figures for the documentation")
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    parser.add_argument("--logs", type=Path, help="folder of the laboratory's logs, for the Bode figure")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    beam_figure(options.out / "beam.svg")
    lumped_figure(options.out / "lumped.svg")
    steps_figure(options.out / "steps.svg")
    if options.logs:
        log = load_run(next(options.logs.glob("swept_sine*.txt")))
        bode_figure(load_rig("sflr"), log).savefig(options.out / "bode.png", dpi=90)


if __name__ == "__main__":
    main()

"""The plant's speed: a closed-loop step against C, NumPy, python-control and Drake; cost against elements; batches.

    python scripts/bench/plant.py [--only peers elements batch] [--drake PYTHON]

All figures are CPU time, warm, medians, peers and Station in one run.  ``--drake`` names a Python that has Drake.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import control
import numba
import numpy as np
import scipy

from station.control.compensators import Compensator
from station.model.linear import sampled, state_space
from station.model.simulate import build, simulate, simulate_model
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata

ROWS = 1000
LEAD = {"kind": "lead", "gain": 20.0, "zero": 31.41592653589793, "pole": 125.66370614359172}
HERE = Path(__file__).resolve().parent


def rig_with(elements: int) -> Rig:
    """The built-in rig with another number of elements."""
    rig = load_rig("sflr")
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})


def step_run() -> Run:
    """A step of 100 counts through the lead compensator, 2 s at 500 Hz."""
    reference, zero = np.where(np.arange(ROWS) >= 50, 100.0, 0.0), np.zeros(ROWS)
    return Run("step", np.arange(ROWS) / 500.0, reference, zero, zero, zero, RunMetadata(controller=LEAD))


def cpu(task: Callable[[], object], least: float = 0.5, most: int = 2000) -> float:
    """Median CPU seconds of a task, repeated for ``least`` seconds; once before to warm it."""
    task()
    times: list[float] = []
    while sum(times) < least and len(times) < most:
        start = time.process_time_ns()
        task()
        times.append((time.process_time_ns() - start) * 1e-9)
    return float(np.median(times))


def compile_c(folder: str) -> tuple[ctypes.CDLL, str]:
    """The C loop as a shared library, and the compiler's version."""
    compiler = os.environ.get("CC", "cc")
    target = str(Path(folder) / "plant_loop.so")
    subprocess.run([compiler, "-O3", "-shared", "-fPIC", "-o", target, str(HERE / "plant_loop.c"), "-lm"], check=True)
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    return ctypes.CDLL(target), version.splitlines()[0]


def c_loop(rig: Rig, run: Run, library: ctypes.CDLL) -> Callable[[], np.ndarray]:
    """The same modes, compensator and rounding in C; returns the encoder's column."""
    plan = build(rig).plan
    blocks = plan.phi.shape[1]
    compensator = Compensator.from_spec(LEAD, rig.sample_rate, rig.amplifier.limit)
    inputs = [np.ascontiguousarray(a, dtype=float) for a in (
        plan.phi, plan.held, plan.base_angle * plan.counts_per_radian,
        plan.tip_acceleration * plan.counts_per_acceleration, compensator.numerator, compensator.denominator)]
    reference = np.ascontiguousarray(run.reference)
    state, command, encoder, accel = np.zeros(2 * blocks), *np.zeros((3, ROWS))

    def address(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    arguments = [ctypes.c_int(ROWS), ctypes.c_int(blocks), *map(address, inputs), ctypes.c_double(rig.amplifier.limit),
                 *map(address, (reference, state, command, encoder, accel))]

    def run_c(alive: tuple = (inputs, reference)) -> np.ndarray:
        state[:] = 0.0
        library.closed_loop(*arguments)
        return encoder

    return run_c


def numpy_loop(rig: Rig, run: Run) -> Callable[[], np.ndarray]:
    """x = A x + B u with dense matrices, one row at a time."""
    plant = sampled(rig)
    a, b, c = plant.A, plant.B[:, 0], plant.C
    compensator = Compensator.from_spec(LEAD, rig.sample_rate, rig.amplifier.limit)

    def run_numpy() -> np.ndarray:
        compensator.reset()
        x, encoder = np.zeros(len(b)), np.zeros(ROWS)
        for i in range(ROWS):
            y = np.floor(c @ x + 0.5)
            encoder[i] = y[0]
            x = a @ x + b * np.floor(compensator.step(run.reference[i], y[0], y[1]) + 0.5)
        return encoder

    return run_numpy


def lsim_loop(rig: Rig, run: Run, rows: int) -> Callable[[], np.ndarray]:
    """The thesis's method: python-control simulates one sample at a time from the state before."""
    plant = state_space(rig)
    compensator = Compensator.from_spec(LEAD, rig.sample_rate, rig.amplifier.limit)
    times = np.array([0.0, rig.period])

    def run_lsim() -> np.ndarray:
        compensator.reset()
        x, encoder = np.zeros(plant.nstates), np.zeros(rows)
        for i in range(rows):
            y = np.floor(plant.C @ x + 0.5)
            encoder[i] = y[0]
            command = np.floor(compensator.step(run.reference[i], y[0], y[1]) + 0.5)
            x = control.forced_response(plant, times, [command, command], x).states[:, -1]
        return encoder

    return run_lsim


DRAKE = """
import json, sys, time
from importlib.metadata import version
import numpy as np
from pydrake.all import DiagramBuilder, LinearSystem, LeafSystem, Simulator
d = json.load(open(sys.argv[1]))
a, b, c = (np.array(d[k]) for k in "abc")
num, den, limit, rows, period = d["num"], d["den"], d["limit"], d["rows"], d["period"]
class Lead(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("y", 2)
        self.DeclareDiscreteState(2)
        self.DeclareVectorOutputPort("u", 1, self.out)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)
    def law(self, context):
        e = (100.0 if round(context.get_time() / period) >= 50 else 0.0) - np.floor(self.EvalVectorInput(
            context, 0).value()[0] + 0.5)
        s = context.get_discrete_state_vector().value()
        return e, min(max(num[0] * e + num[1] * s[0] - den[1] * s[1], -limit), limit)
    def out(self, context, output):
        output.SetFromVector([np.floor(self.law(context)[1] + 0.5)])
    def update(self, context, state):
        state.get_mutable_vector().SetFromVector(self.law(context))
builder = DiagramBuilder()
plant = builder.AddSystem(LinearSystem(a, b, c, np.zeros((2, 1)), period))
lead = builder.AddSystem(Lead())
builder.Connect(plant.get_output_port(), lead.get_input_port())
builder.Connect(lead.get_output_port(), plant.get_input_port())
diagram = builder.Build()
times = []
for _ in range(5):
    simulator = Simulator(diagram)
    simulator.Initialize()
    start = time.process_time()
    simulator.AdvanceTo(rows * period - 0.5 * period)
    times.append(time.process_time() - start)
context = plant.GetMyContextFromRoot(simulator.get_context())
print(json.dumps({"seconds": sorted(times)[2], "last": float(plant.get_output_port().Eval(context)[0]),
                  "version": version("drake")}))
"""


def drake(python: str, rig: Rig) -> dict:
    """Drake's discrete simulation of the same loop in another Python."""
    plant = sampled(rig)
    compensator = Compensator.from_spec(LEAD, rig.sample_rate, rig.amplifier.limit)
    with tempfile.TemporaryDirectory() as folder:
        model, script = Path(folder) / "model.json", Path(folder) / "run.py"
        model.write_text(json.dumps({"a": plant.A.tolist(), "b": plant.B.tolist(), "c": plant.C.tolist(),
                                     "num": compensator.numerator.tolist(), "den": compensator.denominator.tolist(),
                                     "limit": rig.amplifier.limit, "rows": ROWS, "period": rig.period}))
        script.write_text(DRAKE)
        done = subprocess.run([python, str(script), str(model)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"Drake: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def peers(drake_python: str | None) -> None:
    """One closed-loop step, 10 elements."""
    rig, run = rig_with(10), step_run()
    model = build(rig)
    with tempfile.TemporaryDirectory() as folder:
        library, compiler = compile_c(folder)
        in_c, in_numpy = c_loop(rig, run, library), numpy_loop(rig, run)
        encoder = simulate_model(model, run).encoder
        for name, other in (("C", in_c()), ("NumPy", in_numpy())):
            away = np.abs(other - encoder).max()
            assert away <= 1.0, f"{name} simulates something else: {away} counts away"
        station = cpu(lambda: simulate_model(model, run))
        compiled = cpu(in_c)
        rows = [("C loop, -O3", compiled, compiler), ("Station, warm", station, f"Numba {numba.__version__}"),
                ("Station, rig assembled anew", cpu(lambda: simulate(rig, run, start_angle=0.0)), ""),
                ("NumPy matrix loop", cpu(in_numpy), f"NumPy {np.__version__}")]
        few = 100
        lsim = lsim_loop(rig, run, few)
        assert np.abs(lsim() - encoder[:few]).max() <= 1.0
        rows.append(("python-control, per-sample lsim", cpu(lsim, most=3) * ROWS / few,
                     f"python-control {control.__version__}, {few} samples scaled"))
    if drake_python:
        found = drake(drake_python, rig)
        assert abs(found["last"] - encoder[-1]) <= 2.0, f"Drake simulates something else: {found['last']}"
        rows.append(("Drake, discrete", found["seconds"], f"Drake {found['version']}"))
    print(f"closed-loop step, {ROWS} samples, 10 elements, {model.form.blocks} of {2 * 10 + 3} modes kept, "
          f"bound on what was left out {model.dropped:.1e} count")
    for name, seconds, note in rows:
        print(f"  {name:34s} {1e6 * seconds:12.1f} us   {seconds / compiled:10.2f} x C   "
              f"{seconds / station:10.2f} x Station   {note}")


def elements() -> None:
    """Cost of a warm run, and of assembly, against elements."""
    run, first = step_run(), None
    print("elements  modes kept  bound, counts  warm run, us  against the least  assembly, ms")
    rows = []
    for count in (1, 2, 4, 10, 20, 50, 100):
        rig = rig_with(count)
        model = build(rig)
        rows.append((count, model, cpu(lambda model=model: simulate_model(model, run), 0.2),
                     cpu(lambda rig=rig: build(rig), 0.1)))
    first = min(row[2] for row in rows)
    for count, model, seconds, assembly in rows:
        print(f"{count:8d}  {model.form.blocks:10d}  {model.dropped:13.1e}  {1e6 * seconds:12.1f}  "
              f"{seconds / first:17.2f}  {1e3 * assembly:12.2f}")


def several(factors: np.ndarray) -> tuple[list[float], float]:
    """Rigs with their own constants, each assembled and run: their peaks, and the CPU seconds spent."""
    start, base, run, peaks = time.process_time(), rig_with(10), step_run(), []
    constants = base.constants()
    for row in factors:
        rig = base.with_constants({path: value * factor for (path, value), factor in
                                   zip(constants.items(), row, strict=True)})
        peaks.append(float(simulate(rig, run, start_angle=0.0).encoder.max()))
    return peaks, time.process_time() - start


def batch(size: int = 1000, repeats: int = 3) -> None:
    """Closed-loop runs of rigs with different constants, over two processes that are warm."""
    factors = np.random.default_rng(0).uniform(0.9, 1.1, (size, len(rig_with(10).constants())))
    workers = min(2, os.cpu_count() or 1)
    chunks = np.array_split(factors, 10 * workers)
    with ProcessPoolExecutor(workers) as pool:
        list(pool.map(several, chunks))
        for _ in range(repeats):
            start = time.perf_counter()
            found = list(pool.map(several, chunks))
            seconds, spent = time.perf_counter() - start, sum(part[1] for part in found)
            peaks = [peak for part in found for peak in part[0]]
            print(f"{size} rigs assembled and run for {ROWS} samples on {workers} processes: {seconds:.2f} s, "
                  f"{size / seconds:.0f} per second, {100.0 * spent / seconds / workers:.0f} % of {workers} cores "
                  f"used; peaks {min(peaks):.0f} to {max(peaks):.0f} counts")


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=["peers", "elements", "batch"],
                        default=["peers", "elements", "batch"])
    parser.add_argument("--drake", help="a Python interpreter that has Drake")
    options = parser.parse_args()
    print(f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, "
          f"Numba {numba.__version__}, python-control {control.__version__}")
    if "peers" in options.only:
        peers(options.drake)
    if "elements" in options.only:
        elements()
    if "batch" in options.only:
        batch()


if __name__ == "__main__":
    sys.exit(main())

"""The compiled stepper: CPU of a warm closed-loop step, plain and with friction and backlash, and of the first one.

    python scripts/bench/stepper.py [--fresh 5]

Wanted, at 1,000 samples and 10 elements: < 0.08 ms without effects, < 2 ms with friction and backlash; the first
simulation in a fresh process (interpreter, imports, rig and simulation) < 1.5 s with Numba's cache on disk and < 20 s
without.  Held against python-control's forced_response, one sample at a time, in the same run.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time

import numpy as np
from plant import ROWS, cpu, lsim_loop, rig_with, step_run

from station.model.effects import effect_class
from station.model.simulate import build, simulate, simulate_model
from station.rig import Rig

PLAIN_MS, EFFECTS_MS, WARM_S, COLD_S = 0.08, 2.0, 1.5, 20.0
FIRST = """
import numpy as np
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
zero = np.zeros(1000)
run = Run("step", np.arange(1000) / 500.0, np.where(np.arange(1000) >= 50, 100.0, 0.0), zero, zero, zero,
          RunMetadata(controller={"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}))
rig = load_rig("sflr")
if EFFECTS:
    rig = rig.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.2),
                            effect_class("backlash")(at="drive", gap=0.02)])
assert simulate(rig, run).encoder.max() > 50.0
"""


def with_friction(rig: Rig) -> Rig:
    """The same rig with dry friction at the motor and play in the drive."""
    return rig.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.2),
                             effect_class("backlash")(at="drive", gap=0.02)])


def sticking(rig: Rig) -> float:
    """Share of the ticks on which friction holds the motor (below 1e-7 rad per tick): part of what is timed."""
    states = simulate(rig, step_run(), start_angle=0.0, states=True).states
    return float(np.mean(np.abs(np.diff(states[50:, 0])) < 1e-7))


def verdict(value: float, wanted: float, unit: str) -> str:
    """A figure beside what is wanted."""
    return f"{value:9.3f} {unit}   wanted < {wanted:g} {unit}: {'met' if value < wanted else 'NOT MET'}"


def fresh(folder: str, effects: bool) -> tuple[float, float]:
    """Wall and CPU seconds of a new process that simulates once, Numba's cache in ``folder``."""
    before, start = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-c", FIRST.replace("EFFECTS", str(effects))], check=True,
                   env=os.environ | {"NUMBA_CACHE_DIR": folder})
    wall, after = time.perf_counter() - start, os.times()
    return wall, (after.children_user + after.children_system) - (before.children_user + before.children_system)


def main() -> int:
    """Warm runs, then fresh processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fresh", type=int, default=5, help="fresh processes with the cache on disk")
    options = parser.parse_args()
    rig, run, few = rig_with(10), step_run(), 100
    loose = with_friction(rig)
    models = {"no effects": build(rig), "friction and backlash": build(loose)}
    held = sticking(loose)
    assert 0.1 < held < 0.95, f"the motor sticks on {100 * held:.0f} % of the ticks: no fair figure"
    peer = lsim_loop(rig, run, few)
    away = np.abs(peer() - simulate_model(models["no effects"], run).encoder[:few]).max()
    assert away <= 1.0, f"python-control simulates something else: {away} counts away"
    lsim = cpu(peer, most=5) * ROWS / few
    met = True
    print(f"warm, {ROWS} samples, 10 elements; the motor sticks on {100 * held:.0f} % of the ticks with friction")
    for (name, model), wanted in zip(models.items(), (PLAIN_MS, EFFECTS_MS), strict=True):
        spent = cpu(lambda model=model: simulate_model(model, run))
        met &= 1e3 * spent < wanted
        print(f"  {name:24s}{verdict(1e3 * spent, wanted, 'ms')}; python-control's forced_response takes "
              f"{1e3 * lsim:.0f} ms ({few} samples scaled), {lsim / spent:.0f} times as long")
    print("first simulation in a fresh process, interpreter and imports included")
    for effects in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            rounds = [fresh(folder, effects) for _ in range(1 + options.fresh)]
        cold, warm = rounds[0], rounds[1:]
        wall, spent = (float(np.median([row[k] for row in warm])) for k in (0, 1))
        met &= cold[0] < COLD_S and wall < WARM_S
        what = "friction and backlash" if effects else "no effects"
        print(f"  {what}, no cache {verdict(cold[0], COLD_S, 's')} ({cold[1]:.2f} s of CPU)")
        print(f"  {what}, cached   {verdict(wall, WARM_S, 's')} ({spent:.2f} s of CPU), median of {len(warm)}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())

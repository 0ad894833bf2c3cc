"""Simulating a run: tick by tick or whole, its start, its clock, its accuracy, and from an installation that nobody
may write to."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.signal

from station.control.compensators import Compensator
from station.control.rounding import round_half_up
from station.model.effects import effect_class
from station.model.linear import sampled
from station.model.simulate import Plant, build, simulate, simulate_model
from station.rig import Limits, Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.truth import CONTROLLERS, RIGID_AXIS, TWO_MASS

ROOT = Path(__file__).resolve().parents[2]
RATE = 500.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("sflr")


def effects(*rows: tuple[str, str, dict[str, float]]):
    return [effect_class(name)(at=at, **values) for name, at, values in rows]


MANY = effects(("coulomb_friction", "motor", {"torque": 0.05}), ("backlash", "drive", {"gap": 0.03}),
               ("input_delay", "amplifier", {"time": 0.0031}), ("actuator_lag", "amplifier", {"time_constant": 0.004}),
               ("encoder_delay", "encoder", {"time": 0.0047}), ("gravity_tilt", "base", {"torque": 0.02, "angle": 1.0}),
               ("accelerometer_lag", "accelerometer", {"time_constant": 0.003}),
               ("accelerometer_saturation", "accelerometer", {"limit": 40.0}))


def make_run(reference: np.ndarray, controller: str = "open", rate: float = RATE, **facts) -> Run:
    zero = np.zeros(len(reference))
    row = 0 if controller == "open" else -1
    return Run("test", np.arange(len(zero)) / rate, reference, reference, zero, zero,
               RunMetadata(controller=CONTROLLERS[controller], command_row=row, **facts))


def noise(rows: int, seed: int = 1, size: float = 200.0) -> np.ndarray:
    """A command that excites everything: whole counts at random, held for random times."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.integers(-size, size + 1, rows), rng.integers(1, 12, rows))[:rows].astype(float)


STEP = np.where(np.arange(600) < 50, 0.0, 120.0)


@pytest.mark.parametrize("held", [[], MANY], ids=["linear", "eight effects"])
@pytest.mark.parametrize("controller", ["p2", "lead", "lead_accel", "pid", "cascade", "filter"])
def test_plant_tick_by_tick_is_the_simulation(rig, held, controller):
    """The simulated device's way, its compensator in Python, gives every count of the compiled loop."""
    machine = rig.with_effects(held)
    whole = simulate(machine, make_run(STEP, controller, accel_zero=2.0), start_angle=0.05, accel_offset=2.0)
    plant = Plant(machine, start_angle=0.05, accel_offset=2.0)
    compensator = Compensator.from_spec(CONTROLLERS[controller], machine.sample_rate, machine.amplifier.limit)
    compensator.reset(accel_zero=2.0)
    rows, command = [], 0.0
    for row, reference in enumerate(STEP):
        encoder, accel = plant.sample()
        if row > 0:
            command = round_half_up(compensator.step(reference, *rows[-1][1:]))
        rows.append((command, encoder, accel))
        plant.advance(command)
    np.testing.assert_array_equal(np.array(rows).T, [whole.command, whole.encoder, whole.accel])
    assert np.ptp(whole.encoder) > 50 and np.ptp(whole.accel) > 20


@pytest.mark.parametrize(("tested", "logged", "cut"), [(None, None, 200.0), (90.0, None, 90.0), (90.0, 60.0, 60.0),
                                                       (90.0, 150.0, 90.0)])
def test_a_closed_loop_is_cut_where_the_rigs_limits_or_the_runs_own_are_tightest(rig, tested, logged, cut):
    machine = rig.model_copy(update={"limits": Limits(command=tested)})
    made = simulate(machine, make_run(2.0 * STEP, "lead", command_limit=logged))
    assert made.command.max() == cut and made.command.min() == -cut


def test_a_limit_for_tests_leaves_the_amplifiers_own_laws_alone(rig):
    """A gain curve is relative to the amplifier's limit, and logged commands acted as they are logged."""
    machine = rig.with_effects(effects(("gain_curve", "amplifier", {"exponent": -0.3})))
    tight = machine.model_copy(update={"limits": Limits(command=50.0)})
    np.testing.assert_array_equal(simulate(tight, make_run(noise(200))).encoder,
                                  simulate(machine, make_run(noise(200))).encoder)


def test_a_loop_whose_controller_is_not_known_is_driven_by_its_logged_commands(rig):
    """The logged commands of a closed loop, and neither its reference nor any loop, move the model."""
    closed = make_run(STEP, "p2")
    logged = replace(closed, command=simulate(rig, closed).command)
    unknown = replace(logged, metadata=RunMetadata(command_row=-1))
    assert unknown.metadata.controller == {"kind": "unknown"} and not unknown.open_loop
    made, as_logged = simulate(rig, unknown), simulate(rig, make_run(logged.command))
    np.testing.assert_array_equal(made.command, logged.command)
    np.testing.assert_array_equal([made.encoder, made.accel], [as_logged.encoder, as_logged.accel])
    other = simulate(rig, replace(unknown, reference=2.0 * STEP))
    np.testing.assert_array_equal(other.encoder, made.encoder)


def test_plant_follows_any_command_as_the_open_loop_does(rig):
    command = noise(500)
    for held in ([], MANY):
        whole = simulate(rig.with_effects(held), make_run(command), start_angle=0.0)
        plant, rows = Plant(rig.with_effects(held)), []
        for count in command:
            rows.append(plant.sample())
            plant.advance(count)
        np.testing.assert_array_equal(np.array(rows).T, [whole.encoder, whole.accel])


def test_a_command_acts_from_its_row_on_and_shows_in_the_next(rig):
    command = np.where(np.arange(40) >= 10, 100.0, 0.0)
    made = simulate(rig, make_run(command), rounding=False, start_angle=0.0)
    assert np.all(made.encoder[:11] == 0.0) and made.encoder[11] != 0.0
    assert np.all(made.accel[:11] == 0.0) and made.accel[11] != 0.0


@pytest.mark.parametrize("rows", [1, 3])
def test_a_delay_of_whole_periods_is_a_shift_of_the_command(rig, rows):
    command = noise(300)
    shifted = np.concatenate([np.zeros(rows), command[:-rows]])
    late = rig.with_effects(effects(("input_delay", "amplifier", {"time": rows / RATE})))
    one = simulate(late, make_run(command), rounding=False, start_angle=0.0)
    other = simulate(rig, make_run(shifted), rounding=False, start_angle=0.0)
    np.testing.assert_allclose(one.encoder, other.encoder, atol=1e-9)
    np.testing.assert_allclose(one.accel, other.accel, atol=1e-9)


SMOOTH = [("cable_spring", "base", {"stiffness": 0.15, "rest": 0.3}), ("hardening_spring", "drive", {"cubic": 1.5}),
          ("quadratic_drag", "base", {"coefficient": 0.02}),
          ("torque_ripple", "motor", {"amplitude": 0.06, "cycles": 6.0, "phase": 1.0})]
SHARP = [("sublinear_drag", "motor", {"coefficient": 0.1, "speed": 0.7}),
         ("coulomb_friction", "motor", {"torque": 0.05}), ("load_friction", "drive", {"fraction": 0.3}),
         ("backlash", "drive", {"gap": 0.04}), ("encoder_delay", "encoder", {"time": 0.0047})]


@pytest.mark.parametrize("row", SMOOTH + SHARP, ids=lambda row: row[0])
def test_simulation_converges_with_its_step(rig, row):
    """Halving the step: smooth laws (implicit midpoint) gain a factor of 4, others at least do not lose."""
    machine, run = rig.with_effects(effects(row)), make_run(STEP, "lead_accel")
    exact = simulate_model(build(machine, longest=1e-5), run, rounding=False)
    gaps = []
    for longest in (2e-3, 1e-3, 5e-4, 1e-4):
        made = simulate_model(build(machine, longest=longest), run, rounding=False)
        gaps.append(np.abs(made.encoder - exact.encoder).max())
    assert gaps[2] < 0.05 and gaps[3] < 0.01
    assert gaps[3] < 0.3 * gaps[0] + 1e-9
    if row in SMOOTH:
        assert gaps[1] < 0.35 * gaps[0] + 1e-9 and gaps[2] < 0.35 * gaps[1] + 1e-9


@pytest.mark.parametrize("cubic", [3e4, 3e5])
def test_a_clamp_that_gets_stiffer_than_the_step_is_long_does_not_run_away(rig, cubic):
    """Up to 24 and 54 times as stiff as it is at rest."""
    machine = rig.with_effects(effects(("hardening_spring", "clamp", {"cubic": cubic})))
    run = make_run(STEP, "lead_accel")
    exact, *made = (simulate_model(build(machine, longest=longest), run, rounding=False)
                    for longest in (2e-5, 1e-3, 5e-4, 1e-4))
    encoder, accel = ([np.abs(getattr(one, channel) - getattr(exact, channel)).max() for one in made]
                      for channel in ("encoder", "accel"))
    assert encoder[0] < 0.3 and encoder[1] < 0.03 and encoder[2] < 0.01
    assert accel[0] < 15.0 and accel[1] < 0.2 * accel[0] and accel[2] < 0.2 * accel[1]


@pytest.mark.parametrize("elements", [4, 20])
def test_truncation_bound_holds_on_random_commands(rig, elements):
    fine = rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})
    whole = build(fine, truncation=0.0)
    for allowed in (0.5, 0.01):
        cut = build(fine, truncation=allowed)
        assert 0.0 < cut.dropped <= allowed and cut.form.blocks < whole.form.blocks
        for seed in range(6):
            run = make_run(noise(600, seed))
            full, short = (simulate_model(model, run, rounding=False) for model in (whole, cut))
            assert np.abs(full.encoder - short.encoder).max() <= cut.dropped
            assert np.abs(full.accel - short.accel).max() <= cut.dropped


def without(rig: Rig, *tables: str) -> Rig:
    return rig.model_copy(update=dict.fromkeys(tables))


PARTS = {"whole": (), "no drive": ("drive",), "no clamp": ("clamp",), "no drive, no clamp": ("drive", "clamp"),
         "no tip": ("tip",), "no accelerometer": ("accelerometer",),
         "no beam": ("clamp", "beam", "tip", "accelerometer"), "no base": ("drive", "base"),
         "rigid axis": ("drive", "base", "clamp", "beam", "tip", "accelerometer")}


@pytest.mark.parametrize("tables", PARTS.values(), ids=PARTS)
def test_rigs_with_parts_missing_agree_with_forced_response(rig, tables):
    machine, command = without(rig, *tables), noise(400)
    made = simulate_model(build(machine, truncation=0.0), make_run(command), rounding=False)
    system = sampled(machine)
    states = control.forced_response(system, np.arange(400) / RATE, command).states
    before = np.concatenate([[0.0], command[:-1]])  # sensors are read before the command of their row acts
    outputs = system.C @ states + system.D @ before[None, :]
    np.testing.assert_allclose(made.encoder, outputs[0], atol=1e-6 * np.abs(outputs[0]).max())
    if machine.accelerometer is None:
        assert made.accel is None
    else:
        np.testing.assert_allclose(made.accel, outputs[1], atol=1e-6 * np.abs(outputs[1]).max())


def test_rigid_axis_and_two_masses_agree_with_their_transfer_functions():
    """theta/u = K/(J s^2 + d s), and the shaft's: written down by hand, not assembled."""
    command = noise(500)
    axis, pair = Rig.model_validate(RIGID_AXIS), Rig.model_validate(TWO_MASS)
    one, two = TWO_MASS["motor"], TWO_MASS["base"]
    k, c = TWO_MASS["drive"]["stiffness"], TWO_MASS["drive"]["damping"]
    motor = np.array([one["inertia"], one["damping"] + c, k])
    load = np.array([two["inertia"], c, k])
    alone = RIGID_AXIS["motor"]
    for machine, numerator, denominator in (
            (axis, [alone["gain"]], [alone["inertia"], alone["damping"], 0.0]),
            (pair, one["gain"] * np.array([c, k]), np.polysub(np.polymul(motor, load), np.polymul([c, k], [c, k])))):
        made = simulate(machine, make_run(command), rounding=False, start_angle=0.0)
        _, angle, _ = scipy.signal.lsim((numerator, denominator), command, np.arange(500) / RATE, interp=False)
        np.testing.assert_allclose(made.encoder * machine.angle_per_count, angle, atol=1e-7 * np.abs(angle).max())


@pytest.mark.parametrize("start", ["released", "equilibrium"])
def test_without_torque_or_command_nothing_moves(rig, start):
    made = simulate(rig.with_effects(MANY[:5]), make_run(np.zeros(300), start=start), rounding=False,
                    start_angle=0.123, accel_offset=1.5)
    np.testing.assert_allclose(made.encoder * rig.angle_per_count, 0.123, atol=1e-12)
    np.testing.assert_allclose(made.accel, 1.5, atol=1e-9)


def test_starts_differ_where_a_constant_torque_acts(rig):
    """A tilted rig whose motor's friction holds: released it sags on its drive, in equilibrium it already has."""
    beam = rig.beam.model_copy(update={"mesh": "as_stated"})      # with 8 elements rounding alone drifts 2e-5 counts
    tilted = rig.model_copy(update={"beam": beam}).with_effects(
        effects(("gravity_tilt", "base", {"torque": 0.05, "angle": 1.0}),
                ("coulomb_friction", "motor", {"torque": 0.1})))
    made = {start: simulate(tilted, make_run(np.zeros(2000), start=start), rounding=False, start_angle=0.0).encoder
            for start in ("released", "equilibrium")}
    np.testing.assert_allclose(made["equilibrium"], 0.0, atol=1e-5)
    assert np.ptp(made["released"]) > 10.0


def test_start_angle_defaults_to_the_first_reading(rig):
    run = make_run(np.zeros(20))
    run = Run("at 40", run.t, run.reference, run.command, np.full(20, 40.0), np.zeros(20), run.metadata)
    np.testing.assert_array_equal(simulate(rig, run).encoder, 40.0)


@pytest.mark.parametrize("ratio", [0.95, 1.03])
def test_clock_scale_is_another_true_rate_under_the_same_nominal_time(rig, ratio):
    """The same commands by index at a true period of ratio/rate; delays stay true seconds, t stays index/rate."""
    late = effects(("input_delay", "amplifier", {"time": 0.0031}))
    run = make_run(noise(400))
    scaled = simulate(rig.with_effects([*late, *effects(("clock_scale", "clock", {"ratio": ratio}))]), run,
                      rounding=False, start_angle=0.0)
    true_rate = rig.model_copy(update={"sample_rate": RATE / ratio}).with_effects(late)
    same = simulate(true_rate, run, rounding=False, start_angle=0.0)
    np.testing.assert_allclose(scaled.encoder, same.encoder, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(scaled.accel, same.accel, rtol=1e-9, atol=1e-7)
    np.testing.assert_array_equal(scaled.t, np.arange(400) / RATE)


def test_states_and_shape_are_what_the_sensors_read(rig):
    made = simulate(rig, make_run(noise(200)), rounding=False, start_angle=0.1, states=True)
    np.testing.assert_allclose(made.states[:, 1] / rig.angle_per_count, made.encoder, atol=1e-9)
    nodes = rig.meshed().beam.elements + 1
    assert nodes > rig.beam.elements + 1 and made.shape.shape == (200, nodes)
    np.testing.assert_array_equal(made.shape[:, 0], 0.0)
    np.testing.assert_allclose(made.shape[0], 0.1 * rig.beam.length * np.linspace(0.0, 1.0, nodes), atol=1e-12)


WORK = """
import json, sys, tempfile
from pathlib import Path
closed, real_file, real_folder = sys.argv[1], tempfile.TemporaryFile, Path.mkdir
def check(path):
    if path is not None and Path(path).is_relative_to(closed):
        raise PermissionError(13, "Permission denied", str(path))
def file(*args, dir=None, **kwargs):
    check(dir)
    return real_file(*args, dir=dir, **kwargs)
def folder(path, *args, **kwargs):
    check(path)
    return real_folder(path, *args, **kwargs)
if closed:
    tempfile.TemporaryFile, Path.mkdir = file, folder
import numpy as np
import station
import station.model.compiled
if len(sys.argv) > 2:
    from numba.core.caching import UserProvidedCacheLocator
    from numba import config
    import shutil, station.model.stepper as stepper
    place = Path(config.CACHE_DIR) / UserProvidedCacheLocator.get_suitable_cache_subpath(stepper.__file__)
    place.mkdir(parents=True, exist_ok=True)
    for file in Path(sys.argv[2]).rglob("stepper.*.nb*"):
        shutil.copy2(file, place)
from station.model import stepper
from station.model.simulate import simulate
from station.model.effects import effect_class
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
step = np.where(np.arange(300) < 50, 0.0, 120.0)
run = Run("step", np.arange(300) / 500.0, step, step, 0.0 * step, 0.0 * step, RunMetadata())
dead = effect_class("dead_zone")(at="amplifier", width=5.0)
made = simulate(load_rig("sflr").with_effects([dead]), run, start_angle=0.0)
stats = stepper.ticks.stats
print(json.dumps({"package": str(Path(station.__file__).parent), "encoder": made.encoder.tolist(),
                  "hits": sum(stats.cache_hits.values()), "misses": sum(stats.cache_misses.values())}))
"""


def in_a_fresh_process(*arguments: str, **environment: str | None) -> dict:
    variables = {name: value for name, value in {**os.environ, **environment}.items() if value is not None}
    done = subprocess.run([sys.executable, "-c", WORK, *arguments], capture_output=True, text=True, timeout=200,
                          env=variables, cwd=environment["PYTHONPATH"])
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def expected(rig: Rig) -> list[float]:
    step = np.where(np.arange(300) < 50, 0.0, 120.0)
    dead = effects(("dead_zone", "amplifier", {"width": 5.0}))
    return simulate(rig.with_effects(dead), make_run(step), start_angle=0.0).encoder.tolist()


def test_first_simulation_of_a_fresh_process_compiles_nothing(rig):
    encoder = expected(rig)
    made = in_a_fresh_process("", PYTHONPATH=str(ROOT))
    assert made["encoder"] == encoder and made["hits"] == 1 and made["misses"] == 0


def test_an_installation_that_nobody_may_write_to_keeps_its_cache_elsewhere(rig, tmp_path):
    """A copy of the package without its caches, closed to writing (to an administrator: as it would look closed).

    The copy is handed this session's compiled stepper in the user's cache, so that it is not compiled once more.
    """
    package, cache = tmp_path / "site" / "station", tmp_path / "cache"
    shutil.copytree(ROOT / "station", package, ignore=shutil.ignore_patterns("__pycache__"))
    before = sorted(str(path) for path in package.rglob("*"))
    encoder = expected(rig)
    folders = [package, *(path for path in package.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    enforced = not os.access(package, os.W_OK)
    warm = os.environ.get("NUMBA_CACHE_DIR", str(ROOT / "station" / "model" / "__pycache__"))
    try:
        made = in_a_fresh_process("" if enforced else str(package), warm, PYTHONPATH=str(package.parent),
                                  PYTHONDONTWRITEBYTECODE="1", XDG_CACHE_HOME=str(cache), NUMBA_CACHE_DIR=None)
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert made["package"] == str(package) and made["encoder"] == encoder
    assert sorted(str(path) for path in package.rglob("*")) == before
    if sys.platform == "linux":
        kept = [path.name for path in (cache / "station" / "numba").rglob("*.nbi")]
        assert any(name.startswith("dead_zone.command") for name in kept)

"""Recordings for Rerun: what stands in them, read back by Rerun itself."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from station.errors import WorkError
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from station.view import arm, viewer
from station.view.bode import same_test_picture
from station.view.events import find_events
from station.view.recording import TIMELINE, write_recording
from tests.view import made

RIG = load_rig("sflr")
ACCOUNTS = ("measured", "nominal", "extended")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "five.rrd"
    write_recording(path, made.comparisons(), RIG)
    return path


def chunks(path: Path) -> dict[str, list[Any]]:
    """What Rerun reads back, by entity path: record batches of the rows that change in time."""
    reader = pytest.importorskip("rerun.chunk", reason="this Rerun reads back in another way").RrdReader(path)
    found: dict[str, list[Any]] = {}
    for chunk in reader.stream():
        if not chunk.is_static:
            found.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return found


@pytest.fixture(autouse=True)
def own_settings(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setattr(viewer.platformdirs, "user_config_dir",
                        lambda *_, **__: str(tmp_path_factory.getbasetemp() / "settings"))


def test_rerun_finds_nothing_wrong_with_it(recorded: Path) -> None:
    subprocess.run([viewer._program(), "rrd", "verify", str(recorded)], timeout=60, check=True,
                   env=viewer.private_environment(), capture_output=True)


def test_each_run_has_measured_nominal_and_extended_on_device_time(recorded: Path) -> None:
    found = chunks(recorded)
    for run in range(1, 6):
        paths = [f"{what}/{name}" for name in ACCOUNTS for what in ("angle", "acceleration")]
        paths += [f"arm/{name}/{part}" for name in ACCOUNTS for part in ("beam", "tip", "name")]
        paths += [f"residual/{what}/{name}" for what in ("angle", "acceleration") for name in ("nominal", "extended")]
        for path in [*paths, "angle/reference", "command"]:
            assert all(TIMELINE in batch.schema.names for batch in found[f"/run_{run}/{path}"]), path
    assert "/run_1/events" in found


def test_the_rows_come_back_as_they_were_on_device_time_from_zero(tmp_path: Path) -> None:
    comparison = made.comparisons()[0]
    clock = comparison.run.t * 1.001 + 77.0
    path = tmp_path / "one.rrd"
    write_recording(path, [replace(comparison, run=replace(comparison.run, device_time=clock))], RIG)
    batch, = chunks(path)["/run_1/angle/measured"]
    assert [value for value, in batch["Scalars:scalars"].to_pylist()] == comparison.run.encoder.tolist()
    times = batch[TIMELINE].to_numpy().astype("timedelta64[ns]").astype(float) * 1e-9
    assert times == pytest.approx(1.001 * comparison.run.t, abs=2e-9)


def test_it_brings_a_blueprint_with_one_tab_for_each_run(tmp_path: Path) -> None:
    path = tmp_path / "two.rrd"
    write_recording(path, made.comparisons()[:2], RIG)
    text = subprocess.run([viewer._program(), "rrd", "print", "-vvv", str(path)], capture_output=True, text=True,
                          timeout=60, env=viewer.private_environment(), check=True).stdout
    for words in ("[step-kp2]", "[step-kp1-large]", "[run_1]", "[run_2]", "[TimeSeries]", "[3D]", "[TextLog]",
                  "[Arm from above, deflection × 4]", "[Angle: measured − simulated (counts)]",
                  "[Frequency responses (Bode)]"):
        assert words in text, words


def test_a_bare_run_stands_beside_the_nominal_simulation(tmp_path: Path) -> None:
    path = tmp_path / "bare.rrd"
    write_recording(path, [made.comparisons()[0].run], RIG)
    found = chunks(path)
    assert "/run_1/angle/nominal" in found and "/run_1/angle/extended" not in found


def test_a_second_rig_stands_beside_it_as_the_extended_one(tmp_path: Path) -> None:
    path, run = tmp_path / "two.rrd", made.comparisons()[0].run
    friction = RIG.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.02)])
    write_recording(path, [run], RIG, extended=friction)
    found = chunks(path)
    batch, = found["/run_1/angle/extended"]
    expected = simulate(friction, run, accel_offset=arm.resting(run.accel, run.sample_rate)).encoder
    assert [value for value, in batch["Scalars:scalars"].to_pylist()] == expected.tolist()
    assert {"/run_1/residual/angle/extended", "/run_1/arm/extended/beam"} <= set(found)


def test_the_rows_of_a_run_with_gaps_stay_on_their_ticks(tmp_path: Path) -> None:
    run = made.comparisons()[0].run
    kept = np.delete(np.arange(len(run)), [100, 101])
    gappy = Run("gappy", n=kept, metadata=run.metadata, **{k: v[kept] for k, v in run.columns().items() if k != "n"})
    path = tmp_path / "gappy.rrd"
    write_recording(path, [gappy], RIG)
    found = chunks(path)
    simulated, = found["/run_1/angle/nominal"]
    whole = simulate(RIG, gappy.filled(), accel_offset=arm.resting(run.accel, run.sample_rate)).encoder
    assert [value for value, in simulated["Scalars:scalars"].to_pylist()] == whole.tolist()
    texts = [text for batch in found["/run_1/events"] for text, in batch["TextLog:text"].to_pylist()]
    assert "2 samples lost" in texts


def test_a_run_of_another_rate_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    run = made.comparisons()[0].run
    with pytest.raises(WorkError, match=r"step-kp2: sampled at 200 Hz, rig sflr at 500 Hz"):
        write_recording(tmp_path / "x.rrd", [replace(run, t=2.5 * run.t)], RIG)
    assert list(tmp_path.iterdir()) == []


def test_each_run_that_has_them_brings_its_frequency_responses(tmp_path: Path) -> None:
    import rerun.chunk

    moved = made.comparisons()[0].run
    still = replace(moved, name="still", command=0.0 * moved.command, reference=0.0 * moved.reference)
    path = tmp_path / "bode.rrd"
    write_recording(path, [moved, still], RIG)
    pictures = {str(chunk.entity_path): chunk.to_record_batch()["EncodedImage:blob"].to_pylist()
                for chunk in rerun.chunk.RrdReader(path).stream()
                if chunk.is_static and str(chunk.entity_path).endswith("/bode")}
    assert set(pictures) == {"/run_1/bode"}
    assert bytes(pictures["/run_1/bode"][0][0]).startswith(b"\x89PNG")


def test_a_response_is_drawn_in_the_colours_of_its_account() -> None:
    import io

    from matplotlib.image import imread

    compared = made.comparisons()[0]
    other = replace(compared.run, encoder=compared.before.encoder, command=compared.before.command)
    pixels = imread(io.BytesIO(same_test_picture({"measured": compared.run, "nominal": other},
                                                 {"measured": "#ff0000", "nominal": "#0000ff"})), format="png")
    for colour in ([1, 0, 0], [0, 0, 1]):
        assert np.all(np.abs(pixels[..., :3] - colour) < 0.01, axis=-1).sum() > 500


def test_a_rigid_axis_without_accelerometer_is_drawn_straight(tmp_path: Path) -> None:
    axis = Rig.from_toml("""name = "axis"
sample_rate = 500.0
amplifier = { limit = 200.0 }
motor = { inertia = 0.01, damping = 0.1, gain = 0.01 }
encoder = { counts_per_revolution = 1024 }""")
    bare = replace(made.comparisons()[0].run, accel=None)
    path = tmp_path / "axis.rrd"
    write_recording(path, [bare], axis)
    found = chunks(path)
    assert "/run_1/arm/nominal/beam" in found and "/run_1/acceleration/measured" not in found


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkError, match=r"x\.rrd: cannot be written: no such folder"):
        write_recording(tmp_path / "nowhere" / "x.rrd", made.comparisons()[:1], RIG)


def test_the_arm_estimated_from_its_sensors_bends_as_the_simulated_one() -> None:
    t = np.arange(800) / 500.0
    reference = np.where(t < 0.2, 0.0, 50.0)
    run = Run("step", t, reference, 0 * t, 0 * t, 0 * t, RunMetadata(controller={"kind": "p", "gain": 2.0}))
    made_up = simulate(RIG, run, rounding=False, states=True, accel_offset=37.0)
    assert made_up.shape is not None and made_up.accel is not None and RIG.beam is not None
    angle = made_up.encoder * RIG.angle_per_count
    true = made_up.shape[:, -1] - angle * RIG.beam.length
    guess = arm.estimated_shape(RIG, angle, made_up.accel, 500.0)[:, -1]
    assert np.abs(true).max() > 0.02
    assert np.linalg.norm(guess - true) < 0.2 * np.linalg.norm(true)


def test_a_device_in_virtual_time_waits_and_is_never_answered_late() -> None:
    t, still = np.arange(50) / 500.0, np.zeros(50)
    slack = np.where(t == t[9], -0.002, 0.001)
    for virtual, late in ((True, 0), (False, 1)):
        run = Run("r", t, still, still, still, slack=slack,
                  metadata=RunMetadata(firmware={"virtual_time": virtual}))
        assert len(find_events(run, 200.0)) == late


def test_drawn_points_turn_with_the_base_and_exaggerate_the_bend_alone() -> None:
    points = arm.drawn_points(np.array([0.0, np.pi / 2]), np.array([[0.0, 0.01], [0.0, 0.01]]), 0.4, 3.0, height=0.1)
    assert points[0].tolist() == [[0.0, 0.0, 0.1], [0.4, 0.03, 0.1]]
    assert points[1, 1] == pytest.approx([-0.03, 0.4, 0.1])


def test_events_tell_saturation_sticking_late_and_lost_samples() -> None:
    n = 200
    command, encoder = np.full(n, 50.0), np.arange(n, dtype=float)
    command[10:20], encoder[100:160] = 200.0, 100.0
    slack, index, status = np.full(n, 1e-3), np.arange(n), np.zeros(n, dtype=np.int64)
    slack[30], status[40] = -0.002, 4
    index[150:] += 3
    run = Run("bad", index / 500.0, 0 * command, command, encoder, n=index, slack=slack, status=status)
    found = [(event.row, event.text) for event in find_events(run, 200.0, {4: "command held"})]
    assert found == [(10, "command at its limit of 200 counts for 20 ms"), (30, "answered 2.0 ms late"),
                     (40, "device says: command held"),
                     (101, "arm stands still for 118 ms, command up to 50 counts"), (150, "3 samples lost")]

"""Every command on rigs that lack parts, down to a rigid axis with an encoder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from station.rig import Rig, load_rig
from station.runs import load_run
from tests.truth import RIGID_AXIS, SFLR, TWO_MASS


def without(*parts: str) -> Rig:
    """The arm without some of its tables."""
    kept = {key: value for key, value in SFLR.items() if key not in parts}
    sigmas = {key: value for key, value in SFLR["uncertainty"].items() if key.split(".")[0] not in parts}
    return Rig.model_validate(kept | {"name": f"without-{parts[0]}", "uncertainty": sigmas})


RIGS = {"axis": Rig.model_validate(RIGID_AXIS), "two-mass": Rig.model_validate(TWO_MASS),
        "no-drive": without("drive"), "no-clamp": without("clamp"), "no-accelerometer": without("accelerometer"),
        "no-beam": without("beam", "clamp", "tip", "accelerometer")}
LONG = "no-drive", "no-clamp", "no-accelerometer", "no-beam"
"""Between the arm and a two-mass rig."""


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in RIGS])
def rig(request, tmp_path, monkeypatch) -> Rig:
    """A rig, as rig.toml in the current folder."""
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIGS[request.param].to_toml(), encoding="utf-8")
    return RIGS[request.param]


def test_every_command_works(station, rig):
    """Tests through the device, then all that is done with their logs; nothing warns."""
    def done(line: str) -> str:
        ended = station(*line.split())
        assert ended.status == 0 and "Warning" not in ended.err, (line, ended.err)
        return ended.out

    port = "--port sim://x?rig=rig.toml&noise=0.3&seed=1 --rig rig.toml"
    assert "Passed" in done(f"check {port} --amplitude 60")
    assert "Good" in done("loopback --port sim://x?rig=rig.toml --seconds 0.1")
    done(f"run step {port} --amplitude 60 --duration 1 --out step.mcap")
    done(f"run pulse {port} --amplitude 60 --duration 1 --out pulse.mcap")
    done(f"run sweep {port} --amplitude 40 --duration 9 --out sweep.mcap")
    done("replay step.mcap")
    done("simulate --rig rig.toml --like step.mcap --out simulated.csv")
    made = load_run("simulated.csv")
    assert (made.accel is None) == (rig.accelerometer is None)
    np.testing.assert_allclose(made.encoder, load_run("step.mcap").encoder, atol=1.0)
    found = json.loads(done("compare --rig rig.toml step.mcap pulse.mcap --json -"))["runs"]
    assert all(run["encoder"]["nrmse"] < 0.02 for run in found)
    assert all(("accel" in run) == (rig.accelerometer is not None) for run in found)
    done("bode --rig rig.toml --run sweep.mcap --out bode.svg")
    done("view step.mcap pulse.mcap --save view.rrd")
    for form in ("csv", "parquet", "mat", "rrd"):
        done(f"export step.mcap --out step.{form}")
    done("import step.csv --rig rig.toml --out again.mcap")
    done("fit --rig rig.toml step.mcap pulse.mcap --starts 1 --save-rig fitted.toml")
    assert set(load_rig("fitted.toml").constants()) == set(rig.constants())


def test_a_controller_that_reads_a_sensor_which_the_rig_has_not_is_refused(station, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIGS["no-accelerometer"].to_toml(), encoding="utf-8")
    made = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--controller", "lead-accel", "--duration",
                   "1", "--out", "step.mcap")
    assert made.status == 0
    for line in ("compare --rig rig.toml step.mcap", "simulate --rig rig.toml --like step.mcap --out out.csv",
                 "diagnose --rig rig.toml step.mcap"):
        ended = station(*line.split())
        assert ended.status == 1 and ended.one_line().startswith("station: step")
        assert "its controller reads an accelerometer, and rig without-accelerometer has none" in ended.err
    assert not Path("out.csv").exists()


def test_a_sweep_that_nothing_answers_has_no_response(station, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    held = RIGS["axis"].with_constants({"motor.gain": 1e-9})
    Path("held.toml").write_text(held.to_toml(), encoding="utf-8")
    station("run", "sweep", "--port", "sim://x?rig=held.toml", "--rig", "held.toml", "--duration", "9",
            "--out", "s.mcap")
    ended = station("bode", "--rig", "held.toml", "--run", "s.mcap", "--out", "b.svg")
    assert ended.status == 1 and "the encoder never moves" in ended.one_line()

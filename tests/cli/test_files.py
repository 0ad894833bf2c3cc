"""Import, export, list, rescue and replay from the command line."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from station.runs import load_run


@pytest.mark.parametrize("form", ["mcap", "csv", "parquet", "mat"])
def test_export_and_import_keep_the_columns(station, step, tmp_path, form):
    there, back = tmp_path / f"there.{form}", tmp_path / "back.csv"
    assert station("export", step, "--out", there).status == 0
    assert station("import", there, "--out", back).status == 0
    before, after = load_run(step), load_run(back)
    for name, values in before.columns().items():
        assert (after.columns()[name] == values).all(), name
    assert after.metadata.controller == before.metadata.controller


def test_import_adds_what_the_log_does_not_say(station, step, tmp_path):
    out = tmp_path / "named.mcap"
    assert station("import", step, "--rig", "sflr-unit", "--zero-id", "bench", "--out", out).status == 0
    assert load_run(out).metadata.zero_id == "bench"
    assert load_run(out).metadata.rig["name"] == "sflr-unit"


@pytest.mark.parametrize(("line", "told"), [
    ('{"kind": "pid", "Kp": 3, "Ki": 12}', "controller.Ki, controller.Kp: unknown key for kind 'pid'"),
    ('{"kind": "PI", "gain": 3}', "controller.kind: 'PI' is none of"), ('{"kind": "p", "gain": 3}', ""), (None, "")])
def test_an_import_keeps_a_controller_that_is_none_and_says_so(station, tmp_path, line, told):
    source, out = tmp_path / "other.csv", tmp_path / "other.mcap"
    rows = "\n".join(f"{k / 500},{k},0,0" for k in range(4))
    source.write_text((f"# controller = {line}\n" if line else "") + f"t,reference,command,encoder\n{rows}\n")
    ended = station("import", source, "--out", out)
    assert ended.status == 0 and (told in ended.err if told else "controller" not in ended.err), ended.err
    assert load_run(out).metadata.controller == (json.loads(line) if line else {"kind": "unknown"})


def test_an_output_in_the_way_is_kept(station, step, tmp_path):
    out = tmp_path / "kept.csv"
    out.write_text("mine")
    assert station("export", step, "--out", out).status == 1
    assert out.read_text() == "mine"
    assert station("export", step, "--out", out, "--overwrite").status == 0
    assert load_run(out).metadata.zero_id == "made"


def test_runs_lists_good_and_unreadable_files(station, step, tmp_path):
    (tmp_path / "broken.csv").write_text("t,reference\nnonsense")
    ended = station("runs", tmp_path)
    assert ended.status == 0 and "step.csv" in ended.out and "broken.csv" in ended.out
    listed = json.loads(station("runs", tmp_path, "--json", "-").out)["runs"]
    assert {item["file"] for item in listed if "problem" in item} == {"broken.csv"}
    assert [item["test"]["kind"] for item in listed if "test" in item] == ["step"]


def test_replay_finds_the_logged_commands_and_a_changed_one(station, step, tmp_path):
    found = json.loads(station("replay", step, "--json", "-").out)["runs"][0]
    assert found["same"] and found["max_abs_difference"] <= 1e-3
    lines = step.read_text().splitlines()
    cells = lines[-1].split(",")
    cells[2] = str(float(cells[2]) + 1.0)
    other = tmp_path / "changed.csv"
    other.write_text("\n".join([*lines[:-1], ",".join(cells)]) + "\n")
    found = json.loads(station("replay", other, "--json", "-").out)["runs"][0]
    assert not found["same"] and found["row"] == 299 and found["max_abs_difference"] == pytest.approx(1.0)


def test_recover_completes_a_log_cut_short(station, step, tmp_path):
    whole, cut, out = tmp_path / "whole.mcap", tmp_path / "cut.mcap", tmp_path / "out.mcap"
    station("export", step, "--out", whole)
    cut.write_bytes(whole.read_bytes()[:-200])
    before = cut.read_bytes()
    ended = station("recover", cut, "--out", out)
    assert ended.status == 0, ended.err
    assert cut.read_bytes() == before
    assert len(load_run(out)) > 0


def test_replay_shows_measured_against_a_model(station, step, tmp_path):
    ended = station("replay", step, "--model", "sflr", "--json", "-")
    (found,) = json.loads(ended.out)["runs"]
    assert found["same"] and found["model"]["encoder"]["nrmse"] < 0.02
    ended = station("replay", step, "--model", "sflr", "--controller", "lead", "--save", tmp_path / "shown.rrd")
    assert ended.status == 0, ended.err
    assert "as lead would have had it" in ended.out and "overshoot percent" in ended.out
    assert (tmp_path / "shown.rrd").stat().st_size > 10_000
    other = json.loads(station("replay", step, "--model", "sflr", "--controller", "lead", "--json", "-").out)
    assert other["runs"][0]["model"]["encoder"]["nrmse"] > 0.1 and not other["runs"][0]["same"]


def test_a_logged_run_is_a_device_at_full_and_at_real_speed(station, tmp_path):
    out = tmp_path / "run.mcap"
    assert station("run", "step", "--port", "sim://sflr?seed=2", "--rig", "sflr", "--duration", "0.6", "--out",
                   out).status == 0
    first = load_run(out)
    again = tmp_path / "again.mcap"
    assert station("run", "step", "--port", f"replay://{out}", "--rig", "sflr", "--duration", "0.6", "--out",
                   again).status == 0
    np.testing.assert_array_equal(load_run(again).encoder, first.encoder)
    for attempt in range(5):  # a busy machine may fault a device that is paced
        real = tmp_path / f"real{attempt}.mcap"
        begun = time.monotonic()
        ended = station("run", "step", "--port", f"replay://{out}?speed=1", "--rig", "sflr", "--duration", "0.6",
                        "--out", real)
        if ended.status == 0:
            break
    assert ended.status == 0, ended.err
    assert time.monotonic() - begun > 0.6
    np.testing.assert_array_equal(load_run(real).encoder, first.encoder)

"""`station campaign` as a user gives it."""

from __future__ import annotations

import json
import os

import pytest

from tests.estimation.made import AXIS, run_of

PLAN = """
effort = "quick"
[blind]
rig = "axis.toml"
cases = 1
first_seed = 3
clean = 0.0
pairs = 0.0
effects = ["dead_zone"]
[[logs]]
name = "quiet bench"
rig = "axis.toml"
runs = ["runs/*.csv"]
known = []
"""


def test_a_plan_of_two_cases_becomes_a_page_and_is_not_done_twice(station, tmp_path):
    from station.runs import export_run

    (tmp_path / "axis.toml").write_text(AXIS.to_toml(), encoding="utf-8")
    (tmp_path / "runs").mkdir()
    for amplitude in (50.0, 80.0):
        export_run(run_of(AXIS, amplitude, "p2", "step"), tmp_path / "runs" / f"step{amplitude:.0f}.csv")
    plan, out = tmp_path / "plan.toml", tmp_path / "out"
    plan.write_text(PLAN, encoding="utf-8")
    before = {path for path in tmp_path.rglob("*") if out not in path.parents}
    ended = station("campaign", plan, "--out", out, "--workers", 1, "--json", tmp_path / "summary.json")
    assert ended.status == 0, ended.err
    found = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert found["cases"] == 2 and found == json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert found["shares"]["single causes named first"]["count"] == 1
    assert found["shares"]["clean rigs accused"] == {**found["shares"]["clean rigs accused"], "count": 0, "of": 1}
    assert "quiet bench" in (out / "report.html").read_text(encoding="utf-8")
    assert {path.name for path in out.iterdir()} == {"cases", "summary.json", "report.html"}
    assert {path for path in tmp_path.rglob("*") if out not in path.parents} - before == {
        out, tmp_path / "summary.json"}
    files = {path: path.stat().st_mtime_ns for path in (out / "cases").iterdir()}
    again = station("campaign", plan, "--out", out)
    assert again.status == 0 and "2 of them done before" in again.err
    assert {path: path.stat().st_mtime_ns for path in (out / "cases").iterdir()} == files


def test_a_case_that_fails_is_told_and_the_others_stand(station, tmp_path):
    (tmp_path / "broken.csv").write_text("this is no run\n", encoding="utf-8")
    plan = tmp_path / "plan.toml"
    plan.write_text('[[logs]]\nname = "x"\nrig = "sflr"\nruns = ["broken.csv"]\n', encoding="utf-8")
    ended = station("campaign", plan, "--out", tmp_path / "out", "--workers", 1)
    assert ended.status == 1 and "broken.csv" in ended.err.splitlines()[-1]
    assert "Traceback" not in ended.err
    assert json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["failed"]


@pytest.mark.parametrize(("options", "status", "said"), [
    (["--scheduler", "nowhere"], 2, "--scheduler"),
    (["--scheduler", "tls://host:1"], 2, "--tls-ca"),
    (["--tls-ca", "ca.pem"], 2, "of use with --scheduler"),
    (["--workers", "0"], 2, "--workers"),
    (["--effort", "heroic"], 2, "--effort")])
def test_wrong_use_is_one_line(station, tmp_path, options, status, said):
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN, encoding="utf-8")
    ended = station("campaign", plan, "--out", tmp_path / "out", *options)
    assert ended.status == status and said in ended.one_line()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["summary.json", "report.html"])
def test_what_no_campaign_made_is_not_replaced(station, tmp_path, name):
    plan, mine = tmp_path / "plan.toml", tmp_path / "out" / name
    plan.write_text(PLAN.replace("axis.toml", "sflr").partition("[[logs]]")[0], encoding="utf-8")
    mine.parent.mkdir()
    mine.write_text("{}", encoding="utf-8")
    ended = station("campaign", plan, "--out", mine.parent)
    assert ended.status == 1 and f"{mine}: no campaign made it" in ended.one_line()
    assert mine.read_text(encoding="utf-8") == "{}" and list(mine.parent.iterdir()) == [mine]


def test_a_plan_that_is_wrong_writes_nothing(station, tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text(f'[blind]\ncases = 1\nimport = "{os.sep}tmp"\n', encoding="utf-8")
    ended = station("campaign", plan, "--out", tmp_path / "out")
    assert ended.status == 2 and "blind.import: unknown key" in ended.one_line()
    assert list(tmp_path.iterdir()) == [plan]

"""`station run --plan` on the simulated rig: stopped anywhere, the same command goes on and nothing is lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from station.runs import load_run

PLAN = """
name = "day"
repeats = 2
order = "random"
seed = 2
[[test]]
kind = "step"
amplitude = 40
duration = 0.8
[[test]]
kind = "pulse"
amplitude = 50
duration = 0.8
"""
PORT = "sim://sflr?noise=1&seed=3"


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.toml"
    path.write_text(PLAN)
    return path


def go(station, plan: Path, port: str = PORT, *more: str):
    return station("run", "--plan", plan, "--port", port, "--rig", "sflr", "--out", plan.parent / "out", *more)


def test_all_tests_are_run_and_their_table_shows_the_scatter_between_repeats(station, plan):
    ended = go(station, plan)
    assert ended.status == 0, ended.err
    runs = {path.stem: load_run(path) for path in (plan.parent / "out").glob("*.mcap")}
    assert set(runs) == {f"{test}-r{n}" for test in ("01-step-p-40", "02-pulse-open-50") for n in (1, 2)}
    for run in runs.values():
        known = run.metadata.entries()
        assert known["outcome"] == "complete" and known["plan"].startswith("day.") and known["seed"] == 2
    said = json.loads((plan.parent / "out" / "results.json").read_text())
    step, pulse = said["tests"]
    assert step["scatter"]["overshoot"]["repeats"] == 2 and step["scatter"]["overshoot"]["mean"] > 5.0
    assert pulse["scatter"]["overshoot"]["mean"] is None
    assert 0.3 < step["repeatability"]["accel"] < 3.0  # the noise is one count
    assert "step-p-40" in ended.out and "2 of 2" in ended.out and "±" in ended.out


def test_it_goes_on_where_it_stopped_and_keeps_what_ended_early(station, plan, monkeypatch):
    from station.cli import plan as module

    perform, calls = module.perform, []

    def breaks(line, *others, **settings):
        calls.append(settings["metadata"]["place"])
        if len(calls) == 3:
            device = line.serial.device
            device._session_ticks, device.options.faults.__dict__["unplug_after"] = 0, 200
        return perform(line, *others, **settings)

    monkeypatch.setattr(module, "perform", breaks)
    ended = go(station, plan)
    assert ended.status == 1 and "2 of 4 runs are made; the same command goes on from here" in ended.err
    assert calls == [1, 2, 3]
    made = {path.name for path in (plan.parent / "out").glob("*.mcap")}
    assert len(made) == 3
    ended = go(station, plan)
    assert ended.status == 0, ended.err
    assert calls == [1, 2, 3, 3, 4] and "2 of them made already" in ended.out
    kept = [path for path in (plan.parent / "out").glob("*.mcap") if ".early1" in path.name]
    assert len(kept) == 1 and len(load_run(kept[0])) == 200
    assert len(list((plan.parent / "out").glob("*.mcap"))) == 5
    calls.clear()
    assert go(station, plan).status == 0 and calls == []


def test_runs_of_another_text_of_the_plan_are_never_mixed(station, plan):
    assert go(station, plan).status == 0
    plan.write_text(PLAN.replace("amplitude = 40", "amplitude = 40.0"))
    ended = go(station, plan)
    assert ended.status == 2 and "another plan" in ended.one_line()


@pytest.mark.parametrize("text", ["mine", '{"plan": "other.0123456789abcdef"}', "[]"])
def test_a_table_that_is_not_this_plans_is_not_replaced(station, plan, text):
    table = plan.parent / "out" / "results.json"
    table.parent.mkdir()
    table.write_text(text)
    ended = go(station, plan)
    assert ended.status == 2 and f"{table}: of another plan" in ended.one_line()
    assert table.read_text() == text and list(table.parent.iterdir()) == [table]


def test_an_arm_that_has_wandered_off_stops_the_plan(station, plan):
    plan.write_text("rest_within = 5\n" + PLAN)
    ended = go(station, plan)
    assert ended.status == 1
    assert "rest_within is 5; bring it back, then give the same command again" in ended.err


@pytest.mark.parametrize(("options", "named"), [
    (["--plan", "none.toml", "--port", "sim://sflr", "--rig", "sflr", "--out", "x"], "none.toml"),
    (["--plan", "none.toml", "--rig", "sflr", "--out", "x"], "--port"),
    ([], "--plan"),
    (["--port", "sim://sflr", "step", "--rig", "sflr", "--out", "x.mcap"], "behind its kind"),
])
def test_a_plan_that_is_asked_for_wrongly(station, options, named):
    ended = station("run", *options)
    assert ended.status == 2 and named in ended.one_line()

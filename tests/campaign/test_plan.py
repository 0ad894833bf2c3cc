"""Plan files: what they give, and one line for everything that is wrong with one."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from station.campaign import logs, simulated
from station.campaign.order import by_share, in_turn
from station.campaign.plan import load_tasks
from station.errors import UsageError, WorkError
from station.model.effects import effect_class
from station.rig import builtin_rigs, load_rig
from tests.truth import RIGID_AXIS

BLIND = '[blind]\ncases = 40\nfirst_seed = 7\nclean = 0.25\npairs = 0.25\neffects = ["dead_zone", "coulomb_friction"]\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a rig and two files for runs."""
    (tmp_path / "rig.toml").write_text(builtin_rigs()["sflr"])
    (tmp_path / "runs").mkdir()
    for name in ("a.csv", "b.csv"):
        (tmp_path / "runs" / name).write_text("t,reference\n")
    return tmp_path


def plan(folder: Path, text: str) -> Path:
    path = folder / "plan.toml"
    path.write_text(text)
    return path


def test_blind_cases_are_in_their_shares_and_each_has_a_seed(folder):
    tasks = load_tasks(plan(folder, BLIND))
    assert Counter(task.group for task in tasks) == {"single": 20, "clean": 10, "pair": 10}
    assert [task.spec["seed"] for task in tasks] == list(range(7, 47))
    assert len({task.label for task in tasks}) == 40
    singles = Counter(tuple(task.spec["hidden"][0]) for task in tasks if task.group == "single")
    assert set(singles) == {("dead_zone", "amplifier"), ("coulomb_friction", "motor"), ("coulomb_friction", "base")}
    assert max(singles.values()) - min(singles.values()) <= 1
    assert all(len({name for name, _ in task.spec["hidden"]}) == 2 for task in tasks if task.group == "pair")
    assert tasks == load_tasks(folder / "plan.toml"), "the same file gives the same cases"


def test_a_longer_plan_begins_with_the_cases_of_a_shorter_one(folder):
    short = load_tasks(plan(folder, BLIND))
    long = load_tasks(plan(folder, BLIND.replace("cases = 40", "cases = 60")))
    assert long[:40] == short


def test_logs_are_found_beside_the_plan_and_known_by_their_content(folder):
    text = '[[logs]]\nname = "bench"\nrig = "rig.toml"\nruns = ["runs/*.csv", "runs/a.csv"]\n'
    [task] = load_tasks(plan(folder, text))
    assert [Path(run["path"]).name for run in task.spec["runs"]] == ["a.csv", "b.csv"]
    assert task.spec["known"] is None and task.spec["effort"] == "full"
    known = 'known = [{effect = "parameter:tip.mass", parameters = {value = 0.02}}]\neffort = "quick"\n'
    [task] = load_tasks(plan(folder, text + known))
    assert task.spec["known"] == [{"effect": "parameter:tip.mass", "at": "", "value": 0.02}]
    assert task.spec["effort"] == "quick" and load_tasks(folder / "plan.toml", "full")[0].spec["effort"] == "full"
    assert load_tasks(plan(folder, text + "known = []\n"))[0].spec["known"] == []
    (folder / "runs" / "a.csv").write_text("t\n")
    with pytest.raises(WorkError, match=r"a\.csv: changed since the campaign began"):
        logs.case(task)


LOGS = '[[logs]]\nname = "x"\nrig = "sflr"\nruns = ["runs/*.csv"]\n'
WRONG = {
    "": "nothing to do",
    "x = ": "not TOML",
    "colour = 1\n" + BLIND: "colour: unknown key",
    BLIND.replace("cases = 40", "cases = 0"): "blind.cases",
    BLIND.replace("cases = 40", 'cases = "many"'): "blind.cases",
    BLIND.replace("cases = 40", 'cases = "40"'): "blind.cases: .*integer without quotes, not '40'",
    BLIND.replace("clean = 0.25", "clean = true"): "blind.clean: .*number, not True",
    BLIND.replace("cases = 40\n", ""): "blind.cases: missing",
    BLIND + "seed = 3\n": "blind.seed: unknown key",
    BLIND.replace("0.25", "0.75"): "blind: clean and pairs",
    BLIND.replace("clean = 0.25", "clean = nan"): "blind.clean",
    BLIND.replace("dead_zone", "dead_zoo"): "blind.effects.0: 'dead_zoo' is none of",
    BLIND.replace("dead_zone", "dead_zone@base"): "blind.effects.0",
    BLIND.replace("dead_zone", "clock_scale"): "blind.effects.0",
    BLIND.replace(', "coulomb_friction"', ""): "blind.pairs: a pair wants two effects",
    BLIND + 'rig = "none.toml"\n': "blind.rig",
    BLIND + 'effort = "heroic"\n': "blind.effort",
    LOGS.replace("runs/*.csv", "runs/*.mcap"): "logs.0.runs.0: no file matches",
    LOGS.replace("runs/*.csv", "runs"): "logs.0.runs.0: no file matches",
    LOGS.replace("sflr", "none"): "logs.0.rig",
    LOGS.replace('"sflr"', "3"): "logs.0.rig",
    LOGS.replace('name = "x"\n', ""): "logs.0.name: missing",
    LOGS + LOGS: "logs: two entries are named 'x'",
    LOGS + 'known = [{effect = "dead_zone"}]\n': "logs.0.known.0: rig sflr has no dead_zone; .* dead_zone@amplifier",
    LOGS + 'known = [{effect = "parameter:tip.colour"}]\n': "logs.0.known.0",
    LOGS + 'command = "rm -rf /"\n': "logs.0.command: unknown key",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_told_in_one_line_that_names_file_and_key(folder, text):
    with pytest.raises(UsageError, match=WRONG[text]) as raised:
        load_tasks(plan(folder, text))
    assert str(raised.value).startswith(str(folder / "plan.toml")) and "\n" not in str(raised.value)


def test_the_plan_of_the_docs_is_one(folder):
    page = (Path(__file__).resolve().parents[2] / "docs" / "campaign.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    for name in ("rigs/a.toml", "rigs/b.toml", "logs/a/1.mcap", "logs/a-extra.csv", "logs/b/1.mcap"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(builtin_rigs()["sflr"])
    assert Counter(task.group for task in load_tasks(plan(folder, text))) == {
        "single": 35, "clean": 10, "pair": 5, "logs": 2}


def test_a_plan_that_is_not_there_is_told_in_one_line(tmp_path):
    with pytest.raises(UsageError, match=r"none\.toml"):
        load_tasks(tmp_path / "none.toml")
    (tmp_path / "huge.toml").write_bytes(b"#" * (1 << 20) + b"\n")
    with pytest.raises(UsageError, match="1 MiB"):
        load_tasks(tmp_path / "huge.toml")


def test_shares_hold_from_the_first_case_on():
    names = by_share({"a": 3.0, "b": 1.0, "c": 0.0})
    first = [next(names) for _ in range(40)]
    assert Counter(first) == {"a": 30, "b": 10}
    assert all(abs(first[:n].count("b") - n / 4) <= 1 for n in range(1, 41))
    turn = in_turn("abc", np.random.default_rng(1))
    assert Counter(next(turn) for _ in range(31)).most_common()[-1][1] >= 10


def test_tests_that_a_rig_cannot_do_are_left_out(tmp_path):
    (tmp_path / "axis.toml").write_text(load_rig("sflr").model_validate(RIGID_AXIS).to_toml())
    assert len(simulated.suited(load_rig(tmp_path / "axis.toml"))) >= 3
    backwards = load_rig("sflr").with_constants({"motor.gain": -0.01})
    with pytest.raises(UsageError, match="suit it"):
        simulated.suited(backwards)


def test_the_simulated_rig_is_read_in_whole_counts_with_noise_and_offset():
    rig = load_rig("sflr").with_effects([effect_class("accelerometer_saturation")(at="accelerometer", limit=6.0)])
    test = simulated.planned(rig)[2]
    run = simulated.measured(rig, test, np.random.default_rng(1), 1.5, 0.0)
    assert np.all(run.encoder == np.round(run.encoder)) and np.all(run.accel == np.round(run.accel))
    assert np.max(np.abs(run.accel)) == 6.0 and abs(run.accel[:100].mean() - 1.5) < 0.3
    assert abs(run.encoder[-200:].mean() - 50.0) < 5.0

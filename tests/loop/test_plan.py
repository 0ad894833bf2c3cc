"""A plan is checked as a whole before anything moves, laid out the same way every time, and resumed by its files."""

import numpy as np
import pytest

from station.errors import UsageError
from station.loop.plan import load_plan, tightened
from station.rig import Limits, load_rig
from station.runs import export_run
from tests.cli.conftest import step_run

RIG = load_rig("sflr")
NAMED = {"lead": {"kind": "lead", "gain": 20.0, "zero": 31.4, "pole": 125.7}, "p": {"kind": "p", "gain": 2.0},
         "open": {"kind": "open"}}
PLAN = """
name = "day"
repeats = 3
order = "random"
seed = 5
[[test]]
kind = "step"
controller = "lead"
amplitude = 50
[[test]]
kind = "pulse"
repeats = 1
[[test]]
kind = "sweep"
spacing = "log"
f0 = 1.0
controller = { kind = "p", gain = 1.0 }
"""


def controller_of(name, folder):
    if name not in NAMED:
        raise UsageError(f"controller {name}: unknown")
    return NAMED[name]


@pytest.fixture
def read(tmp_path):
    def plan(text, rig=RIG):
        path = tmp_path / "plan.toml"
        path.write_text(text)
        return load_plan(path, rig, controller_of)
    return plan


def laid_out(plan):
    return [(trial.index, trial.repeat) for trial in plan.trials]


def test_a_plan_is_every_test_as_often_as_it_says(read):
    plan = read(PLAN)
    assert sorted(laid_out(plan)) == [(1, 1), (1, 2), (1, 3), (2, 1), (3, 1), (3, 2), (3, 3)]
    names = {trial.file_name for trial in plan.trials}
    assert {"01-step-lead-50-r1.mcap", "02-pulse-open-r1.mcap", "03-sweep-p-r3.mcap"} <= names
    assert len(names) == len(plan.trials)
    assert all(np.all(trial.reference[:100] == 0.0) for trial in plan.trials)


def test_its_order_is_its_seeds_and_no_test_depends_on_it(read):
    one, again, other = read(PLAN), read(PLAN), read(PLAN.replace("seed = 5", "seed = 6"))
    written = read(PLAN.replace('"random"', '"written"'))
    assert laid_out(one) == laid_out(again) != laid_out(other)
    assert laid_out(written) == [(1, 1), (2, 1), (3, 1), (1, 2), (3, 2), (1, 3), (3, 3)]
    assert {t.file_name for t in one.trials} == {t.file_name for t in written.trials}


def test_repeats_of_one_test_are_found_by_their_metadata(read):
    plan = read(PLAN)
    said = [plan.metadata(trial, home=7, place=i) for i, trial in enumerate(plan.trials, start=1)]
    steps = [each for each in said if (each["plan"], each["test_index"]) == (plan.identity, 1)]
    assert [each["test"] for each in steps] == [{"kind": "step", "amplitude": 50}] * 3
    assert {each["repeat"] for each in steps} == {1, 2, 3}
    assert all(each["home"] == 7 and each["seed"] == 5 for each in said)


@pytest.mark.parametrize(("change", "words"), [
    (("repeats = 3", "repeat = 3"), r"plan.toml: repeat: unknown key"),
    (("repeats = 3", "repeats = 0"), r"plan.toml: repeats: "),
    (('"random"', '"backwards"'), r"plan.toml: order: "),
    (("amplitude = 50", "amplitud = 50"), r"plan.toml: test 1: test.amplitud: unknown key"),
    (('"sweep"', '"swep"'), r"plan.toml: test 3: test.kind: 'swep'"),
    (('"lead"', '"magic"'), r"plan.toml: test 1: controller magic"),
    (("gain = 1.0", "gian = 1.0"), r"test 3: controller.gian: unknown key for kind 'p'; controller.gain: missing"),
    (("repeats = 3", 'repeats = "3"'), r"plan.toml: repeats: .*integer without quotes, not '3'"),
    (("seed = 5", "seed = 5\nsettle = true"), r"plan.toml: settle: .*number, not True"),
    (("seed = 5", 'seed = 5\ntags = ["a", "b,c"]'), r"plan.toml: test 1: tags: 'b,c': 1 to 40 letters"),
    (("seed = 5", 'seed = 5\ntags = ["a", 1]'), r"plan.toml: tags.1: .*string, not 1"),
    (("gain = 1.0", 'gain = "1.0"'), r"plan.toml: test 3: controller.gain: a number or a list .* not '1.0'"),
    (('kind = "pulse"', 'kind = "recorded"\nfile = "none.mcap"'), r"test 2: test.file: .*none.mcap: no such file"),
    (('kind = "pulse"', 'kind = "step"\ncontroller = "lead"\namplitude = 50'), r"two tests are named step-lead-50"),
    (("[[test]]", "[[tests]]"), r"plan.toml: "),
    (("name =", "name"), r"plan.toml: not TOML"),
])
def test_what_is_wrong_with_a_plan_is_named(read, change, words):
    with pytest.raises(UsageError, match=words) as told:
        read(PLAN.replace(*change, 1))
    assert "\n" not in str(told.value)


def test_limits_of_a_plan_tighten_the_rigs_and_never_loosen_them(read):
    rig = RIG.model_copy(update={"limits": Limits(travel=2.0, command=150.0)})
    assert tightened(rig, Limits(travel=3.0, speed=9.0, command=100.0)) == Limits(travel=2.0, speed=9.0, command=100.0)
    limited = PLAN.replace("seed = 5", "seed = 5\n[limits]\ntravel = 0.2")
    with pytest.raises(UsageError, match=r"test 1: test.amplitude: a reference 0.3068 rad .*limits.travel = 0.2"):
        read(limited)
    with pytest.raises(UsageError, match=r"test 2: .*limits.command = 80"):
        read(PLAN.replace("seed = 5", "seed = 5\n[limits]\ncommand = 80"))


def test_a_recorded_reference_is_that_of_the_run_with_a_rest_before_it(read, tmp_path):
    run = step_run(rows=300)  # 20 rows at rest
    export_run(run, tmp_path / "old.csv")
    plan = read('[[test]]\nkind = "recorded"\nfile = "old.csv"\n'
                '[[test]]\nkind = "recorded"\nname = "open"\nfile = "old.csv"\ncontroller = "open"\n')
    closed, opened = plan.trials
    assert len(closed.reference) == 300 + 80
    np.testing.assert_array_equal(closed.reference[80:], run.reference)
    rest = int(np.argmax(run.command != 0.0))
    np.testing.assert_array_equal(opened.reference[max(100 - rest, 0):], run.command)
    assert closed.test["kind"] == "recorded" and len(closed.test["file_sha256"]) == 64
    with pytest.raises(UsageError, match=r"500 Hz, the rig runs at 250 Hz"):
        read('[[test]]\nkind = "recorded"\nfile = "old.csv"\n', RIG.model_copy(update={"sample_rate": 250.0}))

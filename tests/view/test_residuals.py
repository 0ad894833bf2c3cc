"""Residuals one sample ahead: noise on the right rig, the command's shadow on a wrong one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.diagnose.result import DiagnosisResult, RunComparison
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.rig import Rig, load_rig
from station.runs.run import HELD, Run, RunMetadata
from station.view import remaining
from station.view.report import report_html
from station.view.residuals import Residual, residuals
from tests.view import made
from tests.view.test_report import Page

RIG = load_rig("sflr")
LATE = RIG.with_effects([effect_class("input_delay")(at="amplifier", time=0.012)])
SIGMA = 2.0


def runs(rig: Rig) -> list[Run]:
    """Closed-loop sweeps with accelerometer noise."""
    t = np.arange(1500) / rig.sample_rate
    found = []
    for k in range(2):
        since = np.maximum(t - 0.3, 0.0)
        reference = np.round((60.0 + 20.0 * k) * np.sin(2.0 * np.pi * (0.4 + 2.0 * since) * since))
        about = RunMetadata(rig=rig.name, controller={"kind": "p", "gain": 1.0}, test={"kind": "sweep"}, command_row=-1,
                            zero_id="bench")
        asked = Run(f"sweep-{k}", t, reference, reference.copy(), 0.0 * t, 0.0 * t, about)
        seen = simulate(rig, asked)
        noise = np.random.default_rng(k).normal(0.0, SIGMA, len(t))
        found.append(replace(asked, command=seen.command, encoder=seen.encoder, accel=np.round(seen.accel + noise)))
    return found


def result(rig: Rig, extended: Rig, given: list[Run]) -> DiagnosisResult:
    sims = [simulate(rig, run) for run in given]
    comparisons = [RunComparison(run, s, s, s) for run, s in zip(given, sims, strict=True)]
    return replace(made.result(runs=1), rig=rig, refit_rig=rig, extended_rig=extended, comparisons=comparisons)


@pytest.fixture(scope="module")
def late() -> list[Run]:
    return runs(LATE)


def test_on_the_right_rig_they_are_the_sensors_noise_and_know_nothing_of_the_command(late: list[Run]) -> None:
    found = residuals(result(RIG, LATE, late))
    assert [(r.number, r.channel) for r in found] == [(1, "encoder"), (1, "accel"), (2, "encoder"), (2, "accel")]
    for r in found:
        assert r.after.std() == pytest.approx(r.noise, rel=0.1) and r.before.std() > 1.5 * r.noise
        assert remaining.command_correlation(r.after, r.command).outside <= 2
        assert remaining.command_correlation(r.before, r.command).outside >= 10
    accel = [remaining.whiteness(r.after) for r in found if r.channel == "accel"]
    assert all(test.white and test.outside <= 2 for test in accel)
    assert found[1].noise == pytest.approx(np.hypot(SIGMA, np.sqrt(1.0 / 12.0)), rel=0.1)


def test_no_controller_enters(late: list[Run]) -> None:
    nameless = [replace(run, metadata=run.metadata.model_copy(update={"controller": {"kind": "unknown"}}))
                for run in late]
    given, blind = (residuals(result(RIG, LATE, these)) for these in (late, nameless))
    assert all(np.array_equal(a.after, b.after) for a, b in zip(given, blind, strict=True))


def test_a_lone_run_that_is_judged_by_halves_is_tested_once(late: list[Run]) -> None:
    copies = [replace(late[0], name=f"sweep ({k})") for k in (1, 2)]
    assert {r.number for r in residuals(result(RIG, LATE, copies))} == {1, 2}
    halves = [replace(late[0], name=f"sweep-0 ({part} half)") for part in ("first", "second")]
    found = residuals(result(RIG, LATE, halves))
    assert [r.number for r in found] == [1, 1] and len(found[0].after) == len(late[0].t)


def test_every_run_is_predicted_from_where_the_effects_count_their_angle() -> None:
    cable = RIG.with_effects([effect_class("cable_spring")(at="base", stiffness=0.15, rest=0.2)])
    given, counts = runs(cable), 100.0
    moved = [given[0], replace(given[1], encoder=given[1].encoder + counts,
                               reference=given[1].reference + (0.0 if given[1].open_loop else counts))]
    unknown = result(RIG, cable, moved)
    known = replace(unknown, comparisons=[unknown.comparisons[0], replace(
        unknown.comparisons[1], zero=-counts * RIG.angle_per_count)])
    right, found, wrong = (residuals(r) for r in (result(RIG, cable, given), known, unknown))
    assert [r.number for r in found] == [1, 1, 2, 2]
    for one, other in zip(right, found, strict=True):
        np.testing.assert_allclose(one.after, other.after, atol=1e-9)
    assert wrong[2].after.std() > 1.2 * right[2].after.std()


@pytest.mark.parametrize(("lost", "without"), [(HELD, HELD), (20, 20 + 500)])
def test_rows_that_were_lost_do_not_count(late: list[Run], lost: int, without: int) -> None:
    """And of a long gap those neither in which the state is found again."""
    run = late[0]
    kept = np.delete(np.arange(len(run.t)), np.arange(400, 400 + lost))
    columns = {name: getattr(run, name)[kept] for name in ("t", "reference", "command", "encoder", "accel")}
    found = residuals(result(RIG, LATE, [replace(run, n=kept, **columns).filled(), late[1]]))
    assert len(found[0].after) == len(found[0].command) == len(run.t) - without
    assert found[1].after.std() == pytest.approx(found[1].noise, rel=0.15)


def test_the_section_says_which_residual_it_shows(late: list[Run]) -> None:
    text = Page(report_html(result(RIG, LATE, late))).text
    assert "predicted one sample ahead by the extended rig, which was fitted to all runs" in text
    # A command's torque shows after so long on the arm: 1/300 of its amplifier's limit (station.estimation.observer).
    assert "forgets an error of the angle within 0.043 s" in text and "section 16.6" in text
    assert "what is left is noise and stated uncertainty; one sample ahead no residual is larger" in text


@pytest.mark.parametrize(("times", "larger"), [(1.09, False), (1.11, True)])
def test_a_residual_is_larger_than_noise_from_a_tenth_more_on(times: float, larger: bool) -> None:
    left = times * SIGMA * np.tile([1.0, -1.0], 50)
    assert Residual(1, "encoder", left, left, 0.0 * left, noise=SIGMA, horizon=0.05).larger is larger

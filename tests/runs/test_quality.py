"""The figures of a plan's table, on runs whose figures are known."""

import numpy as np
import pytest

from station.runs.quality import Scatter, quality, repeatability
from station.runs.run import Run, RunMetadata


def run_of(encoder, reference, command=None, kind="p", accel=None):
    t = np.arange(len(encoder)) / 500.0
    command = np.zeros(len(t)) if command is None else command
    return Run("made", t, reference, command, encoder, accel, RunMetadata(controller={"kind": kind}))


def second_order(zeta=0.3, omega=20.0, size=100.0, rows=2000, start=0.0):
    """The step response of a second-order system in closed form, from row 100 on."""
    t = np.maximum(np.arange(rows) - 100, 0) / 500.0
    damped = omega * np.sqrt(1.0 - zeta**2)
    y = 1.0 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
    reference = start + size * (np.arange(rows) >= 100)
    return run_of(start + size * y, reference)


@pytest.mark.parametrize(("size", "start"), [(100.0, 0.0), (-40.0, 250.0)])
def test_a_second_order_step_has_its_closed_forms_figures(size, start):
    found = quality(second_order(size=size, start=start), 200.0)
    assert found.overshoot == pytest.approx(100.0 * np.exp(-0.3 * np.pi / np.sqrt(1.0 - 0.09)), abs=0.05)
    assert found.rise == pytest.approx(1.3217 / 20.0, rel=0.01)  # 10 to 90 % at zeta = 0.3
    t, damped = np.arange(0.0, 3.0, 1e-5), 20.0 * np.sqrt(0.91)
    off = np.exp(-6.0 * t) * (np.cos(damped * t) + 6.0 / damped * np.sin(damped * t))
    assert found.settling == pytest.approx(t[np.flatnonzero(np.abs(off) > 0.02)[-1]], abs=0.003)
    assert abs(found.final_error) < 1e-3 * abs(size)
    assert found.saturated == 0.0


def test_what_never_rises_or_settles_has_no_such_figure():
    reference = 100.0 * (np.arange(500) >= 100)
    found = quality(run_of(0.5 * reference, reference), 200.0)
    assert (found.rise, found.settling) == (None, None)
    assert found.final_error == pytest.approx(50.0) and found.overshoot == pytest.approx(-50.0)


def test_saturation_is_counted_at_the_limit_of_either_sign():
    command = np.array([0.0, 200.0, -200.0, 199.0, 0.0, 0.0, 0.0, 0.0])
    found = quality(run_of(np.zeros(8), np.zeros(8), command, kind="open"), 200.0)
    assert found.saturated == 0.25 and found.overshoot is found.final_error is None


def test_scatter_is_the_standard_deviation_between_repeats():
    assert Scatter.of([1.0, 2.0, 3.0]) == Scatter(2.0, 1.0, 3)
    assert Scatter.of(3 * [0.12000000000000002]).sigma == 0.0
    assert Scatter.of([4.0, None]) == Scatter(4.0, None, 1)
    assert Scatter.of([None]) == Scatter(None, None, 0)


def test_repeatability_finds_the_noise_and_not_the_place_where_a_run_began():
    random = np.random.default_rng(1)
    reference = 100.0 * (np.arange(4000) >= 100)
    runs = [run_of(begun + 90.0 * (np.arange(4000) >= 110), begun + reference, accel=random.normal(0.0, 2.0, 4000))
            for begun in (0.0, 30.0, -12.0)]
    assert repeatability(runs) == 0.0
    assert repeatability(runs, "accel") == pytest.approx(2.0, rel=0.03)
    assert repeatability(runs[:1]) is None and repeatability([runs[0], second_order()]) is None


def test_an_open_loop_has_no_step_figures_whoever_worked_out_its_command():
    step = 100.0 * (np.arange(500) >= 100)
    for kind in ("open", "unknown"):
        found = quality(run_of(0.0 * step, step, step, kind=kind), 200.0)
        assert found.overshoot is found.rise is found.settling is found.final_error is None

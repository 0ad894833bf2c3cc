"""Frequency responses: sampled models against each other and against simulated and measured runs; the Bode figure."""

from dataclasses import replace

import numpy as np
import pytest

from station.errors import WorkError
from station.model.frequency import finite_element_response, measured_response, transfer_matrix_response
from station.model.simulate import simulate
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
from station.runs.store import load_run
from station.view.bode import bode_figure, excited
from tests.measured import measured_log


def fine_rig():
    rig = load_rig("sflr")
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": 20})})


def noise_run(rows: int = 20000, seed: int = 3) -> Run:
    command = 80.0 * np.random.default_rng(seed).standard_normal(rows).clip(-2.0, 2.0)
    zero = np.zeros(rows)
    return Run("noise", np.arange(rows) / 500.0, command, command, zero, zero, RunMetadata())


def decibels(one, other):
    return np.abs(20.0 * np.log10(np.abs(one / other)))


def test_sampled_finite_elements_and_transfer_matrices_agree_up_to_half_the_rate():
    frequency = np.geomspace(0.05, 220.0, 150)
    fem, tmm = (response(fine_rig(), frequency) for response in (finite_element_response, transfer_matrix_response))
    assert decibels(fem.encoder, tmm.encoder).max() < 0.001
    assert decibels(fem.accel, tmm.accel).max() < 0.05
    assert np.abs(np.angle(fem.encoder / tmm.encoder)).max() < 1e-3


def test_the_hold_and_its_aliases_matter():
    frequency = np.array([200.0])
    exact, single = (transfer_matrix_response(fine_rig(), frequency, aliases=n) for n in (8, 0))
    assert decibels(exact.encoder, single.encoder)[0] > 0.2
    assert np.angle(exact.encoder / single.encoder)[0] != 0.0


@pytest.mark.parametrize("missing", [(), ("drive", "clamp")])
def test_estimate_from_a_simulated_run_is_the_model_response(missing):
    rig, run = load_rig("sflr").model_copy(update=dict.fromkeys(missing)).meshed(), noise_run()
    made = simulate(rig, run, rounding=False, start_angle=0.0)
    found = measured_response(replace(run, encoder=made.encoder, accel=made.accel))
    band = (found.frequency > 3.0) & (found.frequency < 100.0)
    model = finite_element_response(rig, found.frequency[band])
    assert np.median(decibels(found.encoder[band], model.encoder)) < 0.1
    assert np.median(decibels(found.accel[band], model.accel)) < 0.1
    assert np.median(np.abs(np.angle(found.accel[band] / model.accel))) < 0.02
    assert np.median(found.accel_coherence[band]) > 0.99


def test_noise_on_a_reading_shows_in_its_coherence_alone():
    rig, run = load_rig("sflr"), noise_run()
    made = simulate(rig, run, rounding=False, start_angle=0.0)
    noisy = made.accel + 30.0 * np.random.default_rng(1).standard_normal(len(made.accel))
    found = measured_response(replace(run, encoder=made.encoder, accel=noisy))
    high = found.frequency > 120.0
    assert np.median(found.accel_coherence[high]) < 0.6 < 0.95 < np.median(found.encoder_coherence[found.frequency > 3])


def test_runs_without_content_are_refused_in_one_line():
    run = noise_run(400)
    with pytest.raises(WorkError, match="too few"):
        measured_response(run)
    still = noise_run()
    with pytest.raises(WorkError, match="never moves"):
        measured_response(replace(still, command=0.0 * still.command))


def test_measured_sweep_lies_near_the_model_where_it_is_coherent():
    run = load_run(measured_log("sweep"))
    found = measured_response(run)
    model = finite_element_response(load_rig("sflr"), found.frequency)
    band = (found.frequency > 1.0) & (found.frequency < 17.0) & (found.encoder_coherence > 0.95)
    assert band.sum() > 30
    assert np.median(decibels(found.encoder[band], model.encoder[band])) < 4.0
    assert np.median(found.accel_coherence[band]) > 0.95


def test_bode_figure_shows_both_sensors_both_models_and_the_measurement():
    rig, run = load_rig("sflr"), noise_run()
    made = simulate(rig, run, start_angle=0.0)
    figure = bode_figure(rig, replace(run, encoder=made.encoder, accel=made.accel), points=50)
    assert len(figure.axes) == 6
    magnitude, phase, coherence = figure.axes[0], figure.axes[2], figure.axes[4]
    assert {line.get_label() for line in magnitude.lines} == {"finite elements", "transfer matrices"}
    assert [points.get_label() for points in magnitude.collections] == ["measured"]
    fem = next(line for line in magnitude.lines if line.get_label() == "finite elements")
    wanted = finite_element_response(rig.meshed(), fem.get_xdata())
    np.testing.assert_allclose(fem.get_ydata(), 20 * np.log10(np.abs(wanted.encoder)))
    assert phase.get_ylabel() == "phase, deg" and coherence.get_ylim()[1] > 1.0
    assert np.abs(np.diff(phase.lines[0].get_ydata())).max() < 180.0, "unwrapped"
    # The same points as estimated, in the phase panel on the model's branch.
    assert len(phase.collections[0].get_offsets()) == len(magnitude.collections[0].get_offsets()) > 100


def test_bode_figure_without_run_or_accelerometer_has_two_panels():
    rig = load_rig("sflr").model_copy(update=dict.fromkeys(("clamp", "beam", "tip", "accelerometer")))
    assert len(bode_figure(rig, points=30).axes) == 2


def test_excited_band_ends_where_the_sweep_ended():
    run = load_run(measured_log("sweep"))
    assert 15.0 < excited(run) < 60.0

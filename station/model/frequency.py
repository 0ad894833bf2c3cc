"""Frequency responses from command to encoder and accelerometer, counts per count: measured, and of the
models.

All are those of the sampled rig: a command held for one period, readings taken at the tick before the next
command acts.  So they can be laid over each other without a correction for the hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.signal

from station.errors import WorkError
from station.model.linear import sampled
from station.model.transfer_matrix import chain_response
from station.rig import Rig
from station.runs.run import Run


@dataclass(frozen=True)
class FrequencyResponse:
    """Complex responses (n) at ``frequency`` (Hz); coherences where measured, accelerometer where there is one."""

    frequency: np.ndarray
    encoder: np.ndarray
    accel: np.ndarray | None
    encoder_coherence: np.ndarray | None = None
    accel_coherence: np.ndarray | None = None


def measured_response(run: Run, resolution: float = 0.25) -> FrequencyResponse:
    """Estimate H1 = S_vy / S_vv and the coherence |S_vy|^2 / (S_vv S_yy) of a run (Welch, Hann, half
    overlap).

    ``resolution`` (Hz) sets the segment's length.  H1 counts noise on the reading only; in a closed loop
    noise that comes round through the command biases it by the noise's share, which the coherence shows.
    """
    rate = run.sample_rate
    segment = round(rate / resolution)
    if len(run.t) < 2 * segment:
        raise WorkError(f"{run.name}: {len(run.t)} rows are too few for a resolution of {resolution} Hz, "
                        f"which wants {2 * segment}")
    if np.ptp(run.command) == 0.0:
        raise WorkError(f"{run.name}: the command never moves, so that there is no frequency response")
    welch = {"fs": rate, "nperseg": segment}

    def estimate(reading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, cross = scipy.signal.csd(run.command, reading, **welch)
        _, coherence = scipy.signal.coherence(run.command, reading, **welch)
        return cross[1:] / power[1:], coherence[1:]

    if np.ptp(run.encoder) == 0.0:
        raise WorkError(f"{run.name}: the encoder never moves, so that there is no frequency response")
    frequency, power = scipy.signal.welch(run.command, **welch)
    encoder, encoder_coherence = estimate(run.encoder)
    accel = accel_coherence = None
    if run.accel is not None and np.ptp(run.accel) > 0.0:   # a device without the sensor logs zeros
        accel, accel_coherence = estimate(run.accel)
    return FrequencyResponse(frequency[1:], encoder, accel, encoder_coherence, accel_coherence)


def finite_element_response(rig: Rig, frequency: np.ndarray) -> FrequencyResponse:
    """The sampled finite element model at ``frequency`` (Hz), exact."""
    plant = sampled(rig)
    z = np.exp(2j * np.pi * np.asarray(frequency) * rig.period)
    resolvent = np.linalg.solve(z[:, None, None] * np.eye(plant.nstates) - plant.A, plant.B)
    # What jumps with the command (D) is read at the next tick.
    response = (plant.C @ resolvent)[:, :, 0].T + plant.D / z
    return FrequencyResponse(np.asarray(frequency), response[0], response[1] if len(response) > 1 else None)


def transfer_matrix_response(rig: Rig, frequency: np.ndarray, overhang: float = 0.0,
                             aliases: int = 8) -> FrequencyResponse:
    """The sampled continuous beam at ``frequency`` (Hz), by Poisson's sum over ``aliases`` on either side.

    The hold's response is (1 - e^-sT)/T sum_k H(s + j k 2 pi / T) / (s + j k 2 pi / T).  ``aliases`` = 0
    leaves the continuous response times the hold.  ``overhang``: see ``chain_response``.
    """
    frequency = np.asarray(frequency, dtype=float)
    s = 2j * np.pi * (frequency[:, None] + np.arange(-aliases, aliases + 1) * rig.sample_rate)
    response = chain_response(rig, s, overhang)
    hold = rig.motor.gain * (1.0 - np.exp(-s * rig.period)) / (s * rig.period)
    encoder = (hold * response.base).sum(axis=1) / rig.angle_per_count
    accel = None
    if response.tip is not None and rig.accelerometer is not None:
        accel = (hold * response.tip).sum(axis=1) * rig.accelerometer.gain
    return FrequencyResponse(frequency, encoder, accel)

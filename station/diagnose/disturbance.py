"""The torque that a fit misses at the motor, as the quickest observer takes it from the encoder: how large it is, and
how often per turn it repeats itself.

Of a law a sin(n x + phi) the objective has a valley about every n at which half a wave more or less fits into the
travel, so that no derivative leads from one n to another.  The torque itself shows it: with m its mean in each of equal
cells of the travel, of each run and way of turning less the mean of all,

    P(n) = 2 |sum over cells of m exp(-i n x)|^2 / (cells sum of m^2)

is the share of it that a sine of n waves per turn has (the periodogram: Schuster, Terr. Magn. 3, 1898; of cells that
were not passed as of zeros: Lomb, Astrophys. Space Sci. 39, 1976).  A friction, a bias, whatever hangs on the way of
turning alone, is in the mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft
import scipy.ndimage

from station.diagnose.result import Disturbance
from station.estimation.fitted import Fit
from station.estimation.observer import torque_gains
from station.estimation.prediction import Predictor, built, in_motion, predict_run
from station.model.effects.base import SHOWN
from station.model.simulate import Model

CELLS = 8192
"""Of the travel."""
FINER = 8
"""Steps of n in which another half wave fits into the travel."""
LONGEST = 2.0
"""Waves in the travel, at least: of fewer the usual ones are near enough, and what bends slowly is no wave."""
FEWEST = 50
"""Rows that a run must turn one way."""
TURNING = 9
"""Rows over which a speed is taken."""


def _missing(predictor: Predictor, found: Fit, model: Model) -> list[np.ndarray]:
    """The torque of every run in the rows that count (counts of command), as the quickest observer shows it; ``model``:
    of the fit."""
    data, space, x = predictor.data, found.space, found.x
    return [predict_run(data, model, predictor.observers[:1], r, found.own[r], zero=space.zero(x, record.zero_group),
                        place=space.place(x, r))[1][0][record.window] for r, record in enumerate(data.records)]


def disturbance(predictor: Predictor, fits: Sequence[Fit]) -> Disturbance:
    """The torque at the motor that is missing with each fit, and with what it says that runs have of their own, in the
    rows that count: a share of the command's rms torque.

    It is what the quickest observer makes of it over the share of a torque that it shows, less what the encoder's noise
    makes of it.
    """
    data = predictor.data

    def share(one: Fit) -> float:
        model, missing, command = built(one.space.rig_at(one.x)), 0.0, 0.0
        shown, noise = torque_gains(predictor.observers[0], model, in_motion(data, model))
        for torque, run, record in zip(_missing(predictor, one, model), data.runs, data.records, strict=True):
            given = run.command[record.window]
            missing += float(torque @ torque) - noise * float(data.sigma[0] ** 2) * len(torque)
            command += float(given @ given)
        return float(np.sqrt(max(missing, 0.0) / max(command, 1e-300)) / shown)
    shares = predictor.pool.map(share, [one.light for one in fits])
    return Disturbance(**dict(zip(Disturbance.model_fields, shares, strict=True)))


def waves(predictor: Predictor, found: Fit, most: int) -> list[float]:
    """How often per turn the torque that a fit misses repeats itself: the ``most`` highest peaks, the highest first, as
    far as the encoder shows them."""
    runs, records = predictor.data.runs, predictor.data.records
    angles = [run.encoder[record.window] * predictor.data.rig.angle_per_count
              for run, record in zip(runs, records, strict=True)]
    travel = max(float(np.ptp(angle)) for angle in angles)
    if not travel > 0.0:
        return []
    model, power = built(found.space.rig_at(found.x)), np.zeros(CELLS * FINER + 1)
    for torque, angle in zip(_missing(predictor, found, model), angles, strict=True):
        way = np.sign(scipy.ndimage.uniform_filter1d(np.gradient(angle), TURNING))
        cell = np.minimum((angle - angle.min()) * (CELLS / travel), CELLS - 1).astype(int)
        for turning in (-1.0, 1.0):
            rows = way == turning
            if np.count_nonzero(rows) >= FEWEST:
                power += _periodogram(cell[rows], torque[rows])
    per_step = np.pi / (FINER * travel)     # rad^-1, of the transform of 2 CELLS FINER cells
    peaks = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]))
    waves_per_turn = per_step * peaks
    peaks = peaks[(waves_per_turn >= 2.0 * np.pi * LONGEST / travel)
                  & (waves_per_turn <= SHOWN * predictor.data.rig.encoder.counts_per_revolution)]
    return [float(n) for n in per_step * peaks[np.argsort(-power[peaks], kind="stable")][:most]]


def _periodogram(cell: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """(CELLS FINER + 1) how many cells' worth of a torque (n), passed in these cells (n), sines of so many waves have.
    """
    passed = np.bincount(cell, minlength=CELLS)
    mean = np.bincount(cell, torque, minlength=CELLS) / np.maximum(passed, 1)
    mean[passed > 0] -= mean[passed > 0].mean()
    total = float(mean @ mean)
    return 2.0 * np.abs(scipy.fft.rfft(mean, 2 * CELLS * FINER)) ** 2 / max(total, 1e-300)

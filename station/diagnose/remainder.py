"""What a fit leaves, held against what noise would leave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from station.diagnose.thresholds import NOISE
from station.estimation.fitted import Fit
from station.estimation.noise import QUANTISATION, UNROUNDED
from station.estimation.observer import noise_gain
from station.estimation.prediction import Predictor, in_motion

SPAN = 25
"""Samples whose errors are summed: what a swing of some Hz leaves adds up, noise averages out."""
SCATTER = 3.0
"""Variance of a squared error in units of its mean squared: 2 of a Gaussian one, 3 of one whose kurtosis is 4."""


@dataclass(frozen=True)
class Remainder:
    """What a fit leaves of whole runs, per run and channel, against what noise would leave."""

    size: np.ndarray
    """(runs, c) z-score of the mean square."""
    slow: np.ndarray
    """(runs, c) z-score of the mean square of sums over SPAN samples: structure, not noise."""

    @property
    def is_noise(self) -> bool:
        """Whether nothing stands out."""
        return bool(self.size.max() < NOISE and self.slow.max() < NOISE)


def _size(squares: np.ndarray, independent: np.ndarray, freedoms: np.ndarray) -> np.ndarray:
    """z-scores of sums of squares, in units of the noise, of so many independent errors each; ``freedoms``: of the
    noise's estimate."""
    return (squares / independent - 1.0) / np.sqrt(SCATTER / independent + SCATTER / freedoms)


def remainder(predictor: Predictor, found: Fit) -> Remainder:
    """Judge the errors of a fit.

    The encoder's are those of the longest horizon: an observer that forgets feeds the sensor's noise back into what it
    predicts, so that its errors are larger than the noise.  They may be as large as by the most noise that a rest can
    hide.  The accelerometer's are held against the noise of their own run, sums against those of white errors of the
    size that is judged beside them.  Errors count by their share.  A sum over SPAN samples, m of which count, has the
    variance m where errors last 1/share < SPAN samples, and (sum sqrt(share))^2 where one error lasts all through.
    """
    data, size, slow = predictor.data, [], []
    hidden = np.array([max((UNROUNDED**2 + QUANTISATION) / data.sigma[0] ** 2, 1.0), 1.0])[: data.channels]
    for every, record, accel in zip(found.residuals, data.records, data.accel_noise.T, strict=True):
        share, (variance, freedoms) = record.share, np.array([(1.0, data.noise_freedoms[0]), accel])[: data.channels].T
        e = every[predictor.longest] / np.sqrt(variance)[:, None]
        independent, squares = np.maximum(share.sum(axis=1), 1e-9), np.sum(e * e, axis=1)
        size.append(_size(squares / hidden, independent, freedoms))
        rows = e.shape[1] // SPAN * SPAN
        sums = e[:, :rows].reshape(len(e), -1, SPAN).sum(axis=2) ** 2
        shares = share[:, :rows].reshape(len(e), -1, SPAN)
        expected = np.minimum(np.sqrt(shares).sum(axis=2) ** 2, np.count_nonzero(shares, axis=2))
        expected *= np.maximum(squares / independent, 1.0)[:, None]
        ratio = sums.sum(axis=1) - expected.sum(axis=1)
        slow.append(ratio / np.sqrt(np.maximum(SCATTER * np.sum(expected**2, axis=1), 1e-9)))
    return Remainder(np.array(size), np.array(slow))


def may_be_noise(predictor: Predictor, found: Fit) -> bool:
    """Whether nothing stood out if each run began where its own errors say, a count at most from where it does.

    A run of which only a little is believed hardly moves its start, and by what that leaves a little is believed of it.
    """
    begun = []
    for r, every in enumerate(found.residuals):
        e, of_count = every.copy(), predictor.scale(r) * ~predictor.ahead[:, None]
        e -= np.clip(np.sum(e * of_count) / max(float(np.sum(of_count**2)), 1e-300), -1.0, 1.0) * of_count
        begun.append(e)
    return remainder(predictor, replace(found, residuals=begun)).is_noise


def ahead_is_noise(predictor: Predictor, found: Fit, alone: Fit) -> bool:
    """Whether a few samples ahead a fit misses no more of the encoder than the sensor's noise, fed back, and the rig
    ``alone`` no more than it: a cause that takes the rest away has that for its evidence."""
    counts, freedoms = predictor.counts[:, 0], np.array(predictor.data.noise_freedoms[0])
    left = _size(_ahead(predictor, found), counts, freedoms)
    return bool(np.all(left < NOISE)) and not misses_more_ahead(predictor, alone, found)


def misses_more_ahead(predictor: Predictor, found: Fit, than: Fit) -> bool:
    """Whether a few samples ahead a fit misses more of the encoder than another one does, by more than noise makes."""
    more = _ahead(predictor, found) / _ahead(predictor, than) - 1.0
    return bool(np.any(more >= NOISE * np.sqrt(2.0 * SCATTER / predictor.counts[:, 0])))


def _ahead(predictor: Predictor, found: Fit) -> np.ndarray:
    """(runs) sums of squares of what a fit misses of the encoder a few samples ahead, in units of what its observer
    makes there of the sensor's noise."""
    model = predictor.model(found.space, found.x)
    return found.squares[:, 0] / noise_gain(predictor.observers[0], model, in_motion(predictor.data, model))

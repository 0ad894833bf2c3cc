"""What a simulation leaves unexplained: the residual's size, spectrum, whiteness and correlation with the command.

The two tests are those of Ljung, System Identification (2nd ed., 1999), section 16.6, drawn as MATLAB's `resid` draws
them: per lag, with the band that holds 99 % of what chance alone would give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

LAGS = 25
"""Lags shown, as `resid` does."""
BAND = float(stats.norm.ppf(0.995))
"""Half width, standard deviations, of a band that holds 99 % of a Gaussian."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of a residual with what stood ``lag`` samples earlier: the command, or itself."""

    lags: np.ndarray
    """From 1 (itself) or −LAGS (the command) to LAGS."""
    values: np.ndarray
    bound: float
    """99 % of the correlations lie within ±bound where the two are independent."""

    @property
    def outside(self) -> int:
        """Earlier lags outside the band; of the command these are physics that the simulation lacks."""
        return int(np.count_nonzero(np.abs(self.values[self.lags > 0]) > self.bound))

    @property
    def asked(self) -> int:
        """Earlier lags that were asked."""
        return int(np.count_nonzero(self.lags > 0))


@dataclass(frozen=True)
class Whiteness(Correlation):
    """Autocorrelation of a residual and the Ljung-Box test that it is white noise."""

    p_value: float
    """Probability of a Ljung-Box statistic at least this large if the residual were white."""

    @property
    def white(self) -> bool:
        """Whether white noise is compatible with the residual at the 1 % level."""
        return self.p_value >= 0.01


def whiteness(residual: np.ndarray) -> Whiteness:
    """Test a residual (n) for whiteness.

    ρ(k) = Σ ε(t) ε(t−k) / Σ ε²(t); √n ρ(k) is asymptotically N(0, 1) for white ε (Ljung 1999, section 16.6).  All lags
    at once: Q = n(n+2) Σ ρ²(k)/(n−k) against chi-square (Ljung and Box, Biometrika 65, 1978).
    """
    n = len(residual)
    lags = min(LAGS, max(n // 4, 1))
    places = np.arange(1, lags + 1)
    rho = _autocorrelation(residual)[1 : lags + 1]
    q = n * (n + 2.0) * np.sum(rho**2 / (n - places))
    return Whiteness(places, rho, BAND / np.sqrt(n), float(stats.chi2.sf(q, lags)))


def command_correlation(residual: np.ndarray, command: np.ndarray) -> Correlation:
    """Correlation of a residual (n) with the command (n), both about their means.

    ρ(k) = Σ ε(t) u(t−k) / √(Σ ε² Σ u²).  Where ε is independent of u, √n ρ(k) is asymptotically N(0, P) with
    P = Σ ρ_ε(j) ρ_u(j) over all lags j of either sign (Ljung 1999, section 16.6); ε need not be white.  The sum is
    taken with Bartlett's window over a quarter of the run, and P not below 1, which white ε has.  At lags k ≤ 0 a
    closed loop correlates the two by itself, for the command answers what was read.
    """
    n = len(residual)
    reach = max(n // 4, 1)
    lags = min(LAGS, reach)
    e, u = residual - residual.mean(), command - command.mean()
    scale = float(np.sqrt((e @ e) * (u @ u)))
    places = np.arange(-lags, lags + 1)
    window = 1.0 - np.arange(1, reach) / reach
    both = (_autocorrelation(e) * _autocorrelation(u))[1:reach]
    variance = max(1.0 + 2.0 * float(window @ both), 1.0)
    bound = BAND * float(np.sqrt(variance / n))
    if scale == 0.0:
        return Correlation(places, np.zeros(len(places)), bound)
    full = signal.correlate(e, u, mode="full", method="fft") / scale
    return Correlation(places, full[n - 1 - lags : n + lags], bound)


def _autocorrelation(values: np.ndarray) -> np.ndarray:
    """(n) at lags 0 to n − 1 about the mean; zero where the values never change."""
    centred = values - values.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return np.zeros(len(values))
    return signal.correlate(centred, centred, mode="full", method="fft")[len(values) - 1 :] / power

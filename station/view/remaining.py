"""What a simulation leaves unexplained: the residual's size, spectrum and whiteness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal, stats


def nrmse(measured: np.ndarray, simulated: np.ndarray) -> float:
    """‖measured − simulated‖ / ‖measured − mean‖; undefined (nan) where the signal never moves."""
    scale = np.linalg.norm(measured - np.mean(measured))
    return float(np.linalg.norm(measured - simulated) / scale) if scale > 0.0 else float("nan")


def amplitude_density(residual: np.ndarray, sample_rate: float, segment: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Frequency, Hz, and amplitude density, units/√Hz, by Welch's method (Welch 1967, Hann, half overlap)."""
    frequency, density = signal.welch(residual, sample_rate, nperseg=min(segment, len(residual)))
    return frequency[1:], np.sqrt(density[1:])


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of a residual and the Ljung-Box test that it is white noise."""

    lags: np.ndarray
    autocorrelation: np.ndarray
    bound: float
    """95 % of a white residual's autocorrelations lie within ±bound."""
    p_value: float
    """Probability of a Ljung-Box statistic at least this large if the residual were white."""

    @property
    def white(self) -> bool:
        """Whether white noise is compatible with the residual at the 1 % level."""
        return self.p_value >= 0.01


def whiteness(residual: np.ndarray, lags: int = 40) -> Whiteness:
    """Test a residual for whiteness: Q = n(n+2) Σ ρ²/(n−k) against chi-square (Ljung and Box 1978)."""
    n = len(residual)
    lags = min(lags, max(n // 4, 1))
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return Whiteness(np.arange(1, lags + 1), np.zeros(lags), 1.96 / np.sqrt(n), 1.0)
    rho = np.array([centred[k:] @ centred[:-k] for k in range(1, lags + 1)]) / power
    q = n * (n + 2.0) * np.sum(rho**2 / (n - np.arange(1, lags + 1)))
    return Whiteness(np.arange(1, lags + 1), rho, 1.96 / np.sqrt(n), float(stats.chi2.sf(q, lags)))

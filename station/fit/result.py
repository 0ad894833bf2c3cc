"""What a fit found, how far the data hold it, and which directions they do not see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.rig import Rig


@dataclass(frozen=True)
class FittedConstant:
    """One constant; ``low`` to ``high`` holds it with 95 %."""

    path: str
    nominal: float
    value: float
    low: float
    high: float
    determined: float
    """Share of the stated variance (of the logarithm, of an angle itself) that the data take away, 0 to 1."""


@dataclass(frozen=True)
class FlatDirection:
    """A combination of constants that may change together: powers of one factor."""

    powers: dict[str, float]
    always: bool
    """No data of this rig could show it; the constants that are held do not fix it."""
    determined: float
    """Share of its stated variance that these data take away."""

    def __str__(self) -> str:
        terms = ", ".join(f"{path} {power:+.2f}" for path, power in self.powers.items())
        return f"{terms} ({'invisible to any data' if self.always else f'{100.0 * self.determined:.0f} % from data'})"


@dataclass(frozen=True)
class FitResult:
    """The fitted rig and how well it is known."""

    rig: Rig
    constants: tuple[FittedConstant, ...]
    held: tuple[str, ...]
    correlation: np.ndarray
    """(n, n), in the order of ``constants``."""
    flat: tuple[FlatDirection, ...]
    warnings: tuple[str, ...]
    chi2: float
    """Mean squared prediction error of the fitted rig over the noise's; 1 where nothing but noise is left."""
    chi2_nominal: float
    starts: int
    agreeing: int
    """Starts that ended at this minimum."""

    def table(self) -> str:
        """The constants as plain text, one line each; then strong correlations, flat directions and warnings."""
        rows = [("constant", "nominal", "fitted", "95 % low", "95 % high", "from data")]
        rows += [(c.path, f"{c.nominal:.5g}", f"{c.value:.5g}", f"{c.low:.5g}", f"{c.high:.5g}",
                  f"{100.0 * c.determined:.0f} %") for c in self.constants]
        rows += [(path, f"{self.rig.constants()[path]:.5g}", "held", "", "", "") for path in self.held]
        widths = [max(len(row[k]) for row in rows) for k in range(6)]
        lines = ["  ".join(cell.ljust(w) if k == 0 else cell.rjust(w)
                           for k, (cell, w) in enumerate(zip(row, widths, strict=True))).rstrip() for row in rows]
        lines.append(f"mean squared error over noise: {self.chi2_nominal:.4g} nominal, {self.chi2:.4g} fitted; "
                     f"{self.agreeing} of {self.starts} starts ended here")
        lines += [f"correlation {one} with {other}: {value:+.3f}" for one, other, value in self.correlated()]
        lines += [f"flat: {direction}" for direction in self.flat]
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines)

    def correlated(self) -> list[tuple[str, str, float]]:
        """Pairs of constants whose correlation is at least 0.9 either way, the strongest first."""
        pairs = [(self.constants[j].path, self.constants[i].path, float(self.correlation[i, j]))
                 for i in range(len(self.constants)) for j in range(i)]
        return sorted((p for p in pairs if abs(p[2]) >= 0.9), key=lambda p: -abs(p[2]))

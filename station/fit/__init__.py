"""Grey-box fit of a rig's constants to runs; no effects are sought, and none of the machine's faults are named."""

from station.fit.estimate import fit
from station.fit.result import FitResult, FittedConstant, FlatDirection

__all__ = ["FitResult", "FittedConstant", "FlatDirection", "fit"]

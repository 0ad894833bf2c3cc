"""A run: one test on a device, logged; its columns and what is known about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from station.errors import WorkError


class RunMetadata(BaseModel):
    """What is known about a run (DESIGN: metadata); unknown keys are kept as they are."""

    model_config = ConfigDict(extra="allow")

    rig: str | dict[str, Any] = ""
    controller: dict[str, Any] = Field(default_factory=lambda: {"kind": "open"})
    test: dict[str, Any] = Field(default_factory=dict)
    firmware: dict[str, Any] | str | None = None
    versions: dict[str, str] | None = None
    session: int | None = None
    zero_id: str | None = None
    start: Literal["released", "equilibrium"] = "released"
    command_row: int = Field(default=0, ge=-8, le=0)
    rounding: bool = True
    accel_zero: float = 0.0


@dataclass(frozen=True)
class Run:
    """Columns are one-dimensional float arrays of equal length; counts where the name says nothing else."""

    name: str
    t: np.ndarray
    reference: np.ndarray
    command: np.ndarray
    encoder: np.ndarray
    accel: np.ndarray | None = None
    metadata: RunMetadata = field(default_factory=RunMetadata)
    n: np.ndarray | None = None
    device_time: np.ndarray | None = None
    host_time: np.ndarray | None = None
    status: np.ndarray | None = None
    command_sent: np.ndarray | None = None
    latency: np.ndarray | None = None
    slack: np.ndarray | None = None

    def __post_init__(self) -> None:
        rows = len(self.t)
        if rows < 2:
            raise WorkError(f"{self.name}: {rows} rows are too few for a run")
        for column in ("reference", "command", "encoder", "accel"):
            values = getattr(self, column)
            if values is None:
                continue
            if len(values) != rows:
                raise WorkError(f"{self.name}: column {column} has {len(values)} rows, t has {rows}")
            bad = np.flatnonzero(~np.isfinite(values))
            if bad.size:
                raise WorkError(f"{self.name}: column {column}, row {bad[0]}: not a finite number")
        steps = np.diff(self.t)
        if not np.all(np.isfinite(self.t)) or np.any(np.abs(steps - steps.mean()) > 0.02 * abs(steps.mean())):
            bad = int(np.argmax(np.abs(steps - np.median(steps))))
            raise WorkError(f"{self.name}: column t, row {bad + 1}: irregular time; t must be index / sample_rate")

    @property
    def sample_rate(self) -> float:
        """Nominal rate, Hz, from the time column."""
        return float((len(self.t) - 1) / (self.t[-1] - self.t[0]))

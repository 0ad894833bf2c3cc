"""A short test on the simulated rig, its rows kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.port import Port, open_port
from station.loop.run_test import LoopResult, run_test
from station.loop.sink import MemorySink
from station.rig import load_rig
from station.runs.run import Run
from tests.device.conftest import scripted  # noqa: F401  (a fixture of ours, too)

RIG = load_rig("sflr")
LEAD = {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}


class Rows:
    """Runs tests and keeps what they log."""

    rig = RIG

    def __init__(self) -> None:
        self.sinks: list[MemorySink] = []

    def sink(self, metadata: Any) -> MemorySink:
        self.sinks.append(MemorySink(metadata))
        return self.sinks[-1]

    @property
    def run(self) -> Run:
        return self.sinks[-1].run("run")

    @staticmethod
    def compensator(spec: dict[str, Any] | None = None) -> Compensator:
        return Compensator.from_spec(spec or LEAD, RIG.sample_rate, RIG.amplifier.limit)

    @staticmethod
    def reference(rows: int = 600, amplitude: float = 100.0) -> np.ndarray:
        reference = np.zeros(rows)
        reference[100:] = amplitude
        return reference

    def test(self, port: Port, spec: dict[str, Any] | None = None, **options: Any) -> LoopResult:
        """A step; one session only, unless accel_zero and relative are given otherwise."""
        rows = options.pop("rows", 600)
        options = {"accel_zero": 0.0, "relative": False, "log_sink": self.sink} | options
        compensator = options.pop("compensator", None) or self.compensator(spec)
        reference = options.pop("reference", None)
        return run_test(port, options.pop("rig", RIG), compensator,
                        self.reference(rows) if reference is None else reference, **options)

    def test_at(self, url: str, spec: dict[str, Any] | None = None, **options: Any) -> LoopResult:
        with open_port(url) as port:
            return self.test(port, spec, **options)


@pytest.fixture
def rows() -> Rows:
    return Rows()

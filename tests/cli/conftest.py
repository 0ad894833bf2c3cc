"""Commands run in this process; what they print and how they end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from station.cli import main
from station.model.simulate import simulate
from station.rig import load_rig
from station.runs import Run, RunMetadata, export_run


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int
    out: str
    err: str

    def one_line(self) -> str:
        """The one line of a failure; asserts that it is one and no traceback."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("station: ")
        assert "Traceback" not in self.err and "fault of Station itself" not in self.err
        return lines[0]


@pytest.fixture
def station(capfd: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """station("compare", ...): run a command."""

    def run(*arguments: object) -> Ended:
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return Ended(int(ended.value.code or 0), out, err)

    return run


def step_run(rig_name: str = "sflr", *, amplitude: float = 50.0, rows: int = 300, name: str = "step") -> Run:
    """A step under P control, as the rig's model does it; made here, not measured."""
    rig = load_rig(rig_name)
    t = np.arange(rows) * rig.period
    reference = np.where(np.arange(rows) >= 20, amplitude, 0.0)
    metadata = RunMetadata(rig=rig.model_dump(exclude_none=True), controller={"kind": "p", "gain": 2.0},
                           test={"kind": "step", "amplitude": amplitude}, command_row=-1, zero_id="made")
    zeros = np.zeros(rows)
    made = simulate(rig, Run(name, t, reference, zeros, zeros, zeros, metadata))
    return Run(name, t, reference, made.command, made.encoder, made.accel, metadata)


@pytest.fixture
def step(tmp_path: Path) -> Path:
    """A run file."""
    path = tmp_path / "step.csv"
    export_run(step_run(), path)
    return path

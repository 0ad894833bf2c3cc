"""What the host tells the device, and what it takes for new: limits of the rig, samples that come again later."""

import numpy as np
import pytest

from station.device.port import Port, open_port
from station.device.protocol import MESSAGES
from station.device.simulated import Options, SimulatedDevice
from station.model.simulate import simulate
from station.rig import Limits
from station.runs import compare_replay
from tests.firmware.conftest import make_bench  # noqa: F401  (a fixture)
from tests.loop.conftest import RIG

SAMPLE = MESSAGES["sample"]


def test_the_rigs_limit_is_sent_to_a_device_that_would_allow_more(rows):
    rig = RIG.model_copy(update={"amplifier": RIG.amplifier.model_copy(update={"limit": 120.7})})
    with open_port("sim://sflr") as port:
        rows.test(port, rig=rig)
        assert port.serial.device.core.command_limit == 120


@pytest.mark.parametrize(("amplifier", "command", "device", "acts"), [
    (200.0, 60.5, 200, 60), (120.7, None, 200, 120), (200.0, None, 80, 80)])
def test_the_tightest_limit_cuts_in_the_compensator_as_on_the_device_and_in_the_simulation(
        rows, tmp_path, amplifier, command, device, acts):
    """Of the rig's two and the device's own; so that nothing is left for the device to cut."""
    rig = RIG.model_copy(update={"amplifier": RIG.amplifier.model_copy(update={"limit": amplifier}),
                                 "limits": Limits(command=command)})
    board = RIG.model_copy(update={"amplifier": RIG.amplifier.model_copy(update={"limit": float(device)})})
    file = tmp_path / "rig.toml"
    file.write_text(board.to_toml())
    with open_port(f"sim://?rig={file}") as port:
        compensator = rows.compensator()
        result = rows.test(port, rig=rig, compensator=compensator)
        assert port.serial.device.core.command_limit == acts
    assert result.counts.limited == 0 and compensator.limit == 200.0
    run = rows.run
    assert run.metadata.command_limit == acts == np.abs(run.command).max()
    made = simulate(rig, run)
    np.testing.assert_array_equal([made.command, made.encoder], [run.command, run.encoder])
    assert compare_replay(run).same


class Again(Port):
    """A port that delivers every 41st sample a second time, three samples later."""

    def __init__(self, url, line):
        super().__init__(url, line)
        self.read_before, self.again = [], 0

    def read(self, size):
        data = super().read(size)
        if len(data) == SAMPLE.wire_size:
            self.read_before.append(data)
            if len(self.read_before) % 41 == 0:
                self.again += 1
                data += self.read_before[-4]
        return data


def test_an_old_sample_that_comes_again_is_counted_and_not_taken_for_new(rows):
    with open_port("sim://sflr") as port:
        rows.test(port)
        clean = rows.run
    with open_port("sim://sflr") as port:
        line = Again(port.url, port.serial)
        result = rows.test(line)
    assert line.again == 14
    assert (result.counts.duplicated, result.counts.lost, result.counts.samples) == (14, 0, 600)
    assert rows.run.encoder.tolist() == clean.encoder.tolist()
    assert rows.run.command.tolist() == clean.command.tolist()


class Source:
    """Sensors at rest; keeps what the drive was told."""

    def __init__(self):
        self.told = []

    def begin(self):
        self.told.append("begin")

    def sample(self):
        return 0, 0

    def advance(self, drive, enabled):
        self.told.append(enabled)


def test_the_drive_is_enabled_in_a_session_alone(make_bench):  # noqa: F811
    source, bench = Source(), make_bench()
    device = SimulatedDevice("bench", source, 500.0, 200.0, Options(), 7)
    bench.core = device.core
    for request in (None, bench.start, lambda: bench.ask("stop")):
        if request is not None:
            request()
        device.tick(0)
        device.advance()
        bench.heard()
    assert source.told == [False, "begin", True, False]

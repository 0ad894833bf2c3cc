"""The rate that a line carries: one rule on host and device, and an adapter that the host alone can see."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from station.device import line
from station.device.line import Line
from station.device.port import open_port
from station.device.protocol import Result, State
from station.errors import UsageError
from station.loop.check import check
from station.loop.loopback import loopback
from tests.firmware.conftest import make_bench  # noqa: F401  (a fixture)
from tests.loop.conftest import RIG, rows  # noqa: F401  (a fixture)

DOCS = Path(__file__).parents[2] / "docs" / "firmware.md"


@pytest.mark.parametrize("answer_ticks", [1, 2, 3, 4])
@pytest.mark.parametrize(("baud_rate", "allowance"), [(921_600, 500), (921_600, 2000), (115_200, 500), (57_600, 2000),
                                                      (2_000_000, 0), (0, 2000), (213_333, 777)])
def test_host_and_device_draw_the_line_at_the_same_rate(make_bench, baud_rate, allowance, answer_ticks):  # noqa: F811
    highest = Line(baud_rate, allowance).highest_rate(answer_ticks)
    bench = make_bench(baud_rate=baud_rate, allowance=allowance, rate=90_000_000, rate_min=1)
    bench.identify()
    wanted = dict(answer_ticks=answer_ticks, fault_ticks=2)
    most = math.floor(1000.0 * highest)  # mHz
    assert bench.configure(rate=most, **wanted).result == Result.OK
    assert bench.configure(rate=math.ceil(1.002 * most), **wanted).result == Result.LINE_TOO_SLOW


def test_the_table_in_the_docs_is_the_rule():
    table = re.findall(r"^\| (\d+) \| (.*) \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(table) == 6
    for baud_rate, cells in table:
        shown = [" / ".join(str(math.floor(Line(int(baud_rate), allowance).highest_rate(ticks)))
                            for allowance in (500, 2000)) for ticks in (1, 2, 3, 4)]
        assert cells.split(" | ") == shown
    usb = " | ".join(str(math.floor(Line(0, 2000).highest_rate(ticks))) for ticks in (1, 2, 3, 4))
    assert f"| USB of the chip itself | {usb} |" in DOCS.read_text(encoding="utf-8")


@pytest.fixture
def uart():
    """The simulated rig, its board built for a UART of 921600 baud that is wired to the host's own."""
    with open_port("sim://sflr") as port:
        board = port.serial.device.core._core.board
        board.baud_rate, board.allowance = 921_600, 500
        yield port


@pytest.fixture
def adapter(monkeypatch):
    """The system lists the port as a USB adapter's."""
    monkeypatch.setattr(line, "comports", lambda: [SimpleNamespace(device="/dev/ttyS0", vid=None),
                                                   SimpleNamespace(device="sim://sflr", vid=0x0403)])


def test_a_port_over_usb_is_known_by_each_of_its_names(monkeypatch, tmp_path):
    by_id = tmp_path / "usb-FTDI"
    by_id.symlink_to("/dev/ttyUSB7")
    monkeypatch.setattr(line, "comports", lambda: [
        SimpleNamespace(device=name, vid=vid) for name, vid in (
            ("/dev/ttyUSB7", 0x0403), ("/dev/cu.usbserial-1", 0x0403), ("/dev/ttyS0", None))])
    for path in ("/dev/ttyUSB7", str(by_id), "/dev/cu.usbserial-1", "/dev/tty.usbserial-1"):
        assert line.is_usb(path), path
    for path in ("/dev/ttyS0", "/dev/ttyUSB8", "sim://sflr", "socket://127.0.0.1:7777"):
        assert not line.is_usb(path), path


def test_a_line_that_carries_the_rate_runs(rows, uart):  # noqa: F811
    assert rows.test(uart).counts.samples == 600


def test_an_adapter_that_the_board_knows_nothing_of_is_refused_before_arming_with_the_highest_rate(
        rows, uart, adapter):  # noqa: F811
    states = []
    receive = uart.serial.device.core.receive

    def seen(data):
        receive(data)
        states.append(uart.serial.device.core.state)

    uart.serial.device.core.receive = seen
    with pytest.raises(UsageError, match=r"921600 baud, 2 ms .* carries 425 Hz at most with answer_ticks = 1, not 500; "
                                         r".*answer_ticks = 2 would carry it"):
        rows.test(uart)
    assert set(states) == {State.IDLE} and not rows.sinks
    with pytest.raises(UsageError, match="425 Hz"):
        loopback(uart, 500.0)
    assert set(states) == {State.IDLE}


def test_through_the_adapter_a_later_answer_runs_and_the_log_says_so(rows, uart, adapter):  # noqa: F811
    result = rows.test(uart, answer_ticks=2, accel_zero=None, relative=True)
    assert result.counts.samples == 600 and result.counts.unanswered <= 1
    assert rows.run.metadata.command_row == -2
    assert loopback(uart, 500.0, 0.2, answer_ticks=2).ok
    assert check(uart, RIG).passed


def test_loopback_takes_the_highest_rate_that_the_line_carries(uart, adapter):
    uart.serial.device.core._core.board.rate_min = 100_000
    assert math.floor(loopback(uart, seconds=0.2).rate) == 425


@pytest.mark.parametrize("answer_ticks", [0, 5])
def test_no_other_answer_ticks_than_the_boards(rows, answer_ticks):  # noqa: F811
    with pytest.raises(UsageError, match="answer_ticks: from 1 to 4"):
        rows.test_at("sim://sflr", answer_ticks=answer_ticks)

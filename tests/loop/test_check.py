"""check and loopback: what is the wrong way round or dead is named; a line is judged without moving the motor."""

import numpy as np
import pytest

from station.device.client import Client
from station.device.port import open_port
from station.device.protocol import State
from station.errors import UsageError
from station.loop.check import check
from station.loop.engine import Counts
from station.loop.loopback import _judge, loopback

OPTIONS = "&noise=1&accel_offset=25&seed=4"


@pytest.fixture
def rig_url(rows, tmp_path):
    """The address of the rig with some constants changed, or without its accelerometer's parts."""
    def make(**changes):
        path = tmp_path / "rig.toml"
        path.write_text(rows.rig.with_constants({key.replace("_", ".", 1): value for key, value in changes.items()})
                        .to_toml())
        return f"sim://?rig={path}{OPTIONS}"
    return make


def checked(rows, url, spoil=None):
    with open_port(url) as port:
        device = port.serial.device
        if spoil is not None:
            sample = device._source.sample
            device._source.sample = lambda: spoil(*sample())
        result = check(port, rows.rig)
        assert device.core.state == State.IDLE
        assert device.core.drive == 0
    return result


def test_a_rig_as_its_file_says_passes(rows, rig_url):
    result = checked(rows, rig_url())
    assert result.passed
    assert (result.motor, result.encoder, result.accelerometer) == (1, 1, 1)
    assert result.travel == pytest.approx(result.expected_travel, abs=1.5)


def test_a_rig_file_that_is_somewhat_off_passes_too(rows, rig_url):
    gain, stiffness = rows.rig.motor.gain, rows.rig.drive.stiffness
    result = checked(rows, rig_url(motor_gain=0.7 * gain, drive_stiffness=1.4 * stiffness))
    assert result.passed, result.words


def test_a_motor_that_turns_the_wrong_way(rows, rig_url):
    result = checked(rows, rig_url(motor_gain=-rows.rig.motor.gain))
    assert not result.passed
    assert (result.motor, result.encoder, result.accelerometer) == (-1, 1, 1)
    assert "the motor turns the wrong way" in result.words[0]


def test_an_encoder_that_counts_the_wrong_way(rows, rig_url):
    result = checked(rows, rig_url(), spoil=lambda encoder, accel: (-encoder, accel))
    assert not result.passed
    assert (result.motor, result.encoder, result.accelerometer) == (1, -1, 1)
    assert "swap its channels" in result.words[0]


def test_an_accelerometer_the_wrong_way_round(rows, rig_url):
    result = checked(rows, rig_url(accelerometer_gain=-rows.rig.accelerometer.gain))
    assert not result.passed
    assert (result.motor, result.encoder, result.accelerometer) == (1, 1, -1)
    assert "the accelerometer reads the wrong way" in result.words[-1]


def test_motor_and_accelerometer_both_the_wrong_way_look_like_the_encoder_and_are_named_with_it(rows, rig_url):
    result = checked(rows, rig_url(motor_gain=-rows.rig.motor.gain, accelerometer_gain=-rows.rig.accelerometer.gain))
    assert not result.passed
    assert result.encoder == -1
    assert "motor and accelerometer both" in result.words[0]


def test_a_dead_encoder(rows, rig_url):
    result = checked(rows, rig_url(), spoil=lambda encoder, accel: (0, accel))
    assert not result.passed
    assert result.encoder == 0
    assert "the encoder is dead" in result.words[0]


def test_a_dead_accelerometer(rows, rig_url):
    result = checked(rows, rig_url(), spoil=lambda encoder, accel: (encoder, 25))
    assert not result.passed
    assert "the accelerometer is dead" in result.words[-1]


def test_nothing_moves(rows, rig_url):
    result = checked(rows, rig_url(), spoil=lambda encoder, accel: (0, 25))
    assert not result.passed
    assert "nothing moved" in result.words[0]


def test_pulses_too_small_for_a_verdict_give_none(rows, rig_url):
    with open_port(rig_url()) as port:
        result = check(port, rows.rig, amplitude=2.0)
    assert not result.passed
    assert "use a larger amplitude" in result.words[0]


@pytest.mark.parametrize("amplitude", [0.0, -20.0, 201.0])
def test_an_amplitude_beyond_the_limit_is_refused(rows, amplitude):
    with open_port("sim://sflr") as port, pytest.raises(UsageError, match="amplitude"):
        check(port, rows.rig, amplitude=amplitude)


def test_the_device_itself_is_told_not_to_go_beyond_the_amplitude(rows):
    with open_port("sim://sflr") as port:
        check(port, rows.rig, amplitude=20.0)
        assert port.serial.device.core._core.config.command_limit == 20


def test_loopback_tells_how_far_it_is():
    told = []
    with open_port("sim://sflr?speed=1") as port:
        loopback(port, seconds=2.0, progress=lambda row, rows: told.append((row, rows)))
    assert told and told == sorted(told)
    assert all(0 <= row <= rows == 1000 for row, rows in told)


def test_loopback_on_a_clean_line(rows):
    with open_port("sim://sflr") as port:
        result = loopback(port, seconds=1.0)
        assert port.serial.device.core._core.config.command_limit == 0
    assert result.ok
    assert result.answered == 1.0
    assert result.counts.samples == 500
    assert result.rate_measured is None
    assert result.device_jitter.max < 1e-9
    assert 0.0 < result.latency.median <= result.latency.p99 <= result.latency.p999 <= result.latency.max
    assert result.verdict == ("the line is clean and every tick had its command in time",)


def test_loopback_on_a_bad_line_counts_and_says_so(rows):
    with open_port("sim://sflr?drop=0.02&flip=0.02&seed=1") as port:
        result = loopback(port, seconds=2.0)
    assert not result.ok
    assert result.counts.lost > 0
    assert result.counts.corrupt > 0
    assert "the line is not clean" in result.verdict[0]
    assert "had no command in time" in result.verdict[-1]


def test_loopback_where_no_answer_ever_comes_is_a_verdict(rows):
    with open_port("sim://sflr?drop=1&on=command") as port:
        result = loopback(port)
    assert not result.ok
    assert result.verdict[0].startswith("the device went into fault")


def test_loopback_measures_a_device_clock_that_is_off(rows, tmp_path):


    with open_port("sim://sflr?speed=1") as port:
        identity = Client(port).identify()
    n = np.arange(1000)
    received = n * 0.00204  # this machine's clock; the device believes 2 ms
    table = np.column_stack([n, n * 0.002, np.ones(1000), received, received + 1e-4])
    result = _judge("/dev/ttyUSB0", identity, 500.0, Counts(samples=1000), table, None)
    assert result.rate_measured == pytest.approx(500.0 / 1.02)
    assert any("clock runs at 0.98039" in words for words in result.verdict)
    bursts = np.column_stack([n, n * 0.002, np.ones(1000), np.floor(n / 8) * 0.016, np.floor(n / 8) * 0.016 + 1e-4])
    result = _judge("/dev/ttyUSB0", identity, 500.0, Counts(samples=1000), bursts, None)
    assert any("latency timer" in words for words in result.verdict)


def test_loopback_at_a_rate_that_the_device_has_not(rows):
    with open_port("sim://sflr") as port, pytest.raises(UsageError, match="the device runs at 500 Hz, not at 1000"):
        loopback(port, rate=1000.0)

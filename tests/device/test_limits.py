"""A rig's limits on a device: in its counts, compiled in for the simulated one, tightened by configure alone."""

import math

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.client import Client
from station.device.framing import encode
from station.device.limits import SPEED_TICKS, DeviceLimits
from station.device.port import open_port
from station.device.protocol import MESSAGES, Fault
from station.errors import UsageError
from station.loop.run_test import run_test
from station.rig import Encoder, Limits, load_rig

SAMPLE, COMMAND, FAULT = MESSAGES["sample"], MESSAGES["command"], MESSAGES["fault"]
RIG = load_rig("sflr")


def of(**limits):
    return RIG.model_copy(update={"limits": Limits(**limits)})


def test_limits_in_counts_are_those_of_the_encoder_and_the_sample_rate():
    assert DeviceLimits.of_rig(RIG) == DeviceLimits()
    assert DeviceLimits.of_rig(of(travel=math.pi / 2.0)).travel == 256
    assert DeviceLimits.of_rig(of(travel=1e-9)).travel == 1
    # 10 rad/s are 10 * 1024 / 2 pi / 500 = 3.26 counts a tick
    assert DeviceLimits.of_rig(of(speed=10.0)).speed == math.ceil(3.2595 * SPEED_TICKS)
    assert of(command=150.0).command_limit == 150.0


def test_a_speed_beyond_what_a_device_holds_is_refused_before_anything_moves(tmp_path):
    fine = RIG.model_copy(update={"encoder": Encoder(counts_per_revolution=2.0**24), "limits": Limits(speed=1.5)})
    assert DeviceLimits.of_rig(fine).speed == 64085
    fast = fine.model_copy(update={"limits": Limits(speed=40.0)})
    words = r"^limits.speed: 40 rad/s .* \d+ counts .* a device holds 65535; take less than 1.53 rad/s, or leave it"
    with pytest.raises(UsageError, match=words):
        DeviceLimits.of_rig(fast)
    with open_port("sim://sflr") as port, pytest.raises(UsageError, match=words):
        run_test(port, fast, Compensator.from_spec({"kind": "open"}, 500.0, 200.0), np.zeros(200),
                 log_sink=lambda metadata: pytest.fail("a log was made"))
    path = tmp_path / "fast.toml"
    path.write_text(fast.to_toml(), encoding="utf-8")
    with pytest.raises(UsageError, match=words):
        open_port(f"sim://x?rig={path}")


def test_of_two_limits_the_tighter_holds():
    assert DeviceLimits(100, 0, 7, 0).within(DeviceLimits(50, 9, 0, 0)) == DeviceLimits(50, 9, 7, 0)
    assert DeviceLimits(20, 3, 0, 5).within(DeviceLimits(50, 9, 6, 8)) == DeviceLimits(20, 3, 6, 5)


def driven(url, limits=None, command=150, command_limit=200):
    """Drive at a constant command; the readings up to the fault, and the fault."""
    with open_port(url) as port:
        client = Client(port)
        identity = client.identify()
        client.configure(500.0, min(command_limit, identity.command_limit), limits=limits)
        client.arm()
        client.start()
        encoder = []
        for _ in range(2000):
            for body in client.decoder.feed(port.read(SAMPLE.wire_size)):
                if body[0] == FAULT.code:
                    fault = FAULT.unpack(body).fault
                    assert client.statistics().fault == fault
                    return encoder, fault, port.serial.device.core.drive
                sample = SAMPLE.unpack(body)
                encoder.append(sample.encoder)
                port.write(encode(COMMAND.pack(index=sample.index + 1 & 0xFFFF, command=command), client.session))
        return encoder, 0, None


def test_travel_beyond_the_hosts_limit_is_a_fault_at_that_tick():
    encoder, fault, drive = driven("sim://sflr", DeviceLimits(travel=300))
    assert (fault, drive) == (Fault.TRAVEL, 0)
    assert abs(encoder[-1]) > 300 and max(map(abs, encoder[:-1])) <= 300


def test_travel_counts_from_where_the_session_began():
    encoder, fault, _ = driven("sim://sflr?angle=3", DeviceLimits(travel=300))
    assert fault == Fault.TRAVEL
    assert abs(encoder[-1] - encoder[0]) > 300 and encoder[0] == 489


def test_a_speed_beyond_the_limit_is_a_fault():
    free, none, _ = driven("sim://sflr")
    assert none == 0
    fastest = max(abs(b - a) for a, b in zip(free, free[SPEED_TICKS:], strict=False))
    encoder, fault, _ = driven("sim://sflr", DeviceLimits(speed=fastest // 2))
    assert fault == Fault.SPEED
    assert abs(encoder[-1] - encoder[-1 - SPEED_TICKS]) > fastest // 2
    assert driven("sim://sflr", DeviceLimits(speed=fastest))[1] == 0


def test_the_rig_behind_the_simulated_board_holds_its_own_limits_whoever_asks(tmp_path):
    path = tmp_path / "held.toml"
    path.write_text(of(travel=1.0, command=60.0).to_toml())
    with open_port(f"sim://{path}") as port:
        identity = Client(port).identify()
        assert identity.command_limit == 60
        assert identity.limits == DeviceLimits(travel=162)
    encoder, fault, _ = driven(f"sim://{path}", DeviceLimits(travel=100_000))
    assert fault == Fault.TRAVEL and 162 < abs(encoder[-1]) < 175

"""The simulated rig: a pyserial port like any other, in virtual or real time, and the same bytes as a board's."""

import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
import serial

from station.device.client import Client
from station.device.framing import Decoder, encode
from station.device.port import open_port
from station.device.protocol import MESSAGES, State, Status
from station.device.simulated import Options, PlantSource, SimulatedDevice
from station.errors import UsageError
from station.model.effects.clock_scale import ClockScale
from station.model.simulate import Plant
from station.rig import load_rig

SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]
RIG = load_rig("sflr")


def started(port, rate=500.0):
    client = Client(port)
    client.identify()
    client.configure(rate, 200)
    client.arm()
    client.start()
    return client


def answer(client, index, command):
    client.port.write(encode(COMMAND.pack(index=index & 0xFFFF, command=command), client.session))


def samples(client, data):
    return [SAMPLE.unpack(body) for body in client.decoder.feed(data) if body[0] == SAMPLE.code]


def test_the_sensors_read_what_the_plant_model_says():
    plant = Plant(RIG)
    commands = (150 * np.sin(np.arange(400) / 20.0)).astype(int).tolist()
    with open_port("sim://sflr") as port:
        client = started(port)
        for i, command in enumerate(commands[:-1]):
            (sample,) = samples(client, port.read(SAMPLE.wire_size))
            assert (sample.encoder, sample.accel) == plant.sample()
            assert sample.command == (0 if i == 0 else command)
            plant.advance(sample.command)
            answer(client, i + 1, commands[i + 1])


def test_noise_joins_a_reading_before_it_is_rounded():
    source, read = PlantSource(RIG, 0.0, 0.4, 0.6, 1), []
    source.begin()
    for i in range(2000):
        read.append(source.sample()[1])
        source.advance(0, i < 1000)
    assert abs(np.mean(read) - 0.4) < 5.0 * np.sqrt((0.6**2 + 1.0 / 12.0) / len(read))
    assert np.var(read) == pytest.approx(0.6**2 + 1.0 / 12.0, rel=0.15)


def test_in_lockstep_the_clock_counts_ticks_and_nothing_else():
    with open_port("sim://sflr") as port:
        client = started(port)
        clocks = []
        for i in range(5):
            clocks += [sample.clock for sample in samples(client, port.read(SAMPLE.wire_size))]
            answer(client, i + 1, 0)
            time.sleep(0.01)
    assert np.diff(clocks).tolist() == [2000] * 4


def test_in_lockstep_time_stands_still_until_the_tick_is_answered():
    with open_port("sim://sflr") as port:
        client = started(port)
        port.read(SAMPLE.wire_size)
        port.serial.timeout = 0.0
        for _ in range(50):
            assert port.serial.in_waiting == 0
            assert port.read(100) == b""
        answer(client, 1, 10)
        assert port.serial.in_waiting == SAMPLE.wire_size
        (sample,) = samples(client, port.read(100))
        assert (sample.index, sample.command) == (1, 10)


def test_in_lockstep_a_tick_passes_unanswered_when_the_host_reads_on():
    with open_port("sim://sflr") as port:
        client = started(port)
        port.read(SAMPLE.wire_size)
        answer(client, 1, 90)
        drives = [samples(client, port.read(SAMPLE.wire_size))[0].command for _ in range(4)]
        assert drives == [90, 90, 0, 0]


def test_a_read_lets_no_more_virtual_time_pass_than_its_timeout():
    with open_port("sim://sflr") as port:
        started(port)
        port.serial.timeout = 0.01
        data = port.read(1000)
        assert len(data) == 5 * SAMPLE.wire_size


def test_a_host_that_reads_in_another_thread_is_given_the_time_to_answer():
    with open_port("sim://sflr") as port:
        client = started(port)
        got = []
        ready = threading.Condition()
        done = threading.Event()

        def read_on():
            while not done.is_set():
                found = samples(client, port.read(SAMPLE.wire_size))
                with ready:
                    got.extend(found)
                    ready.notify_all()

        reader = threading.Thread(target=read_on, daemon=True)
        reader.start()
        for i in range(200):
            with ready:
                assert ready.wait_for(lambda wanted=i: len(got) > wanted, timeout=5.0)
            answer(client, i + 1, 20)
        done.set()
        reader.join(5.0)
    assert not any(sample.status & (Status.HELD | Status.ZEROED) for sample in got[:200])


def test_the_same_seed_gives_the_same_device_and_another_one_another():
    def record(url):
        with open_port(url) as port:
            client = started(port)
            rows = []
            for i in range(100):
                (sample,) = samples(client, port.read(SAMPLE.wire_size))
                rows.append(sample)
                answer(client, i + 1, 50)
            return client.identify().zero_id, rows

    one, again, other = (record(f"sim://sflr?noise=2&seed={seed}") for seed in (5, 5, 6))
    assert one == again
    assert one[0] != other[0]
    assert one[1] != other[1]


def test_noise_has_the_size_asked_for_and_leaves_the_encoder_alone():
    with open_port("sim://sflr?noise=3&accel_offset=40&seed=1") as port:
        client = started(port)
        rows = []
        for i in range(4000):
            rows += samples(client, port.read(SAMPLE.wire_size))
            answer(client, i + 1, 0)
    accel = np.array([row.accel for row in rows])
    assert accel.mean() == pytest.approx(40.0, abs=4 * 3 / np.sqrt(4000))
    assert accel.std() == pytest.approx(np.hypot(3.0, np.sqrt(1 / 12)), rel=0.06)
    assert {row.encoder for row in rows} == {0}


def test_the_starting_angle_stands_on_the_encoder_until_it_is_zeroed():
    with open_port("sim://sflr?angle=1.5707963267948966") as port:
        client = Client(port)
        before = client.identify().zero_id
        assert client.wait_for_rest() == 256
        client.zero()
        assert client.wait_for_rest() == 0
        assert client.identify().zero_id != before


def test_a_rig_file_is_named_by_path_or_by_option(tmp_path):
    path = tmp_path / "my rig.toml"
    path.write_text(RIG.to_toml().replace('name = "sflr"', 'name = "mine"'))
    for url in (f"sim://{path}", f"sim://?rig={path}", f"sim://{str(path).replace(' ', '%20')}"):
        with open_port(url) as port:
            assert Client(port).identify().board == "mine"


def test_a_limit_that_no_device_can_have_is_refused(tmp_path):
    rig = RIG.model_copy(update={"amplifier": RIG.amplifier.model_copy(update={"limit": 40_000.0})})
    with pytest.raises(UsageError, match=r"amplifier.limit 40000 counts"):
        SimulatedDevice.of_rig(rig)


def test_a_clock_that_is_off_paces_the_device_and_not_its_own_reading():
    slow = RIG.with_effects([ClockScale(at="clock", ratio=1.25)])
    device = SimulatedDevice.of_rig(slow, Options())
    assert device.period == pytest.approx(1.25 / 500.0)
    assert device.rate == 500.0


def test_in_real_time_ticks_follow_the_wall_clock():
    with open_port("sim://sflr?speed=1") as port:
        client = started(port)
        begun = time.perf_counter()
        clocks: list[int] = []
        while len(clocks) < 100 and time.perf_counter() < begun + 10.0:
            for sample in samples(client, port.read(SAMPLE.wire_size)):
                clocks.append(sample.clock)
                answer(client, sample.index + 1, 0)
            if port.serial.device.core.state == State.FAULT:  # a busy machine: the ticks that came are enough
                break
        took = time.perf_counter() - begun
        client.halt()
    assert len(clocks) >= 10
    assert took >= (len(clocks) - 1) * 0.002 - 0.001
    assert (clocks[-1] - clocks[0]) / 1e6 == pytest.approx(took, abs=0.15)


def test_a_program_that_knows_only_pyserial_needs_one_line(tmp_path):
    program = tmp_path / "foreign.py"
    program.write_text(textwrap.dedent(f"""
        import serial
        serial.protocol_handler_packages.append("station.device.urls")
        with serial.serial_for_url("sim://sflr", timeout=1) as line:
            line.write(bytes.fromhex("{encode(MESSAGES['query'].pack()).hex()}"))
            print(line.read({MESSAGES["statistics"].wire_size}).hex())
    """))
    out = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, timeout=120, check=True).stdout
    (body,) = Decoder().feed(bytes.fromhex(out.strip()))
    assert MESSAGES["statistics"].unpack(body).samples == 0


def test_a_rig_that_does_not_exist_is_pyserials_own_error_to_a_foreign_program():
    with pytest.raises(serial.SerialException, match="no-such-rig"):
        open_port("sim://sflr").close()  # registers the handlers
        serial.serial_for_url("sim://no-such-rig")


def test_a_closed_port_is_closed():
    port = open_port("sim://sflr")
    port.close()
    port.close()
    with pytest.raises(serial.PortNotOpenError):
        port.serial.read(1)

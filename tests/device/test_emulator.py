"""The firmware on an emulated Cortex-M3: real interrupts, real UARTs, the same run as on the simulated board."""

import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.arm import GCC
from station.device.client import Client
from station.device.emulator import ANSWERED, QEMU, Emulator
from station.device.framing import encode
from station.device.port import open_port
from station.device.protocol import MESSAGES, Fault, InputFlags, Reset, State, Status
from station.device.simulated import Options
from station.errors import UsageError
from station.loop.run_test import run_test
from station.loop.sink import MemorySink
from station.rig import load_rig

for program in (QEMU, GCC):
    if shutil.which(program) is None:
        pytest.skip(f"no {program} here", allow_module_level=True)

RIG = load_rig("sflr")
SLOWER = RIG.model_copy(update={"sample_rate": 200.0})
"""For hosts in real time, which a busy machine starves of its 2 ms; ten ticks are the most that 50 ms hold."""
SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]
WATCHDOG_SECONDS = 0.1


def step_run(url, rows):
    compensator = Compensator.from_spec({"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637},
                                        RIG.sample_rate, RIG.amplifier.limit)
    reference = np.where(np.arange(rows) // 500 % 2, 50.0, 0.0)
    sinks = []
    with open_port(url) as port:
        run_test(port, RIG, compensator, reference, log_sink=lambda m: sinks.append(MemorySink(m)) or sinks[-1])
    return sinks[-1].run("run")


def test_in_lockstep_a_run_is_the_simulated_boards_for_5000_samples():
    simulated, emulated = (step_run(f"{scheme}://sflr?angle=0.7&accel_offset=3", 5000) for scheme in ("sim", "qemu"))
    assert len(emulated) == 5000
    assert np.ptp(emulated.encoder) > 40 and np.ptp(emulated.accel) > 10 and np.ptp(emulated.command) > 100
    for column in ("n", "encoder", "accel", "status", "command", "reference"):
        assert np.array_equal(getattr(simulated, column), getattr(emulated, column)), column
    assert emulated.metadata.firmware["board"] == "sflr"
    assert emulated.metadata.firmware["build"] != simulated.metadata.firmware["build"]


class Watched:
    """An emulated board and what it said to the plant, with the host's clock."""

    def __init__(self, emulator):
        self.emulator = emulator
        self.words = []
        emulator.plant.listeners.append(lambda word: self.words.append((time.perf_counter(), word)))
        self.port = open_port(emulator.url)
        self.client = Client(self.port)

    def start(self):
        self.client.configure(self.client.identify().rate_max, 200)
        self.client.arm()
        self.client.start()

    def drive(self, ticks, command=120, seconds=2.0):
        """Answer so many samples; whether the board has not gone into fault meanwhile."""
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            for body in [*self.client.inbox, *self.client.decoder.feed(self.port.read_waiting())]:
                if body[0] == MESSAGES["fault"].code:
                    return False
                if body[0] == SAMPLE.code:
                    seen = SAMPLE.unpack(body).index
                    self.port.write(encode(COMMAND.pack(index=seen + 1, command=command), self.client.session))
                    if seen >= ticks:
                        return True
            self.client.inbox.clear()
        return False

    def until(self, wanted, seconds=5.0):
        """When the board first said a word that is wanted, from the word ``self.mark`` on; None if never."""
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            for when, word in self.words[self.mark:]:
                if wanted(word):
                    return when
            time.sleep(0.002)
        return None

    def ticks_until(self, wanted):
        """Ticks ('D') from the mark to the first word that is wanted, that one included."""
        assert self.until(wanted) is not None
        count = 0
        for _, word in self.words[self.mark:]:
            count += word.letter == "D"
            if wanted(word):
                return count
        raise AssertionError

    @property
    def driven(self):
        return self.emulator.plant.last.value != 0 and self.emulator.plant.last.enabled


def after_the_last_answer(words):
    """Ticks with the drive not zero after the last command came, and those enabled."""
    last = max((i for i, word in enumerate(words) if word.flags & ANSWERED), default=-1)
    after = [word for word in words[last + 1:] if word.letter == "D"]
    return sum(word.value != 0 for word in after), sum(word.enabled for word in after)


def off(word):
    return not word.enabled and (word.letter == "B" or word.value == 0)


@pytest.fixture
def paced():
    with Emulator(SLOWER, Options(speed=1, seed=1)) as emulator:
        yield emulator


@pytest.fixture
def lockstep():
    with Emulator(RIG, Options(speed=0, seed=1)) as emulator:
        emulator.plant.answer_wait = 0.2
        yield emulator


def started(emulator, ticks=3):
    """Driven, and answered no longer."""
    for _ in range(60):  # a busy machine may starve a host in real time; what is tested comes after
        watched = Watched(emulator)
        if watched.client.identify().state == State.FAULT:
            watched.client.clear()
        watched.start()
        if watched.drive(ticks) and watched.driven:
            watched.mark = len(watched.words)
            return watched
        watched.port.close()
    raise AssertionError("the machine is too busy to drive the board for 15 ms")


def test_a_silent_host_is_off_after_the_stated_ticks(lockstep):
    watched = Watched(lockstep)
    watched.start()
    assert watched.drive(10)
    watched.mark = len(watched.words)
    assert watched.until(lambda word: not word.enabled) is not None
    words = [word for _, word in watched.words]
    assert after_the_last_answer(words) == (2, 10)  # its own tick and one held; fault at the tenth
    assert watched.client.statistics().fault == Fault.HOST_SILENT


def test_a_tick_that_has_stopped_ends_in_a_reset_with_the_drive_off(paced):
    watched = started(paced)
    stopped = time.perf_counter()
    paced.plant.command(b"I")
    reset = watched.until(lambda word: word.letter == "B" and word.value == Reset.WATCHDOG)
    assert reset is not None
    assert reset - stopped < 10 * WATCHDOG_SECONDS  # of the machine's time; the chip's own is the watchdog's
    assert not watched.driven
    watched.client.decoder.feed(b"\0")
    identity = watched.client.identify()
    assert (identity.reset, identity.state) == (Reset.WATCHDOG, State.IDLE)


def test_a_main_loop_that_hangs_is_off_by_the_ticks_and_then_reset(paced):
    watched = started(paced)
    paced.plant.command(b"M")
    watched.drive(1 << 15, seconds=0.5)  # the host goes on answering, and is not heard
    assert watched.until(lambda word: word.letter == "B" and word.value == Reset.WATCHDOG) is not None
    words = [word for _, word in watched.words[watched.mark:]]
    words = words[:next(i for i, word in enumerate(words) if word.letter == "B")]
    assert off(words[-1])
    driven, enabled = after_the_last_answer(words)
    assert driven <= 2
    assert enabled <= 10
    watched.client.decoder.feed(b"\0")
    assert watched.client.identify().state == State.IDLE


def test_a_reset_in_the_middle_of_a_step_leaves_the_drive_off(paced):
    zero_ids = set()
    times = int(os.environ.get("STATION_RESETS", "3"))
    for _ in range(times):
        watched = started(paced)
        paced.reset()
        reset = watched.until(lambda word: word.letter == "B" and word.value == Reset.PIN)
        assert reset is not None, [(word.letter, word.value) for _, word in watched.words[watched.mark:]][-20:]
        time.sleep(0.02)
        first = next(i for i, (_, word) in enumerate(watched.words[watched.mark:]) if word.letter == "B")
        assert not any(word.enabled or word.value for _, word in watched.words[watched.mark + first + 1:])
        zero_ids.add(watched.client.identify().zero_id)
        watched.port.close()
    assert len(zero_ids) == times  # each reset has a name of its own


@pytest.mark.parametrize(("flag", "fault"), [(InputFlags.ESTOP, Fault.ESTOP), (InputFlags.OVERRUN, Fault.OVERRUN),
                                             (InputFlags.HOST_GONE, Fault.HOST_GONE)])
def test_what_the_board_sees_ends_the_run_at_that_tick(lockstep, flag, fault):
    watched = Watched(lockstep)
    watched.start()
    assert watched.drive(10)
    watched.mark = len(watched.words)
    lockstep.plant.input_flags = int(flag)
    watched.port.write(encode(COMMAND.pack(index=11, command=120), watched.client.session))
    assert watched.ticks_until(off) <= 2
    assert watched.client.statistics().fault == fault
    if flag == InputFlags.ESTOP:
        assert watched.client.statistics().status & Status.ESTOP
    lockstep.plant.input_flags = 0


HOST = """
import sys
from station.device.client import Client
from station.device.framing import encode
from station.device.port import open_port
from station.device.protocol import MESSAGES, State
SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]
with open_port(sys.argv[1]) as port:
    client = Client(port)
    while True:
        if client.identify().state == State.FAULT:
            client.clear()
        client.configure(client.identify().rate_max, 200)
        client.arm()
        client.start()
        bodies = list(client.inbox)
        client.inbox.clear()
        while not any(body[0] == MESSAGES["fault"].code for body in bodies):
            for body in bodies:
                if body[0] == SAMPLE.code:
                    index = SAMPLE.unpack(body).index
                    port.write(encode(COMMAND.pack(index=index + 1, command=120), client.session))
                    if index == 10:
                        print("driving", flush=True)
            bodies = client.decoder.feed(port.read_waiting())
"""


def killed(emulator, times):
    """SIGKILL a driving host so many times; each time the ticks with the drive not zero after its last command came,
    and those enabled."""
    found = []
    for _ in range(times):
        words = []
        emulator.plant.listeners[:] = [words.append]
        host = subprocess.Popen([sys.executable, "-c", HOST, emulator.url], stdout=subprocess.PIPE, text=True)
        assert host.stdout.readline() == "driving\n"
        host.send_signal(signal.SIGKILL)
        host.wait()
        end = time.perf_counter() + 10.0
        while not (any(word.flags & ANSWERED for word in words) and off(words[-1])):
            assert time.perf_counter() < end, "the drive is still on"
            time.sleep(0.002)
        found.append(after_the_last_answer(words))
        host.stdout.close()
    return found


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL here")
def test_a_host_that_is_killed_in_the_middle_of_a_step_leaves_the_drive_off(paced):
    for driven, enabled in killed(paced, int(os.environ.get("STATION_KILLS", "2"))):
        assert driven <= 2  # the command's own tick, and one held
        assert enabled <= 10  # fault at the tenth without a command


def test_faults_of_the_line_are_for_the_simulated_board_alone():
    with pytest.raises(UsageError, match="drop|faults"):
        open_port("qemu://sflr?drop=0.1")


def test_a_board_that_cannot_be_emulated_is_refused():
    with pytest.raises(UsageError, match="mps2_an385"):
        Emulator(RIG, board="psoc5lp")

"""The compiled sample path: the answers are those of Python bit for bit, the rows and counts too, on every line and on
every way out."""

import _thread
import contextlib
import os
import re
import shutil
import signal
import socket
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.control.compensators import Compensator
from station.device import build as builder
from station.device import pacing
from station.device.build import WARNINGS, compilers
from station.device.faults import Faults
from station.device.firmware import firmware_folder
from station.device.limits import DeviceLimits
from station.device.pacing import run_device
from station.device.port import Port, open_port
from station.device.protocol import State
from station.device.server import DeviceProcess, _Exchange
from station.device.simulated import Options, SimulatedDevice
from station.errors import WorkError
from station.loop import exchange as module
from station.loop.engine import CONFIRMED, UNCONFIRMED
from station.loop.exchange import COMPILED, FLAGS, INTERPRETED, Exchange, sample_path, sources
from station.loop.safety import Guard
from station.runs.columns import LOG_COLUMNS
from tests.loop.conftest import LEAD, RIG
from tests.loop.test_ways_out import ROW

pytestmark = pytest.mark.skipif(os.name != "posix", reason="plain ports of POSIX")
PATHS = [COMPILED, INTERPRETED]
RATE, ANSWERS = 500.0, (1, 2, 4)

# ---- the same answers, bit for bit ----

number = st.floats(-30.0, 30.0)
small = st.floats(0.0, 1.0)
polynomial = st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=16)


def padded(pair):
    """Numerator and denominator that make a filter: of equal length, the first of the latter not 0."""
    numerator, denominator = pair
    denominator = [1.5, *denominator][:16]
    return numerator[:len(denominator)], denominator


ratio = st.tuples(polynomial, polynomial).map(padded)
SPECS = st.one_of(
    st.just({"kind": "open"}),
    st.builds(lambda g: {"kind": "p", "gain": g}, number),
    st.builds(lambda g, z, p: {"kind": "lead", "gain": g, "zero": z, "pole": p}, number, number, number),
    st.builds(lambda g, z, p, f: {"kind": "lead_accel", "gain": g, "zero": z, "pole": p, "accel_numerator": f[0],
                                  "accel_denominator": f[1]}, number, number, number, ratio),
    st.builds(lambda g, i, d, f: {"kind": "pid", "gain": g, "integral": i, "derivative": d, "filter": f + 1e-3},
              number, small, small, small),
    st.builds(lambda g, s: {"kind": "cascade", "position_gain": g, "speed_gain": s}, number, number),
    st.builds(lambda f: {"kind": "filter", "numerator": f[0], "denominator": f[1]}, ratio))


def pair_of(spec, limit, limits, start, reference, answer_ticks, accel_zero):
    """Python's respond as ``run_test`` has it, and C's."""
    def made():
        compensator = Compensator.from_spec(spec, RATE, limit)
        compensator.limit = limit
        compensator.reset(accel_zero)
        return compensator

    compensator, guard = made(), Guard("port", limits, start, limit, RATE)
    wanted = [*reference, *[0.0] * answer_ticks]

    def python(row, encoder, accel):
        if guard.limited:
            guard.see(row, encoder)
        if row >= len(reference) - answer_ticks:
            return 0
        command = compensator.step(wanted[row + answer_ticks], encoder, accel)
        guard.drive(row, encoder, command)
        return int(np.floor(command + 0.5))

    nowhere = Port("port", type("Line", (), {})())
    return python, Exchange(nowhere, made(), Guard("port", limits, start, limit, RATE), np.array(reference),
                            answer_ticks).respond


def told(respond, *given):
    """The answer, or the kind and words of what is complained of."""
    try:
        return respond(*given)
    except WorkError as error:
        return type(error), str(error)


@settings(max_examples=150)
@given(SPECS, st.sampled_from([0, 1, 60, 200, 32767]), st.sampled_from([0, 7, 300]), st.sampled_from([0, 40]),
       st.integers(-500, 500), st.floats(-20.0, 20.0), st.sampled_from(ANSWERS), st.randoms(use_true_random=False))
def test_every_controller_and_the_guard_answer_as_python_does(spec, limit, travel, speed, start, accel_zero,
                                                              answer_ticks, draw):
    rows = 300
    reference = [draw.choice([start, start + draw.uniform(-300.0, 300.0), 0.0]) for _ in range(rows)]
    python, compiled = pair_of(spec, limit, DeviceLimits(travel, speed, 0, 0), start, reference, answer_ticks,
                               accel_zero)
    encoder, stuck = start, draw.random() < 0.5
    for row in range(rows):
        encoder += 0 if stuck and row > 5 else draw.randint(-3, 3)
        reading = row, encoder, draw.randint(-32768, 32767)
        expected = told(python, *reading)
        assert told(compiled, *reading) == expected
        if isinstance(expected, tuple):
            break


@pytest.mark.parametrize(("limits", "readings", "words"), [
    (DeviceLimits(10, 0, 0, 0), [5] * 10 + [16], r"went 11 counts .* limit is 10; stopped at row 10"),
    (DeviceLimits(0, 10, 0, 0), [5] * 10 + [16], r"moved 11 counts in 8 ticks, the limit is 10; stopped at row 10"),
    (DeviceLimits(), [5] * 300, r"driven at 200 counts for 0.5 s .* stopped at row 249")])
def test_the_guard_trips_at_the_same_row_in_the_same_words(limits, readings, words):
    for respond in pair_of({"kind": "open"}, 200, limits, 5, [200.0] * 400, 1, 0.0):
        for row, encoder in enumerate(readings):
            try:
                assert respond(row, encoder, 0) == 200
            except WorkError as error:
                assert re.search(words, str(error)) and row == int(re.search(r"row (\d+)", str(error))[1])
                break
        else:
            pytest.fail("the guard never tripped")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_command_that_is_not_a_number_ends_a_session_in_both():
    wild = {"kind": "lead_accel", "gain": 1.0, "zero": 1.0, "pole": 2.0, "accel_numerator": [1.0, 1e300],
            "accel_denominator": [1.0, -1e300]}
    ends = []
    for respond in pair_of(wild, 200, DeviceLimits(), 0, [0.0] * 50, 1, 0.0):
        answers = [told(respond, row, 0, 1000) for row in range(6)]
        ends.append(next(answer for answer in answers if isinstance(answer, tuple)))
        assert answers[0] == -200
    assert ends[0] == ends[1] and ends[0][0] is WorkError and "no number at row 3," in ends[0][1]


# ---- whole tests on lines with a descriptor ----

@contextlib.contextmanager
def served(line, **options):
    """The simulated rig at a pseudo-terminal or a socket, in lockstep, on a thread of this process: port and device.  A
    tick that is not answered passes soon."""
    device = SimulatedDevice.of_rig(RIG, Options(seed=options.pop("seed", 1), **options))
    end = _Exchange(device, line == "pty", 0 if line == "tcp" else None)
    stop = threading.Event()
    thread = threading.Thread(target=run_device, args=(device, end, stop), daemon=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pacing, "_ANSWER_WAIT", 0.03)
        thread.start()
        try:
            with open_port(end.path if line == "pty" else f"socket://127.0.0.1:{end.port}") as port:
                yield port, device
        finally:
            stop.set()
            thread.join(10.0)
            end.close()


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    """The way of the samples."""
    if request.param == INTERPRETED:
        monkeypatch.setattr("station.loop.run_test.sample_path", lambda *given: INTERPRETED)
    return request.param


def adds_up(counts):
    return counts.device_samples + counts.unsent == counts.samples + counts.lost + counts.after_stop


def rows_of(sink):
    """What does not hang on this machine's clocks."""
    kept = [at for at, name in enumerate(LOG_COLUMNS) if name not in ("host_time", "device_time", "latency", "slack")]
    return np.array(sink.rows)[:, kept]


@pytest.mark.parametrize("line", ["pty", "tcp"])
def test_rows_and_counts_are_those_of_the_python_path(rows, line, monkeypatch):
    found = []
    for wanted in PATHS:
        if wanted == INTERPRETED:
            monkeypatch.setattr("station.loop.run_test.sample_path", lambda *given: INTERPRETED)
        with DeviceProcess("sflr", pty=line == "pty", tcp=line == "tcp", speed=0, seed=1) as device:
            result = rows.test_at(getattr(device.addresses, line), relative=True, accel_zero=None)
        assert result.sample_path == wanted == result.metadata.entries()["sample_path"]
        counts, sink = result.counts, rows.sinks[-1]
        assert counts.samples == counts.device_samples == counts.commands == 600 and sink.closed and adds_up(counts)
        assert np.all(rows.run.latency > 0.0) and np.all(np.diff(rows.run.host_time) >= 0.0)
        found.append((rows_of(sink), {**counts.as_dict(), "woke_late": 0}))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1] and np.max(np.abs(rows.run.command)) > 100.0


FAULTS = {"dropped": Faults(drop=0.03, on=frozenset({"sample"})), "flipped": Faults(flip=0.02),
          "repeated": Faults(duplicate=0.03), "overtaken": Faults(reorder=0.03, on=frozenset({"sample"})),
          "all": Faults(drop=0.01, flip=0.01, duplicate=0.01, late=0.01, reorder=0.01)}


@pytest.mark.parametrize("line", ["pty", "tcp"])
@pytest.mark.parametrize("kind", FAULTS)
def test_every_fault_of_the_line_is_counted_exactly(rows, kind, line, path):
    with served(line, faults=FAULTS[kind]) as (port, device):
        result = rows.test(port)
        assert device.core.drive == 0 and device.core.state == State.IDLE
    assert result.sample_path == path
    counts, put, run = result.counts, device.line.counts, rows.run
    beyond = max(counts.after_stop - 1, 0)
    assert adds_up(counts) and counts.samples == len(run) == 600 - counts.lost
    assert np.all(np.diff(run.n) > 0) and sum(put.values()) > 5
    assert counts.lost == sum(put["sample", name] for name in ("drop", "flip", "reorder")) - beyond
    assert counts.corrupt == put["sample", "flip"] and counts.device_corrupt == put["command", "flip"]
    assert counts.repeated == put["command", "duplicate"]
    assert put["sample", "duplicate"] - counts.duplicated in (0, 1)
    assert put["sample", "reorder"] - counts.reordered in (0, 1)


class Pieces:
    """The device's end of a line that sends every frame in three pieces."""

    def __init__(self, end):
        self._end = end

    def __getattr__(self, name):
        return getattr(self._end, name)

    def send(self, data):
        for piece in (data[:1], data[1:9], data[9:]):
            self._end.send(piece)
            time.sleep(2e-4)


@pytest.mark.parametrize("line", ["pty", "tcp"])
def test_frames_that_come_in_pieces_are_put_together(rows, line, path, monkeypatch):
    run = pacing.run_device
    monkeypatch.setattr(f"{__name__}.run_device", lambda device, end, stop: run(device, Pieces(end), stop))
    with served(line) as (port, _):
        counts = rows.test(port).counts
    assert (counts.samples, counts.lost, counts.corrupt, counts.duplicated) == (600, 0, 0, 0) and adds_up(counts)


def test_a_write_that_is_cut_short_is_completed_by_python(rows, monkeypatch, tmp_path):
    """The line takes 5 bytes of every 50th command, none of every 75th: Python sends the rest, the device loses
    nothing."""
    some = ("static ssize_t some(int line, const void *from, size_t size)\n{\n    static int n;\n    n++;\n"
            "    return n % 75 == 0 ? -1 : write(line, from, n % 50 == 0 ? 5 : size);\n}\n")
    text = module.SOURCE.read_text(encoding="utf-8")
    assert text.count("write(x->line") == 1
    text = text.replace("write(x->line", "some(x->line")
    text = text.replace("/* Whether the frame", some + "\n/* Whether the frame")
    (tmp_path / "exchange.c").write_text(text, encoding="utf-8")
    monkeypatch.setattr(module, "SOURCE", tmp_path / "exchange.c")
    monkeypatch.setattr(builder, "_folders", lambda: [tmp_path])
    monkeypatch.setattr(module, "library", module.library.__wrapped__)
    sent, write = [], Port.write
    monkeypatch.setattr(Port, "write", lambda self, data: (sent.append(len(data)), write(self, data))[1])
    with served("pty") as (port, _):
        result = rows.test(port)
    assert result.sample_path == COMPILED and sent.count(5) >= 8 and sent.count(10) >= 8
    counts = result.counts
    assert (counts.samples, counts.commands, counts.device_corrupt, counts.lost) == (600, 600, 0, 0)


def test_a_line_that_is_pulled_is_told_in_the_same_words(rows, path):
    lost = r"the line was lost .* check cable and device; " + UNCONFIRMED
    with served("tcp") as (port, _), pytest.raises(WorkError, match=lost) as caught:
        rows.test(port, rows=20000, log_sink=acting(rows, lambda: port.serial._socket.shutdown(socket.SHUT_RDWR)))
    assert "\n" not in str(caught.value) and rows.sinks[-1].closed
    assert rows.sinks[-1].metadata.entries()["outcome"] == str(caught.value)


def test_a_device_that_falls_silent_or_faults_is_told(rows, path):
    with served("pty", faults=Faults(silent_after=ROW)) as (port, _), pytest.MonkeyPatch.context() as patch:
        patch.setattr("station.loop.engine.VIRTUAL_SILENCE_SECONDS", 0.5)
        with pytest.raises(WorkError, match=f"the device fell silent after row {ROW - 2}; check cable"):
            rows.test(port)
        assert rows.sinks[-1].closed and len(rows.run) == ROW - 1
    with served("pty", faults=Faults(drop=1.0, on=frozenset({"command"}))) as (port, device):
        with pytest.raises(WorkError, match=r"in fault \(host silent\) at row 10"):
            rows.test(port)
        assert device.core.drive == 0 and len(rows.run) == 11


def test_what_the_guard_says_ends_a_test_in_the_same_words(rows, path):
    with served("pty") as (port, device):
        reading = device._source.sample
        device._source.sample = lambda: (0, reading()[1])
        with pytest.raises(WorkError, match=r"200 counts for 0.5 s and the encoder stood still; stopped at row 3\d\d"
                                            + ".*" + CONFIRMED):
            rows.test(port, {"kind": "p", "gain": 2.0})
        assert device.core.drive == 0 and device.core.state == State.IDLE
    assert np.isnan(rows.run.command_sent[-1]) and len(rows.run) == int(rows.run.n[-1]) + 1


# ---- ways out ----

def acting(rows, act):
    """A sink that does something at ROW."""
    def sink(metadata):
        made = rows.sink(metadata)
        keep = made.rows.append
        made.append = lambda row: (keep(row), act() if row[0] == ROW else None)
        return made
    return sink


def raising(error):
    def act():
        raise error
    return act


@pytest.mark.parametrize("line", ["pty", "tcp"])
def test_the_abort_key_stops_the_motor_and_every_row_is_logged(rows, line):
    abort = threading.Event()
    with served(line) as (port, device):
        with pytest.raises(KeyboardInterrupt):
            rows.test(port, rows=20000, log_sink=acting(rows, abort.set), abort=abort)
        assert device.core.drive == 0 and device.core.state == State.IDLE
    counts = rows.sinks[-1].metadata.entries()["counts"]
    assert ROW < len(rows.run) == counts["samples"] == counts["device_samples"] < 20000
    assert np.array_equal(rows.run.n, np.arange(len(rows.run))) and counts["after_stop"] == 0
    assert np.isnan(rows.run.command_sent[-1]) and not np.any(np.isnan(rows.run.command_sent[:-1]))
    assert rows.sinks[-1].metadata.entries()["outcome"] == "interrupted" and rows.sinks[-1].closed


@pytest.mark.parametrize("error", [WorkError("disk full"), KeyboardInterrupt(), MemoryError(), ValueError("no")])
def test_a_log_that_fails_stops_the_motor(rows, error):
    with served("pty") as (port, device):
        with pytest.raises(type(error)) as told:
            rows.test(port, rows=20000, log_sink=acting(rows, raising(error)))
        assert device.core.drive == 0 and device.core.state == State.IDLE
        assert str(told.value) == (f"disk full; {CONFIRMED}" if isinstance(error, WorkError) else str(error))
        assert len(rows.sinks[-1].rows) == ROW + 1 and rows.sinks[-1].closed
        counts = rows.sinks[-1].metadata.entries()["counts"]
        assert counts["device_samples"] == counts["samples"] + counts["after_stop"] < 20000
        assert rows.test(port, relative=True).counts.samples == 600


def test_a_log_that_fails_at_the_last_row_is_told_too(rows):
    with served("pty") as (port, device):
        with pytest.raises(WorkError, match="disk full"):
            rows.test(port, rows=ROW + 1, log_sink=acting(rows, raising(WorkError("disk full"))))
        assert device.core.state == State.IDLE
    assert rows.sinks[-1].metadata.entries()["outcome"].startswith("disk full")


@pytest.mark.parametrize("line", ["pty", "tcp"])
def test_ctrl_c_at_any_moment_stops_the_motor_and_every_row_is_logged(rows, line):
    for wait in (0.0, 1e-4, 3e-4, 1e-3, 3e-3):
        with served(line) as (port, device):
            def later(wait=wait):
                threading.Thread(target=lambda: (time.sleep(wait), _thread.interrupt_main()), daemon=True).start()

            with pytest.raises(KeyboardInterrupt):
                rows.test(port, rows=30000, log_sink=acting(rows, later))
            assert device.core.drive == 0 and device.core.state == State.IDLE
        counts = rows.sinks[-1].metadata.entries()["counts"]
        assert counts["device_samples"] == counts["samples"] + counts["after_stop"] < 30000
        assert ROW < len(rows.run) == counts["samples"] and counts["lost"] == 0
        assert np.array_equal(rows.run.n, np.arange(len(rows.run)))
        assert rows.sinks[-1].metadata.entries()["outcome"] == "interrupted" and rows.sinks[-1].closed


def test_a_signal_to_any_thread_is_handled_at_once_and_changes_nothing(rows):
    """Its handler runs while C has the line, and who waited for signals before hears of them."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    ran, outer = [], signal.set_wakeup_fd(writing)
    handler = signal.signal(signal.SIGUSR1, lambda *given: ran.append(time.monotonic()))
    sent = []
    try:
        def send():
            sent.append(time.monotonic())
            signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)  # the thread that takes the rows

        with served("pty") as (port, _):
            result = rows.test(port, rows=6000, log_sink=acting(rows, send))
        assert signal.set_wakeup_fd(-1) == writing and os.read(reading, 9) == bytes([signal.SIGUSR1])
    finally:
        signal.set_wakeup_fd(outer)
        signal.signal(signal.SIGUSR1, handler)
        os.close(reading)
        os.close(writing)
    assert len(ran) == 1 and ran[0] < sent[0] + 5.0 and (result.counts.samples, result.counts.lost) == (6000, 0)


def test_a_test_in_another_thread_than_the_main_one_runs(rows):
    done = []
    with served("pty") as (port, _):
        thread = threading.Thread(target=lambda: done.append(rows.test(port)))
        thread.start()
        thread.join(60.0)
    assert done[0].sample_path == COMPILED and done[0].counts.samples == len(rows.run) == 600


def test_the_display_sees_the_rows_that_c_answers(rows, monkeypatch):
    monkeypatch.setattr("station.loop.display.PERIOD", 1e-3)
    seen = []
    with served("pty") as (port, _):
        rows.test(port, rows=3000, progress=lambda row, total: seen.append(row))
    assert seen == sorted(seen) and len(set(seen)) > 3 and max(seen) < 3000


def test_rows_that_are_lost_are_skipped_and_python_keeps_the_state(rows):
    """The replay of the log with its gaps: a lost row was stepped with what was read last, in C as in Python."""
    found = []
    for compiled in (True, False):
        with served("pty", faults=Faults(drop=0.02, on=frozenset({"sample"}))) as (port, _), \
                pytest.MonkeyPatch.context() as patch:
            if not compiled:
                patch.setattr("station.loop.run_test.sample_path", lambda *given: INTERPRETED)
            rows.test(port)
        found.append(rows.run)
    shared = min(len(run) for run in found)
    assert shared > 500 and found[0].n.tolist()[:shared] == found[1].n.tolist()[:shared]
    first = int(np.argmax(np.diff(found[0].n) > 1)) + 2  # up to the first loss, whose tick may pass at another moment
    assert found[0].command_sent[:first].tolist() == found[1].command_sent[:first].tolist()


# ---- where it is used ----

def test_where_no_compiler_is_python_answers_and_the_log_says_why(rows, monkeypatch, tmp_path):
    monkeypatch.setattr(builder, "_folders", lambda: [tmp_path])
    monkeypatch.setattr(builder, "compilers", list)
    monkeypatch.setattr(module, "library", module.library.__wrapped__)
    with served("pty") as (port, _):
        result = rows.test(port)
    assert result.counts.samples == 600
    assert result.sample_path.startswith("python (no C compiler") and "\n" not in result.sample_path
    assert rows.sinks[-1].metadata.entries()["sample_path"] == result.sample_path


def test_lines_without_a_descriptor_and_compensators_of_ones_own_stay_with_python(rows):
    class Own(Compensator):
        pass

    with served("tcp") as (port, _), open_port("sim://sflr") as simulated:
        assert sample_path(simulated, rows.compensator()) == INTERPRETED
        assert sample_path(port, Own.from_spec(LEAD, RATE, 200.0)) == INTERPRETED
        assert sample_path(port, rows.compensator()) == COMPILED
        assert port.descriptor == port.serial._socket.fileno()
        port.close()
        assert port.descriptor is None and rows.test(simulated).sample_path == INTERPRETED


def test_the_firmwares_build_number_does_not_know_of_it():
    assert not set(sources()) & set(builder.sources()) - set(firmware_folder().glob("core/*"))
    assert module.SOURCE in sources() and module.SOURCE not in builder.sources()


@pytest.mark.parametrize("compiler", ["gcc", "clang", "zig"])
def test_no_warning_under_the_strict_set(compiler, tmp_path):
    command = next((found for found in compilers() if "ziglang" in found), None) if compiler == "zig" else (
        [compiler] if shutil.which(compiler) else None)
    if command is None:
        pytest.skip(f"no {compiler} here")
    builder.compile_library(command, tmp_path / "exchange.so", (*FLAGS, *WARNINGS), sources())
    assert (tmp_path / "exchange.so").stat().st_size > 1000

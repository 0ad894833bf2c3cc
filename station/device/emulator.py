"""A board's own firmware on an emulated chip (QEMU), with the plant model at its sensors and its drive.

The chip's UART0 is the host's line: a socket of this machine, or a pseudo-terminal.  UART1 comes here: the packets
are those of firmware/boards/mps2_an385/mps2_an385.c.
"""

from __future__ import annotations

import ctypes
import json
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station.device.arm import build_number, image
from station.device.core import Board, library
from station.device.limits import DeviceLimits
from station.device.protocol import BoardFlags, Reset
from station.device.simulated import CLOCK_HZ, Options, Source, rig_source
from station.errors import UsageError, WorkError
from station.rig import Rig

BOARDS = ("mps2_an385",)
QEMU = "qemu-system-arm"
LOOPBACK = "127.0.0.1"
_MAGIC, _SETTINGS_AT = 0x53544131, 0x00010000
_TICK = struct.Struct("<cihB")
_WORD = struct.Struct("<chB")
ENABLED, RUNNING, BEGINNING, ANSWERED = 1, 2, 4, 8
_ANSWER_WAIT = 1.0
"""Real seconds for which a tick in lockstep waits for the host's answer, unless ``answer_wait`` says otherwise."""
_START_SECONDS = 20.0


@dataclass(frozen=True)
class Word:
    """One packet of the board: letter (see the board's source), drive in counts (``B``: the reset's cause), flags."""

    letter: str
    value: int
    flags: int

    @property
    def enabled(self) -> bool:
        """The drive's enable pin."""
        return bool(self.flags & ENABLED)


class PlantEnd:
    """The rig's end of the board's wires: readings to the board, its drive to the plant.

    ``listeners`` are told each word of the board, on the plant's thread; ``input_flags`` (InputFlags) go with every
    reading, for tests.
    """

    def __init__(self, source: Source, period: float, lockstep: bool, line: socket.socket) -> None:
        self._source, self._period, self._lockstep, self._line = source, period, lockstep, line
        self._rest = b""
        self._epoch = self._begun = 0
        self.last = Word("B", 0, 0)
        self.input_flags = 0
        self.answer_wait = _ANSWER_WAIT
        self.listeners: list[Callable[[Word], None]] = []
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _words(self, timeout: float) -> list[Word]:
        """What the board says within the timeout; ConnectionError when it has gone."""
        self._line.settimeout(max(timeout, 1e-6))
        try:
            data = self._line.recv(4096)
        except TimeoutError:
            return []
        if not data:
            raise ConnectionError
        data, words = self._rest + data, []
        while len(data) >= _WORD.size:
            if data[:1] not in b"DSNB":  # a reset has cut a packet short
                data = data[1:]
                continue
            letter, value, flags = _WORD.unpack_from(data)
            data = data[_WORD.size:]
            words.append(Word(letter.decode(), value, flags))
        self._rest = data
        for word in words:
            self.last = word
            self._epoch = word.flags >> 4
            for listener in self.listeners:
                listener(word)
        return words

    def _begin(self) -> bool:
        """Release the rig where a session begins."""
        if not self.last.flags & BEGINNING or self._epoch == self._begun:
            return False
        self._source.begin()
        self._begun = self._epoch
        return True

    def _send_reading(self) -> None:
        encoder, accel = self._source.sample()
        self._line.sendall(_TICK.pack(b"T", encoder, accel, self._epoch << 4 | self.input_flags))

    def command(self, letter: bytes) -> None:
        """Tests: ``I`` stops the board's tick, ``M`` hangs its main loop."""
        self._line.sendall(letter)

    def run(self, stop: threading.Event) -> None:
        """Serve until ``stop``, or until the board's line ends."""
        try:
            if self._lockstep:
                while not stop.is_set():
                    self._wait_for_answer(stop)
                    self._lockstep_tick(stop)
            else:
                self._send_reading()
                while not stop.is_set():
                    self._paced(self._words(0.1))
        except OSError:
            return

    def _wait_for_answer(self, stop: threading.Event) -> None:
        """Until the coming tick is answered; where no session is on, a period."""
        running = bool(self.last.flags & RUNNING)
        deadline = time.perf_counter() + (self.answer_wait if running else self._period)
        while not stop.is_set() and not self.last.flags & ANSWERED:
            if not running and self.last.flags & RUNNING:
                running, deadline = True, time.perf_counter() + self.answer_wait
            left = deadline - time.perf_counter()
            if left <= 0.0:
                return
            self._words(left)

    def _lockstep_tick(self, stop: threading.Event) -> None:
        self._begin()
        self._send_reading()
        while not stop.is_set():
            for word in self._words(0.1):
                if word.letter == "D":
                    self._source.advance(word.value, word.enabled)
                    return
                if word.letter in "SB":
                    return

    def _paced(self, words: list[Word]) -> None:
        for word in words:
            if word.letter == "D":
                self._source.advance(word.value, word.enabled)
            elif word.letter == "B":
                self._source.advance(0, False)
            if self._begin() or word.letter in "DB":
                self._send_reading()


def settings(board: str, rig: Rig, options: Options, boot: int, strict: bool = False) -> bytes:
    """The page of settings that the machine's start puts into the chip's memory."""
    lockstep = options.speed == 0
    about = Board(rig.name, round(rig.sample_rate * 1000.0), int(rig.command_limit), boot, CLOCK_HZ,
                  int(BoardFlags.VIRTUAL_TIME) if lockstep else 0, DeviceLimits.of_rig(rig))
    ffi, _ = library()
    entropy = random.getrandbits(32) if options.seed is None else boot ^ 0x5DEECE66
    page = ffi.new("station_board *", about.structure(build_number(board)))
    return struct.pack("<4I", _MAGIC, lockstep, entropy, strict) + bytes(ffi.buffer(page))


def _die_with_parent() -> None:
    """Linux: the emulator ends when this process does, however that ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


class Emulator:
    """QEMU with a board's image, and the plant at its wires, for as long as the context lasts.

    ``url``: where the host's line is.  ``plant``: the rig's end.  UsageError: no such board, QEMU or compiler missing;
    WorkError: QEMU does not start.
    """

    def __init__(self, rig: Rig, options: Options | None = None, board: str = BOARDS[0], tcp_port: int = 0,
                 pty: bool = False, strict: bool = False) -> None:
        if board not in BOARDS:
            raise UsageError(f"board: {board} cannot be emulated; choose from {', '.join(BOARDS)}")
        if shutil.which(QEMU) is None:
            raise UsageError(f"{board}: {QEMU} is missing; on Debian: apt install qemu-system-arm")
        self._options = options or Options()
        if self._options.faults.any:
            raise UsageError(f"{board}: faults of the line are for sim:// alone")
        self._rig, self._board, self._image = rig, board, image(board)
        self._strict = strict
        self._host = "pty,id=host" if pty else (
            f"socket,id=host,host={LOOPBACK},port={tcp_port},server=on,wait=off,nodelay=on")
        self._stop = threading.Event()
        self._asked = threading.Lock()
        self.process: subprocess.Popen[bytes] | None = None
        self.url = ""

    def __enter__(self) -> Emulator:
        source, period, boot = rig_source(self._rig, self._options)
        with (tempfile.TemporaryDirectory(prefix="station-") as folder,
              socket.create_server((LOOPBACK, 0)) as listener):
            page = Path(folder) / "settings.bin"
            page.write_bytes(settings(self._board, self._rig, self._options, boot, self._strict))
            self._launch(page, listener.getsockname()[1])
            listener.settimeout(_START_SECONDS)
            try:
                line, _ = listener.accept()
                self.ask("qmp_capabilities")
                found = {each["label"]: each["filename"] for each in self.ask("query-chardev")}["host"]
            except (TimeoutError, WorkError):
                self.close()
                said = self.process.stderr.read().decode(errors="replace").split("\n")[0]
                raise WorkError(f"{QEMU}: the emulated board does not start ({said or 'no word from it'})") from None
        self.url = found.split("pty:")[1] if "pty:" in found else (
            f"socket://{LOOPBACK}:{found.split(',')[0].rsplit(':', 1)[1]}")
        self.plant = PlantEnd(source, period, self._options.speed == 0, line)
        self._line = line
        self.ask("cont")
        self.thread = threading.Thread(target=self.plant.run, args=(self._stop,), daemon=True, name="plant")
        self.thread.start()
        return self

    def _launch(self, page: Path, plant_port: int) -> None:
        command = [QEMU, "-M", "mps2-an385", "-display", "none", "-monitor", "none", "-qmp", "stdio", "-S",
                   "-kernel", str(self._image), "-device", f"loader,file={page},addr={_SETTINGS_AT:#x},force-raw=on",
                   "-chardev", self._host, "-serial", "chardev:host",
                   "-chardev", f"socket,id=plant,host={LOOPBACK},port={plant_port},nodelay=on",
                   "-serial", "chardev:plant"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                        preexec_fn=_die_with_parent if sys.platform == "linux" else None)

    def ask(self, command: str) -> Any:
        """One command of QEMU's machine protocol (QMP); its answer."""
        with self._asked:
            try:
                self.process.stdin.write(json.dumps({"execute": command}).encode() + b"\n")
                self.process.stdin.flush()
            except OSError:
                raise WorkError(f"{QEMU}: the emulator has ended") from None
            while line := self.process.stdout.readline():
                answer = json.loads(line)
                if "return" in answer:
                    return answer["return"]
                if "error" in answer:
                    raise WorkError(f"{QEMU}: {answer['error']['desc']}")
            raise WorkError(f"{QEMU}: the emulator has ended")

    def reset(self) -> None:
        """Pull the chip's reset pin."""
        self.ask("system_reset")

    def close(self) -> None:
        """End the emulator."""
        self._stop.set()
        self.process.kill()
        self.process.wait()

    def __exit__(self, *_: object) -> None:
        self.close()
        self.thread.join(timeout=5.0)
        self._line.close()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            pipe.close()


def reset_cause(word: Word) -> Reset:
    """What a ``B`` says."""
    return Reset(word.value)

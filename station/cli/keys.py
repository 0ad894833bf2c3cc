"""The abort key: any of Esc, q and space stops a test, where a terminal is there to press it on."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

KEYS = frozenset(" qQ\x1b")
WORDS = "space, q or Esc stops it"
_WINDOWS_POLL = 0.005


@contextmanager
def abort_key(pressed: Callable[[], None]) -> Iterator[bool]:
    """Call ``pressed`` once, from another thread, when a key of KEYS is hit while the block runs.

    Yields whether keys are heard: standard input must be a terminal and this program in its foreground.  A key that
    was hit before, since the command began, counts.
    """
    over = threading.Event()
    listening = _on_windows(pressed, over) if os.name == "nt" else _on_posix(pressed, over)
    with listening as heard:
        try:
            yield heard
        finally:
            over.set()


@contextmanager
def _on_posix(pressed: Callable[[], None], over: threading.Event) -> Iterator[bool]:
    import select
    import termios
    import tty

    try:
        keyboard = sys.stdin.fileno()
        heard = os.isatty(keyboard) and os.tcgetpgrp(keyboard) == os.getpgrp()
    except (OSError, ValueError, AttributeError):
        heard = False
    if not heard:
        yield False
        return
    before = termios.tcgetattr(keyboard)
    end_reads, end_writes = os.pipe()

    def listen() -> None:
        while not over.is_set():
            ready, _, _ = select.select([keyboard, end_reads], [], [])
            if end_reads in ready:
                return
            if keyboard in ready and KEYS.intersection(os.read(keyboard, 64).decode("latin-1")):
                pressed()
                return

    thread = threading.Thread(target=listen, name="station-abort-key", daemon=True)
    try:
        tty.setcbreak(keyboard, termios.TCSANOW)  # Ctrl-C stays a signal, and keys hit before are not thrown away
        thread.start()
        yield True
    finally:
        over.set()
        os.write(end_writes, b"x")
        thread.join(1.0)
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)
        os.close(end_reads)
        os.close(end_writes)


@contextmanager
def _on_windows(pressed: Callable[[], None], over: threading.Event) -> Iterator[bool]:
    """Never run there."""
    import msvcrt

    if not sys.stdin.isatty():
        yield False
        return

    def listen() -> None:
        while not over.wait(_WINDOWS_POLL):
            if msvcrt.kbhit() and msvcrt.getwch() in KEYS:  # type: ignore[attr-defined]
                pressed()
                return

    thread = threading.Thread(target=listen, name="station-abort-key", daemon=True)
    thread.start()
    try:
        yield True
    finally:
        over.set()
        thread.join(1.0)

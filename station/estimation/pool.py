"""Independent parts of one piece of work, spread over this process and others beside it.

A fit is thousands of short simulations with Python between them, and Python runs one thread of a process at a time: two
threads that fit are little quicker than one.  So the others are processes.  They stay for the next piece of work, and
end with this process.  What one of them does not answer, for whatever reason, is done here: the result is the same.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import IO, Any, TypeVar

import cloudpickle
from threadpoolctl import threadpool_limits

Part = TypeVar("Part")
Result = TypeVar("Result")

SIZE = min(os.cpu_count() or 1, 4)
"""Processes over which work is spread where nothing else is said: a search has about a dozen parts at a time."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Read once, when NumPy is imported: these processes share the cores already."""
BEGIN = ("import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
         "from station.estimation.pool import serve; serve(sys.argv[2])")
"""What such a process is begun with: modules come from the same folders as here, and from no others."""
GONE = (OSError, EOFError, ValueError, pickle.UnpicklingError)
"""What reading or writing raises where the other process has ended, perhaps amid a message."""


class Pool:
    """This process, and ``size`` - 1 others beside it; sent along with a part, it arrives as one of size 1."""

    def __init__(self, size: int = 1, prepare: str = "") -> None:
        """``prepare``: what the others call before anything is asked of them, as "module:function"."""
        self.size = size
        _beside.begin(size - 1, prepare)

    def __reduce__(self) -> tuple[type[Pool], tuple[()]]:
        return Pool, ()

    def map(self, function: Callable[[Part], Result], parts: Iterable[Part]) -> Iterator[Result]:
        """``function`` of every part, in their order; here alone where a map is under way already."""
        parts = list(parts)
        helpers = _beside.taken(min(self.size, len(parts)) - 1)
        try:
            body = _sent(function) if helpers else None
            yield from map(function, parts) if body is None else _spread(function, body, parts, helpers)
        finally:
            if helpers:
                _beside.lock.release()      # the next map may have them


def _sent(what: object) -> bytes | None:
    """As it is sent; None where it cannot be, and is done where it is."""
    with suppress(Exception):
        return cloudpickle.dumps(what)
    return None


def _spread(function: Callable[[Part], Result], body: bytes, parts: list[Part], helpers: list[_Helper],
            ) -> Iterator[Result]:
    """Whoever has done a part takes the next one; what comes back unanswered is done here."""
    left, changed = list(reversed(range(len(parts)))), threading.Condition()
    again: list[int] = []
    done: dict[int, Result] = {}
    complete = False

    def feed(helper: _Helper) -> None:
        told: bytes | None = body
        while helper.alive:
            with changed:
                if not left:
                    return
                k = left.pop()
            answer = helper.ask(told, parts[k])
            with changed:
                if answer is None:
                    again.append(k)
                else:
                    told, done[k] = None, answer[0]
                changed.notify()

    threads = [threading.Thread(target=feed, args=(helper,), daemon=True) for helper in helpers]
    for thread in threads:
        thread.start()
    try:
        for k in range(len(parts)):
            while k not in done:
                with changed:
                    if k in done:
                        break
                    if not (again or left):
                        changed.wait(0.5)       # on Windows Ctrl-C does not end a wait
                        continue
                    mine = (again or left).pop()
                done[mine] = function(parts[mine])
            yield done.pop(k)
        complete = True
    finally:
        with changed:
            left.clear()
        for helper, thread in zip(helpers, threads, strict=True):
            if not complete:
                helper.end()    # it may be at a part that nobody waits for
            thread.join()


class _Helper:
    """A process beside this one that answers one part after the other."""

    def __init__(self, prepare: str) -> None:
        """OSError: it cannot be begun."""
        apart: dict[str, Any] = {"start_new_session": True}     # Ctrl-C is for this process, which ends the others
        if sys.platform == "win32":
            apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
        self.process = subprocess.Popen(    # -P: nothing is imported from the folder that this process happens to be in
            [sys.executable, "-P", "-c", BEGIN, json.dumps(sys.path), prepare], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env={**os.environ, **ONE_THREAD}, **apart)
        assert self.process.stdin is not None and self.process.stdout is not None
        self.asked, self.answers = self.process.stdin, self.process.stdout
        self.alive, self.ready = True, False
        threading.Thread(target=self._await, daemon=True).start()

    def _await(self) -> None:
        """Until it has what it needs nothing is asked: it would keep others waiting."""
        with suppress(*GONE):
            pickle.load(self.answers)
            self.ready = True

    def ask(self, function: bytes | None, part: object) -> tuple[Any] | None:
        """What it answers, None where it does not; ``function``: what it is asked of this part and those to come."""
        sent = _sent(part)
        if sent is None:
            return None
        try:
            _write(self.asked, pickle.dumps((function, sent)))
            found: tuple[Any] | None = pickle.load(self.answers)
        except Exception:       # it has ended, or what it says cannot be read, and of that a rest is in the line
            self.end()
            return None
        return found

    def end(self) -> None:
        """Stop it, whatever it is doing."""
        self.alive = False
        with suppress(OSError):
            self.process.kill()
            self.process.wait()


class _Beside:
    """The processes beside this one, for one map at a time."""

    def __init__(self) -> None:
        self.helpers: list[_Helper] = []
        self.lock = threading.Lock()

    def begin(self, count: int, prepare: str) -> None:
        """Have at least so many, if the system lets this process begin them."""
        if count > 0 and self.lock.acquire(blocking=False):
            try:
                self.helpers = [helper for helper in self.helpers if helper.alive and helper.process.poll() is None]
                with suppress(OSError):
                    while len(self.helpers) < count:
                        self.helpers.append(_Helper(prepare))
            finally:
                self.lock.release()

    def taken(self, most: int) -> list[_Helper]:
        """Those that are ready; none while they are taken, until the lock is released."""
        if most <= 0 or not self.lock.acquire(blocking=False):
            return []
        found = [helper for helper in self.helpers if helper.ready and helper.alive][:most]
        if not found:
            self.lock.release()
        return found

    def end(self) -> None:
        """Stop them all."""
        for helper in self.helpers:
            helper.end()

    def forget(self) -> None:
        """In a copy of this process: they are the other's."""
        self.helpers, self.lock = [], threading.Lock()


_beside = _Beside()
atexit.register(_beside.end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_beside.forget)


def serve(prepare: str) -> None:
    """As a helper: answer until the other side is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asked, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)       # what is printed is no answer
    if prepare:
        module, _, name = prepare.partition(":")
        getattr(importlib.import_module(module), name)()
    with threadpool_limits(1), suppress(*GONE):
        _write(answers, pickle.dumps("ready"))
        function: Callable[[Any], Any] | None = None
        while True:
            body, part = pickle.load(asked)
            try:
                function = function if body is None else pickle.loads(body)
                assert function is not None
                answer = cloudpickle.dumps((function(pickle.loads(part)),))
            except Exception:       # the other side does it again, and finds out why
                answer = cloudpickle.dumps(None)
            _write(answers, answer)


def _write(line: IO[bytes], message: bytes) -> None:
    line.write(message)
    line.flush()

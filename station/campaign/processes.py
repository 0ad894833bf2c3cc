"""Tasks over this machine's cores by the standard library alone: a process per worker, one task at a time."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any, cast

from station.campaign.outcome import Task
from station.estimation.pool import ONE_THREAD

RETRIES = 3
"""How often a task is begun again whose worker was lost."""

Work = Callable[[Task], dict[str, Any]]


def over_processes(work: Work, tasks: Iterable[Task], workers: int) -> Iterator[tuple[Task, dict[str, Any]]]:
    """Give each task with its answer as they end; a lost process costs only its task, which is begun again."""
    waiting = deque((task, 0) for task in tasks)
    idle: list[_Worker] = []
    busy: dict[Connection, tuple[_Worker, Task, int]] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = idle.pop() if idle else _Worker(work)
                if worker.give(waiting[0][0]):
                    busy[worker.line] = (worker, *waiting.popleft())
                else:
                    worker.end()
            for line in cast(list[Connection], wait(list(busy))):
                worker, task, lost = busy.pop(line)
                try:
                    answer = line.recv()
                except (EOFError, OSError):
                    worker.end()
                    if lost < RETRIES:
                        waiting.appendleft((task, lost + 1))
                    else:
                        yield task, {"failure": lost_line(lost + 1)}
                else:
                    idle.append(worker)
                    yield task, answer
    finally:
        for worker in [*idle, *(worker for worker, _, _ in busy.values())]:
            worker.end()


def lost_line(times: int) -> str:
    """The failure of a task that takes its workers with it."""
    return f"its worker was lost {'twice' if times == 2 else f'{times} times'}"


class _Worker:
    """A process that answers one task after the other."""

    def __init__(self, work: Work) -> None:
        context = get_context("spawn")
        for name, value in ONE_THREAD.items():
            os.environ.setdefault(name, value)
        self.line, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there, work), daemon=True)
        self.process.start()
        there.close()

    def give(self, task: Task) -> bool:
        """Whether the worker took it; one that is gone does not."""
        try:
            self.line.send(task)
        except OSError:
            return False
        return True

    def end(self) -> None:
        """Stop it, whatever it is doing."""
        self.process.terminate()
        self.process.join()
        self.process.close()
        self.line.close()


def _serve(line: Connection, work: Work) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # Ctrl-C is for the parent, which ends this process
    try:
        while True:
            line.send(work(line.recv()))
    except (EOFError, OSError):
        return

"""Work spread over processes: in order, whole whatever becomes of them, and nothing of it left behind."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

import station.diagnose
import station.estimation.loaded
from station.estimation import pool as module
from station.estimation.pool import Pool
from station.model.simulate import build
from station.rig import load_rig


def until(ready: Callable[[], bool]) -> None:
    """Wait for what another process does, 30 s at most."""
    end = time.monotonic() + 30.0
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def pool() -> Iterator[Pool]:
    """Of two processes, both ready."""
    found = Pool(2)
    until(lambda: all(helper.ready for helper in module._beside.helpers))
    yield found
    module._beside.end()


def slowly(part: int) -> tuple[int, int]:
    """The part and the process that did it."""
    time.sleep(0.05)
    return part, os.getpid()


def test_parts_come_back_in_order_from_both_processes(pool: Pool) -> None:
    found = list(pool.map(slowly, range(10)))
    assert [part for part, _ in found] == list(range(10))
    assert len({process for _, process in found}) == 2 and os.getpid() in {process for _, process in found}
    assert list(pool.map(slowly, [])) == [] and next(pool.map(slowly, [3])) == (3, os.getpid())


def test_results_are_given_out_as_they_come(pool: Pool) -> None:
    given = iter(pool.map(slowly, range(4)))
    assert next(given)[0] == 0
    given.close()       # nobody wants the others
    assert [part for part, _ in Pool(2).map(slowly, range(3))] == [0, 1, 2]


def test_a_failure_is_raised_as_it_was(pool: Pool) -> None:
    def inverse(part: int) -> float:
        time.sleep(0.02)
        return 1.0 / part

    with pytest.raises(ZeroDivisionError):
        list(pool.map(inverse, [1, 2, 0, 4, 5]))
    assert list(Pool(2).map(inverse, [1, 2])) == [1.0, 0.5]


def test_what_a_lost_process_leaves_is_done_here(pool: Pool) -> None:
    mine = os.getpid()

    def deadly(part: int) -> int:
        time.sleep(0.02)
        if os.getpid() != mine:
            os._exit(1)
        return part

    assert list(pool.map(deadly, range(6))) == list(range(6))
    assert not any(helper.alive for helper in module._beside.helpers)
    Pool(2)
    assert any(helper.alive for helper in module._beside.helpers)


@pytest.mark.parametrize("prepare", [station.diagnose.PREPARE, station.estimation.loaded.PREPARE])
def test_who_could_not_load_what_is_needed_is_begun_anew(prepare: str) -> None:
    """And what diagnoses and fits name as needed can be loaded: else all would be done by one process."""
    module._beside.end()
    Pool(2, "station.diagnose.diagnose:nothing_of_this_name")
    [lost] = [helper for helper in module._beside.helpers if helper.alive]
    until(lambda: lost.process.poll() is not None)
    pool = Pool(2, prepare)
    until(lambda: any(helper.ready for helper in module._beside.helpers))
    assert len({process for _, process in pool.map(slowly, range(4))}) == 2
    module._beside.end()


def test_what_cannot_be_sent_is_done_here(pool: Pool) -> None:
    def answer(part: object) -> object:
        time.sleep(0.02)
        return threading.Lock() if part is None else part

    assert [part for part, _ in pool.map(slowly, range(4))] == list(range(4))
    parts = [threading.Lock(), threading.Lock(), *"abcdef"]     # those that can be are sent with what is asked of them
    assert list(pool.map(answer, parts)) == parts
    assert len(list(pool.map(answer, [None] * 4))) == 4
    held = threading.Lock()
    assert list(pool.map(lambda part: (slowly(part), held.locked())[1], range(4))) == [False] * 4


def test_a_map_within_a_map_is_done_in_place(pool: Pool) -> None:
    def inner(part: int) -> tuple[int, set[int]]:
        return pool.size, {process for _, process in pool.map(slowly, range(3))}

    found = list(pool.map(inner, range(4)))
    assert all(len(processes) == 1 for _, processes in found)
    assert {size for size, processes in found if processes != {os.getpid()}} == {1}


def test_what_a_part_prints_is_no_answer(pool: Pool) -> None:
    def loud(part: int) -> int:
        time.sleep(0.02)
        print("x" * 100_000)
        os.write(1, b"y" * 1000)
        return part

    assert list(pool.map(loud, range(6))) == list(range(6))


def test_two_threads_do_not_wait_for_each_other(pool: Pool) -> None:
    found: list[list[tuple[int, int]]] = []
    others = [threading.Thread(target=lambda: found.append(list(pool.map(slowly, range(5))))) for _ in range(3)]
    for other in others:
        other.start()
    for other in others:
        other.join(20.0)
    assert [[part for part, _ in parts] for parts in found] == [list(range(5))] * 3


@pytest.mark.parametrize("end", ["its own", "terminated", "killed"])
def test_no_process_is_left_behind(end: str, tmp_path: Path) -> None:
    """Begun in a folder with a module of a name that they import."""
    (tmp_path / "json.py").write_text("raise RuntimeError", encoding="utf-8")
    script = ("import sys, time; from station.estimation.pool import Pool, _beside; Pool(3)\n"
              "while not all(h.ready for h in _beside.helpers): time.sleep(0.01)\n"
              "print(*[h.process.pid for h in _beside.helpers], flush=True)\n"
              "sys.stdin.read()")
    child = subprocess.Popen([sys.executable, "-P", "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                             text=True, cwd=tmp_path)
    assert child.stdin is not None and child.stdout is not None
    helpers = [int(text) for text in child.stdout.readline().split()]
    assert len(helpers) == 2
    {"its own": child.stdin.close, "terminated": child.terminate, "killed": child.kill}[end]()
    child.wait(20.0)

    def gone(process: int) -> bool:
        try:
            return psutil.Process(process).status() == psutil.STATUS_ZOMBIE     # dead, and not yet asked for
        except psutil.NoSuchProcess:
            return True

    until(lambda: all(gone(process) for process in helpers))
    child.stdout.close()


def test_a_model_is_not_sent_to_another_process() -> None:
    with pytest.raises(TypeError, match="send its rig"):
        pickle.dumps(build(load_rig("sflr")))


class Unreadable:
    """An answer that cannot be read."""

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return __import__, ("no_such_module",)


def test_an_answer_that_cannot_be_read_is_worked_out_here(pool: Pool) -> None:
    mine = os.getpid()

    def answer(part: int) -> object:
        time.sleep(0.02)
        return part if os.getpid() == mine else Unreadable()

    assert list(pool.map(answer, range(6))) == list(range(6))
    assert not any(helper.alive for helper in module._beside.helpers)

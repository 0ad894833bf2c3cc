"""Real-time mode: what the operating system offers so that nothing disturbs the thread that answers samples.

Each wish is asked for alone; what was granted and what was not, and why, is told and logged.  Linux: SCHED_FIFO,
memory locked, the thread on one core, cores kept awake.  macOS: the thread's time-constraint policy.  Windows:
the thread's highest priority, the process's high priority class, one core, a timer of 1 ms.  Everywhere: garbage
collection off and what exists frozen.  The parts for macOS and Windows were never run there.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial

PRIORITY = 50
"""SCHED_FIFO: above ordinary threads, with room above for the kernel's own interrupt threads."""
_LOCK_CURRENT, _LOCK_FUTURE = 1, 2
_DMA_LATENCY = "/dev/cpu_dma_latency"
_CPUINFO = "/proc/cpuinfo"


@dataclass(frozen=True)
class Realtime:
    """What was asked for and granted, and what was not with the system's reason."""

    got: tuple[str, ...]
    missing: tuple[str, ...]

    def as_dict(self) -> dict[str, list[str]]:
        """For metadata and JSON."""
        return {name: list(words) for name, words in asdict(self).items()}

    def words(self) -> str:
        """One sentence."""
        got = "real-time mode: " + (", ".join(self.got) or "nothing was granted")
        return got + (f"; not granted: {', '.join(self.missing)}" if self.missing else "")


Wish = tuple[str, Callable[[ExitStack], None]]
"""What it is, and a function that brings it about and leaves its undoing on the stack; OSError where refused."""


@contextmanager
def undisturbed_thread(wanted: bool, alone: bool = False, terminal: bool = False) -> Iterator[Realtime | None]:
    """The calling thread in real-time mode while the block runs; all is put back at its end.  None: not wanted.

    ``alone``: it answers without the interpreter, and the process's other threads stay as they are.  ``terminal``: its
    line is a serial port or a pseudo-terminal.
    """
    if not wanted:
        yield None
        return
    got, missing = [], []
    with ExitStack() as undo:
        for name, bring in _wishes(alone, terminal):
            try:
                bring(undo)
                got.append(name)
            except (OSError, AttributeError, ValueError) as error:
                missing.append(f"{name} ({getattr(error, 'strerror', None) or error})")
        yield Realtime(tuple(got), tuple(missing))


def _wishes(alone: bool, terminal: bool) -> list[Wish]:
    own: list[Wish]
    if sys.platform == "win32":
        own = [("highest thread priority", _windows_priority), ("one core", _windows_core),
               ("timer of 1 ms", _windows_timer)]
    elif sys.platform == "darwin":
        own = [("time-constraint scheduling", _macos_policy)]
    else:
        own = [("memory locked", _lock_memory), ("one core", _one_core),
               ("cores kept awake", partial(_stay_awake, terminal)), ("SCHED_FIFO", _fifo)]
        if not alone:
            own.append(("its other threads next (SCHED_FIFO)", _others_too))
    return [("garbage collection frozen", _freeze), *own]


def _freeze(undo: ExitStack) -> None:
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    undo.callback(gc.enable if enabled else gc.disable)
    undo.callback(gc.unfreeze)


# ---- Linux ----

def _fifo(undo: ExitStack) -> None:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    undo.callback(os.sched_setscheduler, 0, policy, parameters)


def _others_too(undo: ExitStack) -> None:
    """This process's other threads, below the loop's: one that holds the interpreter's lock while the system runs some
    other program would hold up the loop, whatever the loop's own priority."""
    for thread in threading.enumerate():
        number = thread.native_id
        if number is None or thread is threading.current_thread():
            continue
        policy, parameters = os.sched_getscheduler(number), os.sched_getparam(number)
        os.sched_setscheduler(number, os.SCHED_FIFO, os.sched_param(PRIORITY - 10))
        undo.callback(_put_back, number, policy, parameters)


def _put_back(number: int, policy: int, parameters: os.sched_param) -> None:
    with suppress(OSError):  # a thread that has ended meanwhile
        os.sched_setscheduler(number, policy, parameters)


def _one_core(undo: ExitStack) -> None:
    """The last core that is allowed: interrupts tend to be served by the first."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    undo.callback(os.sched_setaffinity, 0, allowed)


def _lock_memory(undo: ExitStack) -> None:
    import resource

    libc = ctypes.CDLL(None, use_errno=True)
    unlimited = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    future = _LOCK_FUTURE if unlimited else 0  # within a limit, locking what comes makes later allocations fail
    if libc.mlockall(_LOCK_CURRENT | future) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    undo.callback(libc.munlockall)


def _stay_awake(terminal: bool, undo: ExitStack) -> None:
    """While this file is open with 0 in it, the kernel enters no sleep state that takes long to leave.

    In a virtual machine idle cores then spin, which uses up their share of the host's, and the host stalls them: 6 ms
    at a time where this was measured, on a period of 100 ms (``scripts/bench/loop_paced.py``: docs/lab.md).  So there a
    socket goes without.  A terminal's bytes pass through a kernel thread of ordinary priority, which a core that sleeps
    takes up late: on such a line spinning does more good than harm.
    """
    with open(_CPUINFO, encoding="utf-8") as told:
        if not terminal and any(line.startswith("flags") and " hypervisor" in line for line in told):
            raise OSError("in a virtual machine idle cores would spin, and its host stall them")
    file = os.open(_DMA_LATENCY, os.O_WRONLY)
    undo.callback(os.close, file)
    os.write(file, (0).to_bytes(4, sys.byteorder))


# ---- macOS, never run there ----

def _macos_policy(undo: ExitStack) -> None:
    """THREAD_TIME_CONSTRAINT_POLICY (mach/thread_policy.h): 0.5 ms of work in each 2 ms; ends with the thread."""
    system = ctypes.CDLL(None, use_errno=True)
    ticks = _mach_ticks_per_second(system)
    policy = (ctypes.c_uint32 * 4)(int(2e-3 * ticks), int(0.5e-3 * ticks), int(1e-3 * ticks), 1)
    system.mach_thread_self.restype = ctypes.c_uint32
    status = system.thread_policy_set(system.mach_thread_self(), 2, policy, 4)
    if status != 0:
        raise OSError(f"thread_policy_set returned {status}")
    standard = (ctypes.c_uint32 * 1)(0)
    undo.callback(lambda: system.thread_policy_set(system.mach_thread_self(), 1, standard, 0))


def _mach_ticks_per_second(system: ctypes.CDLL) -> float:
    ratio = (ctypes.c_uint32 * 2)()
    system.mach_timebase_info(ratio)
    return 1e9 * ratio[1] / ratio[0]


# ---- Windows, never run there ----

def _kernel32() -> ctypes.CDLL:
    kernel = ctypes.WinDLL("kernel32", use_last_error=True)  # type: ignore[attr-defined]
    for name in ("GetCurrentThread", "GetCurrentProcess"):
        getattr(kernel, name).restype = ctypes.c_void_p
    for name in ("SetThreadPriority", "SetPriorityClass", "SetThreadAffinityMask"):
        getattr(kernel, name).argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    return kernel


def _windows_priority(undo: ExitStack) -> None:
    kernel = _kernel32()
    high, normal, critical = 0x80, 0x20, 15
    if not (kernel.SetPriorityClass(kernel.GetCurrentProcess(), high)
            and kernel.SetThreadPriority(kernel.GetCurrentThread(), critical)):
        raise ctypes.WinError(ctypes.get_last_error())  # type: ignore[attr-defined]
    undo.callback(kernel.SetPriorityClass, kernel.GetCurrentProcess(), normal)
    undo.callback(kernel.SetThreadPriority, kernel.GetCurrentThread(), 0)


def _windows_core(undo: ExitStack) -> None:
    kernel = _kernel32()
    kernel.SetThreadAffinityMask.restype = ctypes.c_size_t
    before = kernel.SetThreadAffinityMask(kernel.GetCurrentThread(), 1 << ((os.cpu_count() or 1) - 1))
    if not before:
        raise ctypes.WinError(ctypes.get_last_error())  # type: ignore[attr-defined]
    undo.callback(kernel.SetThreadAffinityMask, kernel.GetCurrentThread(), before)


def _windows_timer(undo: ExitStack) -> None:
    timers = ctypes.WinDLL("winmm")  # type: ignore[attr-defined]
    if timers.timeBeginPeriod(1) != 0:
        raise OSError("timeBeginPeriod was refused")
    undo.callback(timers.timeEndPeriod, 1)

"""The command line: joins the loop and the diagnosis, and turns every failure into one line."""

from __future__ import annotations

import _thread
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import CodeType, FrameType

from station.errors import StationError

TRACEBACK = "STATION_TRACEBACK"
"""Environment variable that shows the traceback of an error, for those who mend it."""

INTERRUPTED = 130
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""Environment variables read once, when NumPy is imported.  On matrices as small as a rig's, threads only wait."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status: 0 done, 1 the work failed, 2 wrong use, 130 interrupted."""
    interruption = _Interruption(arguments is None)
    for name in THREADS:
        os.environ.setdefault(name, "1")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            status = _status(list(sys.argv[1:] if arguments is None else arguments), interruption)
        except (KeyboardInterrupt, Exception):  # also what an import made of it, before _status could tell
            if not interruption.came:
                raise
            status = INTERRUPTED
        if status == INTERRUPTED:
            print("station: interrupted", file=sys.stderr)
    finally:
        interruption.end()
    if arguments is None:   # the program ends: or Python looks through all that was imported once more, for 0.3 s
        gc.freeze()
    sys.exit(status)


def raise_interrupt() -> None:
    """KeyboardInterrupt where Ctrl-C has come: before a motor is armed, lest an import has swallowed it."""
    if _Interruption.last is not None and _Interruption.last.came:
        raise KeyboardInterrupt


@contextmanager
def motor_driven() -> Iterator[None]:
    """Around what drives a motor: an earlier Ctrl-C ends it here, and what a later one says of the motor is told."""
    raise_interrupt()
    try:
        yield
    except KeyboardInterrupt as error:  # typer keeps no more of it than that it came
        if str(error):
            print(f"station: {error}", file=sys.stderr)
        raise


def _runs(code: CodeType) -> bool:
    """Whether the main thread is in some code."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None and frame.f_code is not code:
        frame = frame.f_back
    return frame is not None


class _Interruption:
    """Ctrl-C, told in one line whatever it meets: an import that it turns into another error, a callback that
    swallows it.  Only where this is the main thread and nobody else handles it."""

    last: _Interruption | None = None

    def __init__(self, at_the_end: bool = False) -> None:
        """``at_the_end``: the process ends after ``end``, and a Ctrl-C that comes then ends it without a word."""
        self.came = False
        _Interruption.last = self
        self._after = signal.SIG_DFL if at_the_end else signal.default_int_handler
        self._hook = sys.unraisablehook
        self._installed = False
        try:
            if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
                signal.signal(signal.SIGINT, self._handle)
                sys.unraisablehook = self._unraisable
                self._installed = True
        except ValueError:
            pass

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        raise KeyboardInterrupt

    def _unraisable(self, lost: sys.UnraisableHookArgs) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            threading.Thread(target=self._again, daemon=True).start()
        elif not self.came:     # else of what Ctrl-C left half made, as LLVM's values
            self._hook(lost)

    def _again(self) -> None:
        """Interrupt once more, when the main thread is out of the hook: there it would be swallowed again."""
        while _runs(_Interruption._unraisable.__code__):
            time.sleep(1e-3)
        _thread.interrupt_main()

    def end(self) -> None:
        """As it was before."""
        _Interruption.last = None
        if self._installed:
            sys.unraisablehook = self._hook
            signal.signal(signal.SIGINT, self._after)


def _status(arguments: list[str], interruption: _Interruption) -> int:
    from typer import Abort, TyperException

    from station.cli.app import build
    from station.cli.terminal import one_line

    try:
        try:
            status = build()(arguments or ["--help"], prog_name="station", standalone_mode=False)
            sys.stdout.flush()
            if status == INTERRUPTED:
                raise KeyboardInterrupt
            return status if isinstance(status, int) else 0
        except Exception:
            if os.environ.get(TRACEBACK):
                import traceback
                traceback.print_exc()
            raise
    except StationError as error:
        message, status = str(error), error.exit_status
    except TyperException as error:
        message, status = error.format_message(), error.exit_code
    except (Abort, KeyboardInterrupt):
        return INTERRUPTED
    except BrokenPipeError:             # the reader of our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        message, status = f"{where}{error.strerror or error}", 1
    except MemoryError:
        message, status = "not enough memory for this", 1
    except Exception as error:
        if interruption.came:
            return INTERRUPTED
        message = f"a fault of Station itself: {type(error).__name__}: {error} ({TRACEBACK}=1 shows where)"
        status = 1
    print(f"station: {one_line(message)}", file=sys.stderr)
    return status

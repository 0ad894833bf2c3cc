"""The command line: joins the loop and the diagnosis, and turns every failure into one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from station.errors import StationError

TRACEBACK = "STATION_TRACEBACK"
"""Environment variable that shows the traceback of an error, for those who mend it."""

INTERRUPTED = 130
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""Environment variables read once, when NumPy is imported.  On matrices as small as a rig's, threads only wait."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status: 0 done, 1 the work failed, 2 wrong use, 130 interrupted."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(_status(list(sys.argv[1:] if arguments is None else arguments)))


def _status(arguments: list[str]) -> int:
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
        message, status = "interrupted", INTERRUPTED
    except BrokenPipeError:             # the reader of our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        message, status = f"{where}{error.strerror or error}", 1
    except MemoryError:
        message, status = "not enough memory for this", 1
    except Exception as error:
        message = f"a fault of Station itself: {type(error).__name__}: {error} ({TRACEBACK}=1 shows where)"
        status = 1
    print(f"station: {one_line(message)}", file=sys.stderr)
    return status

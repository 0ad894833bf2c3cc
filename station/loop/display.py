"""A display beside the loop: it looks at the session from a thread of its own and can neither delay nor end it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from station.loop.engine import Session

PERIOD = 0.1
"""Seconds between two looks."""
_PATIENCE = 0.5
"""Seconds that a display may take to end; one that hangs is left to itself."""


@contextmanager
def watched(session: Session, tell: Callable[[int], None] | None) -> Iterator[None]:
    """Call ``tell(row)`` about ten times a second while the block runs; what it raises ends the display alone."""
    if tell is None:
        yield
        return
    over = threading.Event()

    def look() -> None:
        try:
            while not over.wait(PERIOD):
                tell(session.row)
        except Exception:      # a display that fails shows no more, and the test goes on
            return

    thread = threading.Thread(target=look, name="station-display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(_PATIENCE)

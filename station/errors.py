"""The two ways in which a request can end badly, each shown to people as one line; and text made fit to be shown."""


class StationError(Exception):
    """A failure with a message for people: what (file, field, port), what was wrong, what to do."""

    exit_status = 1


class UsageError(StationError):
    """Wrong use: arguments, port names, rig and plan files. Exit status 2."""

    exit_status = 2


class WorkError(StationError):
    """The work failed: unreadable runs, lines, devices. Exit status 1."""

    exit_status = 1


def printable(text: object) -> str:
    """``text`` with every character that a terminal might obey written as an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text))

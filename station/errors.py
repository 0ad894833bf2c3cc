"""The two ways in which a request can end badly, each shown to people as one line."""


class StationError(Exception):
    """A failure with a message for people: what (file, field, port), what was wrong, what to do."""

    exit_status = 1


class UsageError(StationError):
    """Wrong use: arguments, port names, rig and plan files. Exit status 2."""

    exit_status = 2


class WorkError(StationError):
    """The work failed: unreadable runs, lines, devices. Exit status 1."""

    exit_status = 1

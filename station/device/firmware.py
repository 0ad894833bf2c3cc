"""Where the firmware's sources are: beside the package in a checkout, inside it in an installation."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from station.errors import WorkError

_PACKAGE = Path(__file__).resolve().parents[1]


@cache
def firmware_folder() -> Path:
    """The folder that holds protocol.toml, core/ and boards/."""
    for folder in (_PACKAGE.parent / "firmware", _PACKAGE / "firmware"):
        if (folder / "protocol.toml").is_file():
            return folder
    raise WorkError(f"{_PACKAGE / 'firmware'}: the firmware's sources are missing; install Station again")

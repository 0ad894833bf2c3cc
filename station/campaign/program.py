"""What the answers of a campaign depend on: the sources of the program that gives them."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEPENDS = ("rig.py", "rigs", "control", "diagnose", "model", "runs", "campaign/outcome.py", "campaign/hidden.py",
           "campaign/battery.py", "campaign/simulated.py", "campaign/logs.py")
"""Parts of the package; neither commands nor pages change an answer."""


@cache
def program_hash() -> str:
    """Changes whenever an answer could; effects of a user's own belong to it."""
    from station.model.effects import catalogue

    others = {sys.modules[effect.__module__].__file__ for effect in catalogue().values()}
    return sources_hash([*(ROOT / part for part in DEPENDS),
                         *sorted(Path(file) for file in others if file and not Path(file).is_relative_to(ROOT))])


def sources_hash(paths: Iterable[Path]) -> str:
    """Of Python and TOML files, and of those in folders; where they lie does not matter."""
    digest = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.suffix in (".py", ".toml"):
                digest.update(f"{file.relative_to(path.parent).as_posix()}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]

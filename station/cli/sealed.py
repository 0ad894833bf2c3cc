"""A rig file under seal: its hash is told first, its content last."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from station.rig import Rig


@dataclass(frozen=True)
class Sealed:
    """A rig file that nobody opens before the end; its hash is told at once."""

    path: Path
    sha256: str

    @classmethod
    def write(cls, rig: Rig, path: Path) -> Sealed:
        """Write the rig, readable by this user alone."""
        data = rig.to_toml().encode("utf-8")
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
        return cls(path, hashlib.sha256(data).hexdigest())

    def open(self) -> Rig:
        """Read it, after making sure that it is what was sealed."""
        data = self.path.read_bytes()
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise ValueError(f"{self.path}: not the file that was sealed")
        return Rig.from_toml(data.decode("utf-8"), source=str(self.path))

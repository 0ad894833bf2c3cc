"""Simulated rigs with a hidden effect that come with Station: ``sim://sealed-1`` and the like.

A seal holds a rig file, deflated and in base64, so that nobody reads it by accident; `station unseal` opens it.
``python -m station.device.sealed FILE.toml NAME`` makes one.
"""

from __future__ import annotations

import base64
import hashlib
import sys
import textwrap
import zlib
from importlib import resources
from pathlib import Path

from station.errors import UsageError
from station.rig import Rig, load_rig

ENDING = ".seal"
_HEAD = "# A rig with a hidden effect: `station unseal` opens it.\n"


def sealed_rigs() -> list[str]:
    """Names of the sealed rigs, in their order."""
    folder = resources.files("station") / "rigs"
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(ENDING))


def sealed_text(name: str) -> str:
    """The rig file under a seal; UsageError where there is none of this name."""
    if name not in sealed_rigs():
        raise UsageError(f"{name}: no sealed rig; there are {', '.join(sealed_rigs())}")
    text = (resources.files("station") / "rigs" / f"{name}{ENDING}").read_text(encoding="ascii")
    return zlib.decompress(base64.b64decode(text.removeprefix(_HEAD))).decode("utf-8")


def fingerprint(name: str) -> str:
    """SHA-256 of the rig file under a seal, by which an opened one is known for the very one that was tested."""
    return hashlib.sha256(sealed_text(name).encode("utf-8")).hexdigest()


def simulated_rig(name: str) -> Rig:
    """The rig behind a simulated port: a sealed one, a built-in one, or a file's."""
    return Rig.from_toml(sealed_text(name), source=name) if name in sealed_rigs() else load_rig(name)


def seal(rig: Rig, path: Path) -> None:
    """Write a rig under seal."""
    packed = base64.b64encode(zlib.compress(rig.to_toml().encode("utf-8"), 9)).decode("ascii")
    path.write_text(_HEAD + "\n".join(textwrap.wrap(packed, 100)) + "\n", encoding="ascii")


if __name__ == "__main__":
    seal(load_rig(sys.argv[1]), Path(__file__).parents[1] / "rigs" / f"{sys.argv[2]}{ENDING}")

"""Which rigs have passed `station check` on which device: remembered from one command to the next.

A check holds for one power-up of one device with one firmware, and for one rig file (its uncertainty aside, which
says nothing of signs and wiring): a board that was reset or powered down may have been wired anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

import platformdirs

from station.device.client import Identity
from station.errors import UsageError
from station.rig import Rig

KEPT = 200
"""So many passed checks are remembered, the latest."""
_SIMULATED = ("sim://", "replay://", "qemu://")


def store() -> Path:
    """The file that remembers, in the user's folder of program states."""
    return Path(platformdirs.user_state_dir("station", appauthor=False)) / "checks.json"


def _rig_key(rig: Rig) -> str:
    described = rig.model_copy(update={"uncertainty": {}}).to_toml()
    return hashlib.sha256(described.encode()).hexdigest()[:16]


def _entry(identity: Identity, rig: Rig) -> dict[str, Any]:
    return {"board": identity.board, "build": f"{identity.build:08x}", "boot": f"{identity.boot:08x}",
            "rig": rig.name, "rig_key": _rig_key(rig)}


def _read() -> list[dict[str, Any]]:
    try:
        found = json.loads(store().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [entry for entry in found if isinstance(entry, dict)] if isinstance(found, list) else []


def remember(identity: Identity, rig: Rig) -> None:
    """Note a check that was passed.  OSError where the file cannot be written."""
    entry = _entry(identity, rig) | {"passed": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    path = store()
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_text(json.dumps([*_read(), entry][-KEPT:], indent=1) + "\n", encoding="utf-8")
    os.replace(part, path)


def forget(identity: Identity, rig: Rig) -> None:
    """Take back what was noted of this device and rig: it has failed a check since.  OSError as in ``remember``."""
    wanted = _entry(identity, rig)
    left = [entry for entry in _read() if not wanted.items() <= entry.items()]
    if len(left) < len(_read()):
        store().write_text(json.dumps(left, indent=1) + "\n", encoding="utf-8")


def passed(identity: Identity, rig: Rig) -> str | None:
    """When this device, since its power-up, passed a check as this rig (UTC); None: never."""
    wanted = _entry(identity, rig)
    times = [str(entry.get("passed")) for entry in _read() if wanted.items() <= entry.items()]
    return times[-1] if times else None


def is_simulated(url: str, identity: Identity) -> bool:
    """Whether no motor can be behind this: a simulated rig's URL, or a device whose time waits for the host."""
    return identity.virtual_time or url.startswith(_SIMULATED)


def require(url: str, identity: Identity, rig: Rig, force: bool) -> str:
    """What the log says of the check: ``simulated``, when it was passed, or ``forced``.

    UsageError where the rig may be real, no check of it is known, and nobody has said ``force``.
    """
    if is_simulated(url, identity):
        return "simulated"
    when = passed(identity, rig)
    if when is None and not force:
        raise UsageError(f"{url}: no passed check of this device as rig {rig.name} since it was powered up; a closed "
                         f"loop with a wrong sign runs away: `station check --port {url} --rig RIG` first "
                         "(--force goes without, and the log says so)")
    return when or "forced"

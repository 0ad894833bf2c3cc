"""The compensators that `--controller` names, and files of one's own."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from station.control.named import NAMED, SAMPLED_AT
from station.errors import UsageError

MAX_FILE_BYTES = 1 << 20


def controller_spec(name_or_path: str, sample_rate: float, **changes: float | None) -> dict[str, Any]:
    """The controller's dictionary by name or from a TOML file, with some of its numbers changed.

    ``sample_rate``, Hz, is that of the loop: a compensator that is given already sampled fits one rate alone.
    """
    if name_or_path == "lead-accel" and sample_rate != SAMPLED_AT:
        raise UsageError(f"--controller lead-accel: sampled at {SAMPLED_AT:g} Hz, the rig runs at {sample_rate:g} Hz; "
                         "give a TOML file with its coefficients at that rate")
    spec = dict(NAMED[name_or_path]) if name_or_path in NAMED else _read(Path(name_or_path), sample_rate)
    for key, value in changes.items():
        if value is None:
            continue
        if key not in spec:
            raise UsageError(f"--{key}: controller {name_or_path} has no {key}")
        spec[key] = value
    return spec


def _read(path: Path, sample_rate: float) -> dict[str, Any]:
    from station.control.compensators import Compensator

    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UsageError(f"{path}: larger than 1 MiB, which no controller file is")
        spec = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"--controller {path}: {reason}; by name: {', '.join(NAMED)}") from None
    try:
        Compensator.from_spec(spec, sample_rate, 1.0)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    return spec

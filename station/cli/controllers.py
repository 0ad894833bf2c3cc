"""The compensators that `--controller` names, and files of one's own."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

from station.errors import UsageError

MAX_FILE_BYTES = 1 << 20
SAMPLED_AT = 500.0
LEAD = {"gain": 20.0, "zero": 10.0 * math.pi, "pole": 40.0 * math.pi}
NAMED: dict[str, dict[str, Any]] = {
    "open": {"kind": "open"},
    "p": {"kind": "p", "gain": 2.0},
    "lead": {"kind": "lead", **LEAD},
    "lead-accel": {
        "kind": "lead_accel", **LEAD,
        "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
        "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]},
}
"""Those of the thesis; the accelerometer's compensator is sampled, as its log's header gives it."""


def controller_spec(name_or_path: str, sample_rate: float, **changes: float | None) -> dict[str, Any]:
    """The controller's dictionary by name or from a TOML file, with some of its numbers changed.

    ``sample_rate``, Hz, is that of the loop: a compensator that is given already sampled fits one rate alone.
    """
    if name_or_path == "lead-accel" and sample_rate != SAMPLED_AT:
        raise UsageError(f"--controller lead-accel: sampled at {SAMPLED_AT:g} Hz, the rig runs at {sample_rate:g} Hz; "
                         "give a TOML file with its coefficients at that rate")
    spec = dict(NAMED[name_or_path]) if name_or_path in NAMED else _read(Path(name_or_path))
    for key, value in changes.items():
        if value is None:
            continue
        if key not in spec:
            raise UsageError(f"--{key}: controller {name_or_path} has no {key}")
        spec[key] = value
    return spec


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UsageError(f"{path}: larger than 1 MiB, which no controller file is")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"--controller {path}: {reason}; by name: {', '.join(NAMED)}") from None

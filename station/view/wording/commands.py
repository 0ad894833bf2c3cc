"""Tests in words, and as the command lines that run them."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

from station.control.named import named_controller
from station.control.references import KINDS, defaults
from station.view.wording.names import plain, sentence

if TYPE_CHECKING:
    from station.diagnose.result import Diagnosis, NextExperiment


def test_words(test: dict[str, Any] | None) -> str:
    """A test in words: ``pulse, amplitude 60, duration 2.0``."""
    if not test:
        return "not stated"
    rest = [f"{key.replace('_', ' ')} {_short(value)}" for key, value in test.items() if key != "kind"]
    return ", ".join([str(test.get("kind", "test")), *rest])


def _short(value: Any) -> str:
    """A value of a test or controller: numbers with six digits, lists in brackets."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def run_command(test: dict[str, Any], port: str = "PORT", rig: str = "RIG") -> str:
    """The command line that runs a test, as one types it; the test in words where the station has no such kind."""
    kind = str(test.get("kind"))
    if kind not in KINDS:
        return test_words(test)
    usual, spec = defaults(kind), test.get("controller")
    words = ["station", "run", kind.replace("_", "-"), "--port", port, "--rig", rig]
    name = kind
    if isinstance(spec, dict):
        known = named_controller(spec)
        name = f"{kind}-{known[0] if known else 'own'}"
        words += ["--controller", known[0] if known else "CONTROLLER.toml"]
        words += [word for key, value in (known[1] if known else {}).items() for word in (f"--{key}", f"{value:.12g}")]
    for key, value in test.items():
        if key in usual and (key in ("amplitude", "duration") or value != usual[key]):
            words += [f"--{key}", f"{value:.12g}" if isinstance(value, int | float) else str(value)]
    size = test.get("amplitude")
    name += f"-{abs(size):g}" if isinstance(size, int | float) else ""
    return shlex.join([*words, "--out", f"{name}.mcap"])


def next_test(asked: NextExperiment, rig: str) -> str:
    """The next experiment as a sentence: the command to type, and why."""
    words = f"{run_command(asked.test, rig=rig)}\n" if asked.test else ""
    return f"{words}{sentence(plain(asked.why))}"


def no_test(diagnosis: Diagnosis) -> str:
    """Why no next experiment is named."""
    if diagnosis.verdict in ("explained", "nothing_missing"):
        return "None is needed for this verdict."
    return "None was worked out."

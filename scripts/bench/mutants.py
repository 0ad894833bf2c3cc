"""Breaks each safety-relevant line of the firmware and of the host in turn; every mutant must turn a test red.

    python scripts/bench/mutants.py [--only WORD] [--list]

Each mutant is a copy of the sources with one line changed; the tests that run are tests/firmware and the few of
tests/loop and tests/device that concern the line.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TESTS = ("tests/firmware", "tests/loop/test_limits_sent.py", "tests/device/test_limits.py", "tests/device/test_port.py")


@dataclass(frozen=True)
class Mutant:
    """One line broken: what it guards, the file, the text and what takes its place."""

    guards: str
    file: str
    old: str
    new: str


MUTANTS = tuple(Mutant(**row) for row in tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["mutant"])


def apply(mutant: Mutant, folder: Path) -> None:
    """A copy of the project with the mutant in it."""
    for name in ("station", "firmware", "tests", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.svg", "*.png"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    path = folder / mutant.file
    text = path.read_text(encoding="utf-8")
    if text.count(mutant.old) < 1:
        raise SystemExit(f"{mutant.guards}: {mutant.file} has no line {mutant.old!r}; the mutant must be renewed")
    path.write_text(text.replace(mutant.old, mutant.new, 1), encoding="utf-8")


def killed_by(mutant: Mutant) -> str:
    """The first test that the mutant turns red, "" for none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        apply(mutant, folder)
        environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1",
                                    "HYPOTHESIS_STORAGE_DIRECTORY": str(folder / "hypothesis")}
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-n", "0", "--no-header",
                   "--ignore=tests/firmware/test_sources.py", "--ignore=tests/firmware/test_boards.py",
                   "-k", "not the_library_passes and not cover_the_core and not bit_error and not mutant", *TESTS]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode == 0:
            return ""
        failed = [line for line in done.stdout.splitlines() if line.startswith(("_", "ERROR")) and " " in line]
        return failed[0].strip("_ ") if failed else done.stdout.splitlines()[-1]


def main() -> int:
    """Try each; print who kills it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="mutants whose words hold this")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    chosen = [mutant for mutant in MUTANTS if options.only in mutant.guards]
    if options.list:
        print("\n".join(mutant.guards for mutant in chosen))
        return 0
    begun, survivors = time.perf_counter(), 0
    for mutant in chosen:
        found = killed_by(mutant)
        survivors += not found
        print(f"{'killed' if found else 'SURVIVED'}  {mutant.guards}  {found}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} killed in {time.perf_counter() - begun:.0f} s")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())

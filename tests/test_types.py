"""The types that the code states hold together (mypy, configured in pyproject.toml)."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def checked(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "mypy", "--cache-dir", str(ROOT / ".mypy_cache"), *arguments],
                          cwd=folder, capture_output=True, text=True)


def test_mypy_finds_nothing() -> None:
    done = checked(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "no issues found" in done.stdout


def test_a_wrong_type_is_found(tmp_path: Path) -> None:
    """The check above can fail."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "wrong.py").write_text("rate: float = 'fast'\n", encoding="utf-8")
    done = checked(tmp_path, "wrong.py")
    assert done.returncode == 1 and "Incompatible types" in done.stdout

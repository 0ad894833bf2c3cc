"""Builds the firmware's host board, a shared library, once for each state of the sources; others in the same way.

A library is kept in the user's cache folder (a temporary one where that cannot be written), named by a hash of
sources, flags and platform, and moved into place whole, so that two processes may build at once.  The compiler is
``CC``, else cc, gcc or clang, else the one of the ``ziglang`` package.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import platformdirs

from station.device.firmware import firmware_folder
from station.errors import WorkError

WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
"""What the sources must pass in the tests; a user's newer compiler may know warnings that nobody has seen."""
_FLAGS = ("-std=c11", "-O2", "-shared")
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_BUILD_SECONDS = 120


def sources() -> list[Path]:
    """Every C file and header of the host board, in a fixed order."""
    folder = firmware_folder()
    return sorted([*(folder / "core").glob("*.[ch]"), *(folder / "boards" / "host").glob("*.[ch]")])


def source_hash() -> int:
    """32 bits of the sources' hash: the build number that the device tells."""
    return int(digest()[:8], 16)


def digest(paths: list[Path] | None = None) -> str:
    """SHA-256 of names and contents; of the host board's sources by default."""
    found = hashlib.sha256()
    for path in sources() if paths is None else paths:
        found.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def _flags() -> list[str]:
    return [*_FLAGS, *([] if sys.platform == "win32" else ["-fPIC"])]


def compilers() -> list[list[str]]:
    """The commands of the compilers that are there, best first; CC alone where it is set."""
    if os.environ.get("CC"):
        return [shlex.split(os.environ["CC"])]
    found = [[path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))][:1]
    if importlib.util.find_spec("ziglang"):
        found.append([sys.executable, "-m", "ziglang", "cc"])
    return found


def _folders() -> list[Path]:
    """Where libraries are kept, best first."""
    user = str(os.getuid()) if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return [Path(platformdirs.user_cache_dir("station", appauthor=False)),
            Path(tempfile.gettempdir()) / f"station-{user}"]


def _usable(folder: Path) -> bool:
    """Whether the folder exists or can be made, can be written, and belongs to nobody else."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def compile_c(command: list[str]) -> None:
    """Run a compiler; WorkError with its first complaint."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_BUILD_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise WorkError(f"{command[0]}: the firmware core cannot be compiled ({error})") from None
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or ["?"]
        raise WorkError(f"{command[0]}: the firmware core cannot be compiled ({lines[0]})")


def compile_library(compiler: list[str], target: Path, flags: tuple[str, ...] = (),
                    paths: list[Path] | None = None) -> None:
    """Compile the sources (``paths``, else the host board's) to ``target``; WorkError with the compiler's first
    complaint."""
    compile_c([*compiler, *_flags(), *flags, f"-I{firmware_folder() / 'core'}", "-o", str(target),
               *(str(path) for path in (sources() if paths is None else paths) if path.suffix == ".c")])


def keep(name: str, make: Callable[[Path], None]) -> Path:
    """The kept file of this name; where there is none, ``make(path)`` writes it first."""
    folders = [folder for folder in _folders() if _usable(folder)]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    if not folders:
        raise WorkError(f"{_folders()[-1]}: no folder can be written to keep the compiled firmware core")
    with tempfile.TemporaryDirectory(dir=folders[0], prefix="build-") as work:
        make(Path(work) / name)
        try:
            os.replace(Path(work) / name, folders[0] / name)
        except OSError as error:
            if not (folders[0] / name).is_file():  # on Windows another process may hold the one it has just made
                raise WorkError(f"{folders[0] / name}: cannot be written ({error.strerror})") from None
    return folders[0] / name


def _compile_with_the_first_that_can(target: Path, *given: Any) -> None:
    found = compilers()
    if not found:
        raise WorkError("no C compiler for the firmware core: install one (cc, gcc, clang), "
                        "or run `pip install ziglang`")
    fault = None
    for compiler in found:
        try:
            compile_library(compiler, target, *given)
            return
        except WorkError as error:
            fault = fault or error
    raise fault


def build() -> Path:
    """The path of the library, compiled first where there is none for these sources."""
    return _kept("core", digest(), _flags())


def build_library(name: str, paths: list[Path], flags: tuple[str, ...]) -> Path:
    """The same for a library of other sources, headers among them, and further flags."""
    return _kept(name, digest(paths), [*_flags(), *flags], flags, paths)


def _kept(name: str, contents: str, flags: list[str], *given: Any) -> Path:
    key = hashlib.sha256(f"{contents} {flags} {platform.machine()} {sys.platform}".encode()).hexdigest()[:16]
    return keep(f"{name}-{key}{_SUFFIX}", lambda target: _compile_with_the_first_that_can(target, *given))

"""Builds the boards with an Arm chip by arm-none-eabi-gcc (Debian: gcc-arm-none-eabi, libnewlib-arm-none-eabi)."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

from station.device.build import compile_c, digest, keep
from station.device.firmware import firmware_folder
from station.errors import UsageError

GCC = "arm-none-eabi-gcc"
FLAGS = ("-mcpu=cortex-m3", "-mthumb", "-std=c11", "-O2", "-ffunction-sections", "-fdata-sections")
LINK = ("--specs=nano.specs", "-nostartfiles", "-Wl,--gc-sections")


def boards() -> list[str]:
    """The boards with sources for a chip."""
    return sorted(path.name for path in (firmware_folder() / "boards").iterdir() if (path / f"{path.name}.c").is_file()
                  and path.name != "host")


def board_sources(board: str) -> list[Path]:
    """Every file that a board's image is made of, in a fixed order."""
    folder = firmware_folder()
    found = [*(folder / "core").glob("*.[ch]"), *(folder / "boards").glob("*.[ch]")]
    return sorted(found) + sorted(path for path in (folder / "boards" / board).rglob("*") if path.suffix in
                                  (".c", ".h", ".ld"))


def build_number(board: str) -> int:
    """32 bits of the hash of a board's sources: the build number that the device tells."""
    return int(digest(board_sources(board))[:8], 16)


def compile_image(board: str, target: Path, flags: tuple[str, ...] = (), sources: list[Path] | None = None) -> None:
    """Compile and link a board's image; UsageError without the compiler, WorkError with its first complaint."""
    if shutil.which(GCC) is None:
        raise UsageError(f"{board}: {GCC} is missing; on Debian: "
                         "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi")
    folder = firmware_folder()
    files = board_sources(board) if sources is None else sources
    scripts = [option for path in board_sources(board) if path.suffix == ".ld" for option in ("-T", str(path))]
    compile_c([GCC, *FLAGS, *flags, f"-I{folder / 'core'}", f"-I{folder / 'boards'}", *LINK, *scripts,
               "-o", str(target), *(str(path) for path in files if path.suffix == ".c")])


def image(board: str) -> Path:
    """The path of a board's image, built first where there is none for these sources."""
    key = hashlib.sha256(f"{digest(board_sources(board))} {FLAGS} {LINK}".encode()).hexdigest()[:16]
    return keep(f"{board}-{key}.elf", lambda target: compile_image(board, target))

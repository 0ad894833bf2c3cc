"""Sizes of an Arm build: image, RAM, and the deepest stack by the compiler's own account and its call graph."""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from station.device.arm import FLAGS, GCC, board_sources, compile_image
from station.device.build import WARNINGS, compile_c
from station.device.firmware import firmware_folder

BOARDS = firmware_folder() / "boards"
EXCEPTION_BYTES = 40
"""What the chip stacks at an interrupt: 8 words, and up to 2 of alignment (Armv7-M, B1.5.6)."""
LIBRARY_BYTES = 64
"""Taken for a function of the C library or of libgcc, of which the compiler says nothing (memcpy, a division)."""


@dataclass(frozen=True)
class Sizes:
    """Bytes."""

    image: int
    ram: int
    stack: int

    def words(self, name: str) -> str:
        """One line for people."""
        return f"{name}: image {self.image} bytes, RAM {self.ram} bytes, deepest stack {self.stack} bytes"


def sections(path: Path) -> tuple[int, int]:
    """Image and RAM without the stack of an object or an image (arm-none-eabi-size)."""
    size = GCC.replace("gcc", "size")
    out = subprocess.run([size, str(path)], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, out.splitlines()[1].split()[:3])
    return text + data, data + bss


class CallGraph:
    """Stack of each function and whom it calls, from GCC's -fcallgraph-info=su."""

    def __init__(self, folder: Path) -> None:
        self.own: dict[str, int] = {}
        self.calls: dict[str, set[str]] = {}
        for path in folder.glob("*.ci"):
            text = path.read_text()
            for title, label in re.findall(r'node: \{ title: "([^"]+)" label: "([^"]+)"', text):
                if found := re.search(r"(\d+) bytes \((static|dynamic[^)]*)\)", label):
                    assert found[2] == "static", f"{title}: a stack that grows"
                    self.own[title.split(":")[-1]] = int(found[1])
            for source, target in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', text):
                assert target != "__indirect_call", f"{source}: calls through a pointer"
                self.calls.setdefault(source.split(":")[-1], set()).add(target.split(":")[-1])

    def deepest(self, name: str, above: tuple[str, ...] = ()) -> int:
        """Bytes from a function down; no recursion."""
        assert name not in above, f"{name} calls itself"
        own = self.own.get(name, LIBRARY_BYTES)
        return own + max((self.deepest(called, (*above, name)) for called in self.calls.get(name, ())), default=0)


def image_sizes(board: str, folder: Path, interrupts: tuple[str, ...]) -> Sizes:
    """Build a board's whole image strictly; its stack: main, and one interrupt of each priority on top of it."""
    target = folder / f"{board}.elf"
    # one object for each source, so that each leaves its call graph
    for source in (path for path in board_sources(board) if path.suffix == ".c"):
        compile_object(source, folder / f"{source.stem}.o", "-fcallgraph-info=su")
    compile_image(board, target, WARNINGS)
    graph = CallGraph(folder)
    stack = graph.deepest("main") + sum(EXCEPTION_BYTES + graph.deepest(name) for name in interrupts)
    image, ram = sections(target)
    return Sizes(image, ram + stack, stack)


def object_sizes(board: str, folder: Path, interrupts: tuple[str, ...], *flags: str) -> Sizes:
    """The same of a board whose vendor's part is declared alone: the sum of its objects."""
    image = ram = 0
    for source in (path for path in board_sources(board) if path.suffix == ".c"):
        target = folder / f"{source.stem}.o"
        compile_object(source, target, "-fcallgraph-info=su", f"-I{BOARDS / board}", f"-I{BOARDS / board / 'stub'}",
                       *flags)
        more, bytes_of_ram = sections(target)
        image, ram = image + more, ram + bytes_of_ram
    graph = CallGraph(folder)
    stack = graph.deepest("main") + sum(EXCEPTION_BYTES + graph.deepest(name) for name in interrupts)
    return Sizes(image, ram + stack, stack)


def compile_object(source: Path, target: Path, *flags: str) -> None:
    """One source for a Cortex-M3, warnings as errors."""
    compile_c([GCC, *FLAGS, *WARNINGS, *flags, f"-I{firmware_folder() / 'core'}", f"-I{BOARDS}", "-c", str(source),
               "-o", str(target)])


def code_lines(path: Path) -> int:
    """Lines that are neither blank nor comment."""
    text = re.sub(r"/\*.*?\*/", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    return sum(bool(line.strip()) for line in text.splitlines())

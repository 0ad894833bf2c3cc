"""The boards: each one file behind one header, without warnings, and small; the host's library for other systems."""

import importlib.util
import re
import shutil
import subprocess
import sys

import pytest

from station.device.arm import GCC, boards
from station.device.build import WARNINGS, compile_c
from station.device.firmware import firmware_folder
from tests.firmware.figures import BOARDS, code_lines, image_sizes, object_sizes

CORE = firmware_folder() / "core"
DOCS = (firmware_folder().parent / "docs" / "add_board.md").read_text(encoding="utf-8")
STUBS = {"psoc5lp": ("tick_isr",), "arduino_due": ("UART_Handler", "TC3_Handler")}
IMAGE_BYTES, RAM_BYTES, STACK_BYTES = 24 << 10, 4 << 10, 1 << 10
needs_arm = pytest.mark.skipif(shutil.which(GCC) is None, reason=f"no {GCC} here")
TARGETS = ("x86_64-windows-gnu", "aarch64-macos", "aarch64-linux-gnu")


def within(sizes):
    return sizes.image < IMAGE_BYTES and sizes.ram < RAM_BYTES and sizes.stack < STACK_BYTES


@needs_arm
def test_the_emulated_boards_image_builds_without_warnings_and_is_small(tmp_path, record_property):
    sizes = image_sizes("mps2_an385", tmp_path, ("line_plant", "tick"))
    record_property("figure", sizes.words("mps2_an385"))
    assert within(sizes)


@needs_arm
@pytest.mark.parametrize(("board", "flags"), [("psoc5lp", ("-DLINE_USB=1",)), ("psoc5lp", ("-DLINE_USB=0",)),
                                              ("arduino_due", ())])
def test_a_board_compiles_against_its_vendors_declarations_and_is_small(board, flags, tmp_path, record_property):
    sizes = object_sizes(board, tmp_path, STUBS[board], *flags)
    record_property("figure", sizes.words(" ".join([board, *flags])) + ", without its vendor's code")
    assert within(sizes)


def test_every_board_is_one_file_that_implements_one_header(record_property):
    header = (BOARDS / "board.h").read_text(encoding="utf-8")
    wanted = set(re.findall(r"\b(board_[a-z]+)\(", header))
    assert len(wanted) == 11
    for board in boards():
        source = BOARDS / board / f"{board}.c"
        assert [path.name for path in (BOARDS / board).glob("*.c")] == [source.name]
        text = source.read_text(encoding="utf-8")
        assert {name for name in wanted if re.search(rf"^\w+ {name}\([^;)]*\)\s*\{{", text, re.MULTILINE)} == wanted
        assert f"{code_lines(source)} for `{board}`" in DOCS, board
        record_property("figure", f"{board}: {code_lines(source)} lines of code")
    shared = sum(code_lines(BOARDS / name) for name in ("run.c", "board.h", "ring.h"))
    record_property("figure", f"shared by all boards: {shared} lines; core: "
                              f"{sum(code_lines(path) for path in CORE.glob('*.[ch]'))}")


def test_no_stub_and_no_lockstep_reaches_another_board():
    for board in STUBS:
        text = (BOARDS / board / f"{board}.c").read_text(encoding="utf-8")
        assert "lockstep" not in text and "stub/" not in text


def test_cppcheck_finds_nothing():
    if shutil.which("cppcheck") is None:
        pytest.skip("no cppcheck here")
    command = ["cppcheck", "--enable=warning,style,performance,portability", "--inline-suppr", "--error-exitcode=1",
               "--suppress=unusedStructMember", "--suppress=*:*/stub/*", "--std=c11", "--quiet",
               *(f"-I{path}" for path in (CORE, BOARDS, *(BOARDS / board / "stub" for board in STUBS))),
               str(CORE), str(BOARDS)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


MEMORY = """#include <stddef.h>
void *memcpy(void *to, const void *from, size_t n)
{ for (size_t i = 0; i < n; i++) ((char *)to)[i] = ((const char *)from)[i]; return to; }
void *memmove(void *to, const void *from, size_t n) { return memcpy(to, from, n); }
void *memset(void *to, int v, size_t n) { for (size_t i = 0; i < n; i++) ((char *)to)[i] = (char)v; return to; }
void __chkstk(void) {} void ___chkstk_ms(void) {}
"""


@pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed")
@pytest.mark.parametrize("target", TARGETS)
def test_the_host_library_builds_for_other_machines(target, tmp_path):
    """Compiled against each system's headers; linked without its C library, which zig would take minutes to build."""
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", target, "-O2", "-std=c11"]
    zig += [] if "windows" in target else ["-fPIC"]
    (tmp_path / "memory.c").write_text(MEMORY)
    objects = []
    for source in [*CORE.glob("*.c"), BOARDS / "host" / "host.c", tmp_path / "memory.c"]:
        objects.append(str(tmp_path / f"{source.stem}.o"))
        strict = ("-fno-builtin",) if source.stem == "memory" else WARNINGS
        compile_c([*zig, *strict, f"-I{CORE}", "-c", str(source), "-o", objects[-1]])
    library = tmp_path / "core.library"
    no_library = ["-nostdlib", *(["-Wl,--no-entry"] if "windows" in target else [])]
    compile_c([*zig, "-shared", *([] if "macos" in target else no_library), "-o", str(library), *objects])
    magic = {"windows": b"MZ", "macos": b"\xcf\xfa\xed\xfe", "linux": b"\x7fELF"}[target.split("-")[1]]
    data = library.read_bytes()
    assert data.startswith(magic)
    assert b"station_tick" in data

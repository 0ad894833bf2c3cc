"""The C sources: derived from the one definition, free of warnings, of the heap and of any board."""

import re
import shutil

import pytest

from station.device import core, header
from station.device.build import WARNINGS, compile_library, compilers, sources
from station.device.core import library
from station.device.firmware import firmware_folder
from station.device.protocol import MESSAGES, PROTOCOL, Protocol
from station.errors import WorkError

CORE = firmware_folder() / "core"


def test_the_generated_sources_are_up_to_date_with_their_definitions():
    for name, text in header.generated().items():
        assert (CORE / name).read_text() == text, "run `python -m station.device.header`"


@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_no_warning_under_the_strict_set(name, tmp_path):
    if shutil.which(name) is None:
        pytest.skip(f"no {name} here")
    compile_library([name], tmp_path / "core.so", WARNINGS)


def test_the_zig_compiler_builds_it_too(tmp_path):
    zig = [command for command in compilers() if "ziglang" in command]
    if not zig:
        pytest.skip("ziglang is not installed")
    compile_library(zig[0], tmp_path / "core.so", WARNINGS)
    assert (tmp_path / "core.so").stat().st_size > 1000


def test_the_core_needs_neither_heap_nor_floating_point_nor_board():
    for path in CORE.glob("*.[ch]"):
        text = re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
        assert not re.search(r"\b(malloc|calloc|realloc|free|float|double|printf)\b", text), path.name
        included = set(re.findall(r"#include\s+[<\"]([^>\"]+)", text))
        assert included <= {"stdint.h", "string.h", "protocol.h", "frame.h", "core.h", "states.h"}, path.name


def test_every_c_file_of_the_host_board_is_part_of_the_build_hash():
    assert {path.name for path in sources()} >= {"core.c", "core.h", "frame.c", "frame.h", "protocol.c", "protocol.h",
                                                 "host.c"}


def test_both_sides_see_structures_of_the_same_size():
    ffi, lib = library()
    sizes, at = {}, 0
    while lib.station_sizes[at].name != ffi.NULL:
        sizes[ffi.string(lib.station_sizes[at].name).decode()] = lib.station_sizes[at].size
        at += 1
    expected = {f"station_{message.name}" for message in MESSAGES.values() if message.fields}
    assert set(sizes) == expected | {"station_board", "station_input", "station_output", "station_core", "station_size"}
    assert all(ffi.sizeof(name) == size for name, size in sizes.items())


def test_a_library_of_other_structures_is_refused(monkeypatch):
    declared = header.declarations()
    monkeypatch.setattr(core.header, "declarations", lambda: declared.replace("int32_t encoder; /* counts */",
                                                                              "int16_t encoder;", 1))
    with pytest.raises(WorkError, match="station_reply has"):
        library.__wrapped__()


def test_a_library_of_another_protocol_is_refused(monkeypatch):
    text = (firmware_folder() / "protocol.toml").read_text()
    monkeypatch.setattr(core, "PROTOCOL", Protocol.from_toml(text.replace("late_wake_us = 100", "late_wake_us = 101")))
    with pytest.raises(WorkError, match="another protocol"):
        library.__wrapped__()


def test_the_hash_follows_meaning_and_not_words():
    text = (firmware_folder() / "protocol.toml").read_text()
    assert Protocol.from_toml(text).hash == PROTOCOL.hash
    assert Protocol.from_toml(text.replace('doc = "the tick"', 'doc = "its tick"')).hash == PROTOCOL.hash
    for change in (("version = 2", "version = 3"), ('name = "accel", type = "i16"', 'name = "accel", type = "i32"'),
                   ('unit = "mHz"', 'unit = "Hz"'), ("held = 2", "held = 12"), ("code = 0x83", "code = 0x93")):
        assert change[0] in text
        assert Protocol.from_toml(text.replace(*change)).hash != PROTOCOL.hash


@pytest.mark.parametrize(("change", "words"), [
    (("code = 0x02", "code = 0x01"), "share"), (("code = 0x02", "code = 0x92"), "not its sender's"),
    (("char[16]", "char[116]"), "longer than a frame")])
def test_a_definition_that_contradicts_itself_is_refused(change, words):
    text = (firmware_folder() / "protocol.toml").read_text()
    assert change[0] in text
    with pytest.raises(ValueError, match=words):
        Protocol.from_toml(text.replace(*change))

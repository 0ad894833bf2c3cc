"""Building the firmware's library: kept, built by two at once, and the words where it cannot be."""

import multiprocessing
import os
import stat
import sys

import pytest

from station.device import build as module
from station.device.build import build
from station.errors import WorkError


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setattr(module, "_folders", lambda: [folder])
    return folder


def build_into(folder, barrier, results):
    module._folders = lambda: [folder]
    barrier.wait(30)
    results.put(build())


def test_a_second_build_compiles_nothing(cache, monkeypatch):
    path = build()
    made = path.stat().st_mtime_ns
    monkeypatch.setattr(module, "compile_library", lambda *a: pytest.fail("compiled again"))
    assert build() == path
    assert path.stat().st_mtime_ns == made
    assert [entry.name for entry in cache.iterdir()] == [path.name]


def test_other_sources_have_another_library(cache, monkeypatch):
    before = build()
    monkeypatch.setattr(module, "digest", lambda: "0" * 64)
    assert build() != before


@pytest.mark.skipif(sys.platform == "win32", reason="no fork on Windows")
def test_two_processes_may_build_at_once(cache):
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(2), context.Queue()
    workers = [context.Process(target=build_into, args=(cache, barrier, results)) for _ in range(2)]
    for worker in workers:
        worker.start()
    paths = {results.get(timeout=60) for _ in workers}
    for worker in workers:
        worker.join(30)
        assert worker.exitcode == 0
    (path,) = paths
    assert [entry.name for entry in cache.iterdir()] == [path.name]


def test_without_a_compiler_one_line_says_what_to_install(cache, monkeypatch):
    monkeypatch.setattr(module, "compilers", list)
    with pytest.raises(WorkError, match=r"^no C compiler .*`pip install ziglang`$"):
        build()


def test_a_compiler_that_fails_hands_on_to_the_next(cache, monkeypatch):
    good = module.compilers()[0]
    monkeypatch.setattr(module, "compilers", lambda: [[sys.executable, "-c", "raise SystemExit(1)"], good])
    assert build().is_file()


def test_where_every_compiler_fails_the_first_complaint_is_told(cache, monkeypatch):
    broken = [sys.executable, "-c", "import sys; print('core.c:1: error: no luck', file=sys.stderr); sys.exit(1)"]
    monkeypatch.setattr(module, "compilers", lambda: [broken])
    with pytest.raises(WorkError, match="no luck") as told:
        build()
    assert "\n" not in str(told.value)
    assert list(cache.iterdir()) == []


def test_a_cache_that_cannot_be_written_is_passed_over(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setattr(module, "_folders", lambda: [blocked / "station", tmp_path / "second"])
    assert build().parent == tmp_path / "second"


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="needs a second user, so root")
def test_a_folder_of_somebody_else_is_not_trusted(tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    os.chown(theirs, 12345, 12345)
    theirs.chmod(stat.S_IRWXU | stat.S_IRWXO)
    monkeypatch.setattr(module, "_folders", lambda: [theirs, tmp_path / "ours"])
    assert build().parent == tmp_path / "ours"


def test_cc_names_the_compiler(monkeypatch):
    monkeypatch.setenv("CC", "my-cc --flag")
    assert module.compilers() == [["my-cc", "--flag"]]

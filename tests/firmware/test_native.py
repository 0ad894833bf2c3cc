"""The core natively: under sanitizers, its coverage, errors of bits without number."""

import gzip
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from station.device.build import WARNINGS, build, compile_library
from station.device.firmware import firmware_folder

CORE = firmware_folder() / "core"
NATIVE = Path(__file__).with_name("native") / "native.c"
ROOT = Path(__file__).resolve().parents[2]
SANITIZE = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-fno-omit-frame-pointer")
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None or sys.platform != "linux", reason="no gcc on Linux here")


def native(folder, *flags):
    """The program, built."""
    target = folder / "native"
    subprocess.run(["gcc", "-std=c11", *flags, *WARNINGS, f"-I{CORE}", "-o", str(target), str(NATIVE),
                    *map(str, sorted(CORE.glob("*.c")))], check=True, cwd=folder)
    return target


def run(program, *arguments):
    done = subprocess.run([str(program), *map(str, arguments)], capture_output=True, text=True, cwd=program.parent)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    return native(tmp_path_factory.mktemp("sanitized"), *SANITIZE)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return native(tmp_path_factory.mktemp("plain"), "-O2")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_order_of_requests_commands_and_garbage_breaks_a_rule_or_touches_memory_that_is_not_the_cores(sanitized,
                                                                                                          seed):
    assert int(re.search(r"(\d+) driven", run(sanitized, "storm", 300_000, seed))[1]) > 100_000


def test_every_error_of_one_and_of_two_bits_of_every_message_is_rejected(plain, record_property):
    said = run(plain, "bits", 10)
    record_property("figure", said.strip())
    assert said.startswith("0 of ") and " 0 of " in said
    assert int(re.search(r"(\d+) two-bit", said.replace("of ", ""))[1]) > 4_000_000


def test_of_three_bit_errors_and_garbage_no_more_pass_than_the_check_promises(plain, record_property):
    record_property("figure", run(plain, "errors", 2_000_000, 9).strip())


def library_tests(folder, *names, **more):
    """Run tests of the library in a process of their own, the library kept in ``folder``."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder), "PYTEST_ADDOPTS": ""} | more
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-x", "-k",
                           "not wraps", *(f"tests/firmware/{name}" for name in names)], cwd=ROOT, capture_output=True,
                          text=True, env=environment)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def library(folder, *flags):
    """The library with these flags, where a process with this cache folder finds it."""
    target = folder / "station" / build().name
    target.parent.mkdir(mode=0o700)
    compile_library(["gcc"], target, flags)
    return target


def test_the_library_passes_its_tests_under_the_sanitizers(tmp_path):
    asan = subprocess.run(["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    assert Path(asan).is_file()
    library(tmp_path, *SANITIZE)
    library_tests(tmp_path, "test_states.py", "test_commands.py", LD_PRELOAD=asan, ASAN_OPTIONS="detect_leaks=0")


def test_the_tests_cover_the_core(tmp_path, record_property):
    folder = library(tmp_path, "--coverage", "-O0").parent
    library_tests(tmp_path, "test_states.py", "test_commands.py", "test_table.py", "test_frames_in_c.py")
    lines = branches = lines_run = branches_run = 0
    for counts in folder.glob("*.gcda"):
        subprocess.run(["gcov", "--json-format", "--branch-probabilities", str(counts)], cwd=folder,
                       capture_output=True, check=True)
    for report in folder.glob("*.gcov.json.gz"):
        for file in json.loads(gzip.decompress(report.read_bytes()))["files"]:
            if Path(file["file"]).parent != CORE:
                continue
            lines += len(file["lines"])
            lines_run += sum(line["count"] > 0 for line in file["lines"])
            taken = [branch["count"] > 0 for line in file["lines"] for branch in line["branches"]]
            branches, branches_run = branches + len(taken), branches_run + sum(taken)
    assert lines > 300
    record_property("figure", f"firmware/core: {100 * lines_run / lines:.1f} % of {lines} lines, "
                              f"{100 * branches_run / branches:.1f} % of {branches} branches")
    assert lines_run >= 0.95 * lines
    assert branches_run >= 0.90 * branches

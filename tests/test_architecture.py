"""The structure that ARCHITECTURE.md promises: who may import whom, and that lint is clean."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True)


def test_dependencies_point_one_way():
    done = subprocess.run([sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()",
                           "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_a_contract_breaks_where_an_import_points_the_wrong_way(tmp_path):
    """The check above can fail: a copy of the package in which control imports the loop does not pass."""
    shutil.copytree(ROOT / "station", tmp_path / "station", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with (tmp_path / "station" / "control" / "rounding.py").open("a", encoding="utf-8") as file:
        file.write("\nimport station.loop\n")
    done = subprocess.run([sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()",
                           "--no-cache"], cwd=tmp_path, capture_output=True, text=True,
                          env={"PYTHONPATH": str(tmp_path), "PATH": ""})
    assert done.returncode == 1, done.stdout + done.stderr
    assert "BROKEN" in done.stdout


def _table() -> dict[str, set[str]]:
    """The right-hand column of ARCHITECTURE.md: what each part of station may import itself, as it is written there."""
    rows = re.findall(r"^\| `station/(\w+)(?:/|\.py)` \|.*\| ([^|]+) \|$",
                      (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8"), re.MULTILINE)
    said = dict(rows)
    assert len(said) == len(rows) == 13
    known = {name: set(re.findall(r"[a-z]+", text)) & set(said) for name, text in said.items()}
    known["view"] |= known["diagnose"]                                      # "and what diagnose may know"
    known["api"], known["cli"] = set(said) - {"api", "cli"}, set(said)      # "all below", "all"
    assert said["view"].endswith("and what diagnose may know")
    assert (said["api"], said["cli"], said["control"]) == ("all below", "all", "nothing")
    return known


def test_every_part_of_the_package_stands_in_the_table():
    parts = {path.stem for path in (ROOT / "station").iterdir()
             if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert parts - {"__init__", "__main__", "errors", "markup", "rig"} == set(_table())


@pytest.mark.parametrize("part", sorted(set(_table()) - {"cli"}))
def test_a_contract_says_what_the_table_says(part):
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    (contract,) = [c for c in tools["importlinter"]["contracts"] if c["name"].startswith(f"{part} may know ")]
    known = _table()
    forbidden = set(known) - known[part] - {part} | ({"rig"} if part in ("control", "runs") else set())
    assert contract["source_modules"] == [f"station.{part}"] and contract["allow_indirect_imports"]
    assert set(contract["forbidden_modules"]) == {f"station.{name}" for name in forbidden}


def test_the_rig_knows_the_effects_classes_alone():
    """The table's first row: errors and markup know nothing, the rig the effects' classes."""
    graph = grimp.build_graph("station", exclude_type_checking_imports=True)
    basic = {"station.errors", "station.markup"}
    for module in basic:
        assert graph.find_modules_directly_imported_by(module) <= basic | {"station"}
    found = graph.find_modules_directly_imported_by("station.rig")
    assert "station.model.effects" in found and found <= basic | {"station.model.effects", "station"}


def test_the_picture_of_the_datas_way_names_files_that_are_there():
    text = (ROOT / "docs" / "figures" / "way.svg").read_text(encoding="utf-8")
    named = re.findall(r">((?:station|firmware)/[\w./]+)<", text)
    assert len(named) >= 10 and [name for name in named if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize("page", ["ARCHITECTURE.md", "README.md", *(f"docs/{p.name}" for p in DOCS)])
def test_files_that_a_page_names_are_there(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:station|firmware|tests|scripts)/[\w./-]*)`", text))
    if page.startswith("docs/"):
        named |= {"docs"}
    assert named and [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_ruff_finds_nothing():
    done = _run("ruff", "check", ".")
    assert done.returncode == 0, done.stdout


def test_every_dependency_is_imported_and_pinned():
    """No dependency stands in pyproject.toml that nothing uses, and the lock names each."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    modules = {"pyserial": "serial", "rerun-sdk": "rerun", "tomli-w": "tomli_w", "protobuf": "google.protobuf"}
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "station").rglob("*.py"))
    pinned = {line.split("==")[0].lower().replace("_", "-")
              for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()}
    for requirement in project["dependencies"]:
        name = requirement.split(">=")[0]
        module = modules.get(name, name)
        assert f"import {module}" in source or f"from {module}" in source, f"{name} is imported nowhere"
        assert name in pinned, f"{name} is not in requirements.lock"


@pytest.mark.parametrize("line", (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines())
def test_the_lock_holds_names_and_versions_alone(line):
    name, version = line.split("==")
    assert name and version[0].isdigit()


def test_every_file_that_is_not_python_travels_with_the_package():
    """What a wheel leaves out is missing only on other people's machines."""
    data = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-data"]
    for package, folder in (("station", ROOT / "station"), ("station.firmware", ROOT / "firmware")):
        packed = {path for pattern in data[package] for path in folder.glob(pattern)}
        made = {".py", ".pyc", ".nbi", ".nbc"}
        there = {path for path in folder.rglob("*") if path.is_file() and path.suffix not in made}
        assert there - packed == set(), package


def test_a_first_simulation_does_not_wait_for_what_it_does_not_use():
    """scipy.signal and control take longer to import than the rest of a first simulation."""
    code = ("import sys, station.rig, station.model.simulate, station.runs.run; "
            "print([name for name in ('scipy.signal', 'control', 'plotly', 'rerun') if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

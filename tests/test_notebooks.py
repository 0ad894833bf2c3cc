"""The notebooks run from top to bottom, on the public Python interface alone, and show what they make."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import station as st

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_there_is_one_for_each_use():
    assert [path.stem for path in NOTEBOOKS] == ["1_first_test", "2_replay", "3_diagnosis", "4_own_effect",
                                                 "5_compensator"]


@pytest.mark.parametrize("path", [
    pytest.param(path, id=path.stem, marks=pytest.mark.long if path.stem == "4_own_effect" else ())
    for path in NOTEBOOKS])
def test_a_notebook_runs_and_shows_what_it_makes(path, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    book = nbformat.read(path, as_version=4)
    NotebookClient(book, timeout=240, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.data["text/html"] for cell in book.cells if cell.cell_type == "code" for output in cell.outputs
             if output.output_type == "execute_result" and "text/html" in output.data]
    assert shown and any("<table>" in page for page in shown)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_uses_the_public_interface_alone_and_keeps_no_output(path):
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    for cell in book.cells:
        if cell.cell_type != "code":
            continue
        assert cell.outputs == [] and cell.execution_count is None
        for node in ast.walk(ast.parse(re.sub(r"\A%%writefile .*\n", "", cell.source))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else (
                [node.module] if isinstance(node, ast.ImportFrom) else [])
            assert not [name for name in names if name.startswith("station.")]
            if isinstance(node, ast.ImportFrom):
                assert node.module != "station", "import station as st"
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "st":
                assert node.attr in st.__all__

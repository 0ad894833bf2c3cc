"""``import station as st``: quick to import, whole, and its objects show themselves."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import station as st

ROOT = Path(__file__).resolve().parents[1]
STEP = {"kind": "step", "amplitude": 50.0, "duration": 0.8}


@pytest.fixture(scope="module")
def step() -> st.Run:
    """A step on the simulated rig, through the serial protocol."""
    return st.run_test("sim://sflr?noise=0", "sflr", STEP)


def test_importing_station_loads_nothing_heavy():
    heavy = ("numpy", "scipy", "numba", "pydantic", "plotly")
    code = f"import sys, station; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", st.__all__)
def test_every_public_name_is_there_with_a_docstring(name):
    assert getattr(st, name).__doc__
    assert name in dir(st)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'diagnos'"):
        st.diagnos  # noqa: B018


@pytest.mark.parametrize("first", ["import station.diagnose.diagnose", "import station.cli", "pass"])
def test_diagnose_can_be_called_whatever_was_imported_before(first):
    code = f"{first}\nimport station as st\ntry:\n    st.diagnose('sflr', [])\nexcept st.UsageError as e:\n    print(e)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert "at least one run" in done.stdout


def test_a_test_is_logged_where_asked_for_and_replaces_nothing(tmp_path):
    out = tmp_path / "pulse.mcap"
    run = st.run_test("sim://sflr", "sflr", {"kind": "pulse", "duration": 0.6}, out=out, metadata={"note": "first"})
    assert np.array_equal(st.load_run(out).encoder, run.encoder)
    assert run.metadata.controller["kind"] == "open" and run.metadata.entries()["note"] == "first"
    before = out.read_bytes()
    with pytest.raises(st.WorkError, match="exists already"):
        st.run_test("sim://sflr", "sflr", STEP, out=out)
    assert out.read_bytes() == before


def test_a_planned_test_is_simulated_as_the_loop_runs_it(step):
    made = st.simulate("sflr", STEP)
    np.testing.assert_array_equal(made.encoder, step.encoder)
    np.testing.assert_array_equal(made.command, step.command)
    np.testing.assert_array_equal(st.simulate("sflr", step).encoder, step.encoder)
    other = st.simulate("sflr", step, "lead")
    assert other.metadata.controller["kind"] == "lead" and not np.array_equal(other.encoder, step.encoder)


def test_a_pulse_beyond_the_limit_is_simulated_as_the_device_cuts_it():
    pulse = {"kind": "pulse", "amplitude": 300.0, "duration": 0.8}
    run, made = st.run_test("sim://sflr", "sflr", pulse), st.simulate("sflr", pulse)
    assert run.command.max() == 200.0
    np.testing.assert_array_equal([made.command, made.encoder], [run.command, run.encoder])


def test_comparing_tells_how_far_it_is(step):
    from station.diagnose.compare import compare
    from station.rig import load_rig

    told = []
    compare(load_rig("sflr"), [step, replace(step, name="other")], told.append)
    assert told == [0.5, 1.0]


def test_a_comparison_with_the_rig_itself_is_nothing(step):
    found = st.compare("sflr", step).measures
    assert [row["encoder"]["nrmse"] for row in found] == [0.0]


@pytest.mark.parametrize(("call", "words"), [
    (lambda: st.run_test("sim://sflr", "sflr", STEP, "pd"), "controller 'pd' is none of open, p, lead"),
    (lambda: st.run_test("sim://sflr", "sflr", STEP, out="step.csv"), "logged as .mcap"),
    (lambda: st.run_test("sim://sflr", "sflr", {"kind": "stp"}), "stp"),
    (lambda: st.load_rig("nowhere"), "nowhere"),
    (lambda: st.diagnose("sflr", []), "at least one run")])
def test_wrong_use_is_one_line(call, words):
    with pytest.raises(st.UsageError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_two_runs_of_one_name_are_refused(step):
    with pytest.raises(st.UsageError, match="two runs are named step"):
        st.compare("sflr", [step, step])


def test_rig_run_and_comparison_show_themselves_with_every_text_escaped(step):
    rig = st.load_rig("sflr").model_copy(update={"name": "<b>arm"})
    for shown in (rig, step, st.compare(rig, step)):
        page = shown._repr_html_()
        assert "<table>" in page and page.count("<table>") == page.count("</table>")
        assert "<b>" not in page
    assert "&lt;b&gt;arm" in rig._repr_html_() and "beam.flexural_rigidity" in rig._repr_html_()
    assert step._repr_html_().count("<polyline") == 3


def test_the_page_of_the_docs_runs_as_it_stands_and_its_result_shows_itself(tmp_path):
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    code += "\nprint('<table>' in found._repr_html_(), 'srcdoc' in st.Report(found)._repr_html_())\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path,
                          env=dict(os.environ, PYTHONPATH=str(ROOT)))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report.html").read_text(encoding="utf-8").startswith("<!")
    assert done.stdout.splitlines()[-1] == "True True"


def test_the_page_of_the_docs_names_every_public_name():
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    assert [name for name in st.__all__ if name not in text and name != "RunMetadata"] == []

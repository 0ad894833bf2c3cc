"""Runs of one name in two folders are told apart."""

from pathlib import Path

import pytest

from station.errors import UsageError
from station.runs import export_run
from station.runs.names import load_runs, names_apart
from tests.runs.examples import full_run


@pytest.mark.parametrize(("files", "names"), [
    (["a/step.mcap", "a/pulse.mcap"], ["step", "pulse"]),
    (["mon/step.mcap", "pulse.csv", "tue/step.mcap"], ["mon/step", "pulse", "tue/step"]),
    (["step.csv", "step.mcap"], ["step.csv", "step.mcap"]),
    (["mon/x/step.mcap", "tue/x/step.mcap"], ["mon/x/step", "tue/x/step"]),
    (["a/step.mcap", "a/step.csv", "b/step.mcap"], ["a/step.mcap", "a/step.csv", "b/step.mcap"]),
    (["../step.mcap", "step.mcap"], ["old/step", "here/step"]),
])
def test_names_are_as_short_as_tells_them_apart(files, names, tmp_path, monkeypatch):
    here = tmp_path / "old" / "here"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert names_apart(files) == names
    assert names_apart(files[::-1]) == names[::-1]


def test_one_file_named_twice_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export_run(full_run(), Path("step.csv"))
    with pytest.raises(UsageError, match=r"step\.csv: named twice"):
        load_runs(["step.csv", tmp_path / "step.csv"])
    assert [run.name for run in load_runs(["step.csv"])] == ["step"]

"""The logs are read by Foxglove's own libraries (npm's @mcap/core): every row, every value, every checksum.

`npm install --prefix tests/runs/foxglove --no-package-lock` brings them; without them the test is skipped.
"""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from station.runs import McapLogWriter, load_run, recover
from station.runs.mcap_log import write_mcap
from tests.runs.examples import METADATA, full_run

FOLDER = Path(__file__).with_name("foxglove")
pytestmark = pytest.mark.skipif(shutil.which("node") is None or not (FOLDER / "node_modules").is_dir(),
                                reason="node and @mcap/core are not installed (npm install --prefix "
                                       "tests/runs/foxglove --no-package-lock)")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A log written as it goes, a run written whole, and a log cut short and recovered."""
    folder = tmp_path_factory.mktemp("logs")
    run = full_run(700)
    columns = run.columns()
    with McapLogWriter(folder / "live.mcap", METADATA, columns=tuple(columns), blueprint=False) as log:
        for index, values in enumerate(zip(*(values.tolist() for values in columns.values()), strict=True)):
            log.append(values)
            if index % 100 == 99:
                log._wake.set()
                log._thread.join(0.01)
    write_mcap(run, folder / "whole.mcap", blueprint=False)
    data = (folder / "live.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(data[:int(0.7 * len(data))])
    recover(folder / "cut.mcap", folder / "rescued.mcap")
    return [folder / f"{name}.mcap" for name in ("live", "whole", "rescued")]


def test_foxglove_reads_what_station_wrote(files):
    done = subprocess.run(["node", str(FOLDER / "read.mjs"), *map(str, files)], capture_output=True, text=True,
                          timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for path, line in zip(files, done.stdout.splitlines(), strict=True):
        found, run = json.loads(line), load_run(path)
        assert found["channels"] == ["/metadata", "/sample"]
        assert len(found["rows"]) == len(run) and found["messages"] > len(run)
        for name, values in run.columns().items():
            theirs = np.array([np.nan if row[name] == "nan" else row[name] for row in found["rows"]])
            np.testing.assert_array_equal(theirs, values, err_msg=f"{path.name}: {name}")
        assert [row["sequence"] for row in found["rows"]] == list(range(len(run)))
        assert [row["log_time"] for row in found["rows"]] == np.rint(run.t * 1e9).astype(int).tolist()
        name, text = found["metadata"][-1]
        assert name == "station" and json.loads(text)["zero_id"] == run.metadata.zero_id

"""What a process beside this one loads before it is asked for anything."""

import subprocess
import sys

import pytest

import station.diagnose
from station.estimation.loaded import PREPARE

DISPATCHERS = ("station.estimation.prediction:_predict", "station.estimation.filter:steady_gain",
               "station.model.modal:_first_order", "station.model.sampled:_responses")


@pytest.mark.parametrize("prepare", [PREPARE, station.diagnose.PREPARE])
def test_what_predictions_call_is_there_afterwards(prepare: str) -> None:
    script = ("import importlib, sys\n"
              "def named(path):\n"
              "    module, name = path.split(':')\n"
              "    return getattr(importlib.import_module(module), name)\n"
              "before = [len(named(path).signatures) for path in sys.argv[2:]]\n"
              "named(sys.argv[1])()\n"
              "print(before, [len(named(path).signatures) for path in sys.argv[2:]])\n")
    done = subprocess.run([sys.executable, "-c", script, prepare, *DISPATCHERS], capture_output=True, text=True,
                          check=True)
    assert done.stdout.strip() == "[0, 0, 0, 0] [1, 1, 1, 1]"

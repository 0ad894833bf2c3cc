"""Compiled code, loaded before it is asked for."""

from __future__ import annotations

import numpy as np

from station.estimation.dataset import dataset
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor, is_compiled
from station.model.compiled import address
from station.model.effects import catalogue
from station.rig import load_rig
from station.runs.run import Run, RunMetadata

PREPARE = f"{__name__}:load_compiled"
"""For a ``Pool``."""
ROWS = 10


def load_compiled() -> None:
    """Have what predictions call in this process, out of Numba's cache: a process that begins to load when it is first
    asked keeps the others waiting.  Nothing where it is not there: or two would compile it at the same time."""
    if not is_compiled():
        return
    rig, still = load_rig("sflr"), np.zeros(ROWS)
    run = Run("still", np.arange(ROWS) / rig.sample_rate, still, still, still, still,
              RunMetadata(controller={"kind": "open"}))
    data = dataset(rig, [run])
    space, predictor = parameters(data, Hypothesis(), {}), Predictor(data, observers(rig, 0.0), Pool())
    predictor.around(space, space.mean).runs(space, space.mean + 1e-6, data.own)
    for effect in catalogue().values():
        if effect.law is not None:
            address(effect.law)

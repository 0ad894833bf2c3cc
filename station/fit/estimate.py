"""The fit itself: the estimation's fit of a rig's constants, some of them held, from several starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from station.errors import UsageError, WorkError
from station.estimation import least_squares
from station.estimation.answers import answers, refuse_wrong_signs_and_units
from station.estimation.constants import cooled, refined, searched, settled
from station.estimation.dataset import by_content, dataset
from station.estimation.identifiability import unseen
from station.estimation.loaded import PREPARE
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import SIZE, Pool
from station.estimation.prediction import Predictor
from station.estimation.responses import with_responses
from station.fit.judge import judge
from station.fit.result import FitResult
from station.rig import Rig
from station.runs.run import Run

HELD = ("beam.mass_per_length", "motor.inertia")
"""Held by default: the first of these that the rig has."""


def fit(rig: Rig, runs: Sequence[Run], hold: Sequence[str] | None = None, *, domain: str = "time", starts: int = 3,
        seed: int = 0, progress: Callable[[str, float], None] | None = None, threads: int = SIZE) -> FitResult:
    """Fit the rig's constants to runs.

    ``hold``: constants that stay as they are (default: beam.mass_per_length, without a beam motor.inertia), because
    one common factor is invisible; those of no uncertainty stay too.  ``domain``: "time" compares predictions with
    the runs, "frequency" their measured responses with the model's, "both" does both.  ``starts``: the nominal rig,
    then draws from its stated uncertainty.  What the data do not say about a constant, the rig file's own uncertainty
    says.  UsageError names a constant or domain that is not there, WorkError a run that cannot be used.
    ``progress(what, share)`` is called after each start.
    """
    if domain not in ("time", "frequency", "both"):
        raise UsageError(f"domain {domain!r} is none of time, frequency, both")
    if not runs:
        raise UsageError("a fit wants at least one run")
    # A beam as uniform as the rig file says: what a diagnosis allows for beyond it is no constant of the file.
    data = replace(dataset(rig, by_content(runs)), rig=rig.meshed())
    constants = list(data.rig.constants())
    held = tuple(hold) if hold is not None else tuple([path for path in HELD if path in constants][:1])
    for path in held:
        if path not in constants:
            raise UsageError(f"hold {path}: this rig has {', '.join(constants)}")
    variances = data.rig.log_covariance(constants).diagonal()
    fixed = {path for path, variance in zip(constants, variances, strict=True) if path in held or variance == 0.0}
    space = parameters(data, Hypothesis(), {}, fixed)
    if not space.paths and not space.held:
        raise UsageError(f"{rig.name}: every constant is held or exact")
    hidden = unseen(space)
    seen = np.linalg.qr(hidden, mode="complete")[0][:, hidden.shape[1]:]
    starts, nominal = max(starts, 1), math.inf
    with threadpool_limits(1):
        pool = Pool(threads, PREPARE)
        predictor = Predictor(data, observers(data.rig, data.noise[0]), pool)
        refuse_wrong_signs_and_units(answers(predictor))
        if domain != "time":
            predictor = with_responses(predictor, alone=domain == "frequency")
        try:
            found, agreeing = searched(predictor, space.along(seen), starts, seed, progress or (lambda *told: None))
            found = settled(predictor, found)
            found = refined(predictor, cooled(predictor, found), found)
        except least_squares.DIVERGED:
            raise WorkError(f"{rig.name}: {least_squares.CANNOT_SIMULATE}") from None
        with suppress(*least_squares.DIVERGED):
            nominal = least_squares.fit(predictor, found.space, found.weighing, found.space.mean, iterations=0).misfit
    return judge(space, hidden, seen, found, held, nominal, starts, agreeing)

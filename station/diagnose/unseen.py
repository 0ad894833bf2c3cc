"""The causes that are said and the rig alone, each judged on runs that no fit of theirs has seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from station.diagnose.densities import all_predicted, contradicted, information, log_densities, relief
from station.diagnose.estimates import estimates, may_be_none
from station.diagnose.finding import Finding, bought, without
from station.diagnose.selection import Selection
from station.diagnose.validation import leave_each_out, missed_by_more, nominal, predict_unseen
from station.estimation.cause import Causes
from station.estimation.fitted import Fit
from station.model.simulate import Simulation

Ahead = list[dict[str, float]]


@dataclass(frozen=True, eq=False)
class Unseen:
    """Every run by fits that left it out."""

    left_out: list[Fit]
    """Of the causes that hold, one without each run: those said, or none where more than noise is left and runs left
    out speak against them."""
    densities: dict[Causes, np.ndarray]
    """(runs) ln of the density of each run, of these causes and of none."""
    gains: np.ndarray
    """(runs) what the causes raise it by."""
    informed: np.ndarray
    """(runs) what they would, were they right."""
    relieved: float
    """What they raise the density of what is known beside the runs by: the rig's constants, and the clocks."""
    simulations: tuple[list[Simulation], list[Simulation], list[Simulation]]
    """As the rig file says, with its constants re-fitted, and with the causes that hold."""
    ahead: tuple[Ahead, Ahead]
    """nrmse of predictions by the rig file, and with these."""
    against: bool
    """Whether runs left out speak against the causes."""


def sized(search: Selection, finding: Finding) -> tuple[Finding, list[Fit]]:
    """What is said without causes that may be none by their own intervals, and its fits without each run in turn.

    One goes at a time, the one that adds least: of two that can stand in for each other either may be none.  By the
    normal distribution: of three runs Student's t makes a size of up to 4.3 standard errors none, and that it is there
    the draws say, too.
    """
    while True:
        found = finding.fit
        left_out = leave_each_out(search.predictor, found.weighing, found, far=not finding.left.is_noise)
        values, _ = estimates(found, finding.rough, left_out, student=False)
        none = [key for key in sorted(found.key) if may_be_none(found, key, values[key])]
        if not none:
            return finding, left_out
        finding = without(search, finding, min(none, key=partial(bought, search)))


def unseen(search: Selection, finding: Finding, said: list[Fit]) -> Unseen:
    """Judge the causes that are said and the rig alone by each run with the fits that left it out; ``said``: those of
    the causes."""
    predictor, nothing, causes = search.predictor, search.fits[frozenset()], finding.said.causes
    unfitted = nominal(predictor.data, nothing)
    left_out = {causes: said}
    if causes:
        left_out[frozenset()] = leave_each_out(predictor, search.own_weighing(nothing), nothing,
                                               far=not finding.left.is_noise)
    alone = left_out[frozenset()]
    refit, refit_ahead = predict_unseen(predictor, nothing, alone)
    predictions = {keys: all_predicted(predictor, search.compared, fits) for keys, fits in left_out.items()}
    densities = {keys: log_densities(found) for keys, found in predictions.items()}
    gains = densities[causes] - densities[frozenset()]
    informed = information(predictor, search.compared, predictions[frozenset()], predictions[causes])
    relieved = (relief(alone, said) + search.clock_score(finding.fit.space.hypothesis)
                - search.clock_score(nothing.space.hypothesis))
    before, before_ahead = predict_unseen(predictor, unfitted, [unfitted] * len(alone))
    after, after_ahead = predict_unseen(predictor, finding.fit, said) if causes else (refit, refit_ahead)
    against = contradicted(gains, informed, relieved) or missed_by_more(predictor.data, before, refit, after)
    holding = said
    if against and not finding.left.is_noise:
        holding, after, after_ahead = alone, refit, refit_ahead
    return Unseen(holding, densities, gains, informed, relieved, (before, refit, after), (before_ahead, after_ahead),
                  against)

"""What a change of a fit's predictions promises, held against the likelihood of the linear model itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from station.diagnose.candidates import candidates
from station.diagnose.linearised import Change, Linearised
from station.estimation.constants import base_fit
from station.estimation.fitted import Fit
from station.estimation.least_squares import fit
from station.estimation.likelihood import cost
from station.estimation.parameters import parameters
from station.estimation.prediction import Predictor
from station.rig import Rig
from tests.estimation.made import predictions
from tests.truth import RIGID_AXIS, make_case

FRICTION = ("coulomb_friction", "motor")


@pytest.fixture(scope="module")
def known() -> Iterator[tuple[Linearised, Change]]:
    """A rig that has friction, fitted without it, and what as much of it changes as seems best."""
    runs = make_case(8176, [FRICTION], nominal=RIGID_AXIS, count=4, band=(400.0, 1e5)).runs
    predictor = predictions(Rig.model_validate(RIGID_AXIS), runs)
    data = predictor.data
    base = base_fit(predictor)
    parent = fit(predictor, base.space, base.weighing, base.x, base.own, to_the_end=True)
    cause = next(c for c in candidates(data.rig) if c.key == FRICTION)
    guess = {cause.key: cause.guesses[0]}
    space = parameters(data, cause.hypothesis, guess)
    found = Linearised.of(predictor, parent)
    change = found.change(space, space.carried(parent.space, parent.x, guess))
    assert change is not None
    gram, slope = found.weighed.products([change])
    yield found, multiple(change, slope[0] / gram[0, 0])


def multiple(change: Change, size: float) -> Change:
    return Change([size * c for c in change.scaled], size**2 * change.squares, size * change.slopes)


def surprise(parent: Fit, change: Change, at: np.ndarray) -> float:
    """-2 ln of likelihood and priors of the linear model at a size and steps of parameters and nuisances."""
    assert parent.jacobian is not None
    p, c = parent.space.size, parent.nuisance.shape[1]
    size, step, own = at[0], at[1: 1 + p], at[1 + p:].reshape(-1, c)
    left = [e - size * s - np.tensordot(np.concatenate([step, mine]), j, 1) for e, s, j, mine in
            zip(parent.residuals, change.scaled, parent.jacobian, own, strict=True)]
    squares = np.array([np.sum(e * e, axis=1) for e in left])
    value = cost(squares, parent.counts, parent.weighing.independent) / parent.weighing.temperature
    value += float(parent.space.precision @ (parent.x - parent.space.mean + step) ** 2)
    return value + float(np.sum(parent.nuisance * (parent.away + own) ** 2))


def fall(parent: Fit, change: Change) -> float:
    """By how much the linear model's best lies below the parent."""
    units = np.concatenate([[1.0], parent.space.precision**-0.5, parent.nuisance.ravel() ** -0.5])
    start = surprise(parent, change, 0.0 * units)
    return max(start - minimize(lambda at: surprise(parent, change, at * units), np.r_[size, np.zeros(len(units) - 1)],
                                method="L-BFGS-B").fun for size in (0.0, 1.0))


def wild(change: Change, run: int) -> Change:
    """The same change, a thousand times as large in one run, which the parent meets to the noise."""
    size = np.where(np.arange(len(change.scaled)) == run, 1e3, 1.0)
    return Change([c * s for c, s in zip(change.scaled, size, strict=True)], change.squares * size[:, None] ** 2,
                  change.slopes * size[:, None, None])


def resting(known: Linearised, run: int) -> Linearised:
    """The same where one run holds half an independent error per block, as one does that rests throughout."""
    independent = known.parent.weighing.independent.copy()
    independent[run] = 0.5
    weighing = replace(known.parent.weighing, independent=independent)
    return replace(known, parent=replace(known.parent, weighing=weighing))


def test_both_quadratics_promise_no_more_than_the_likelihood_of_the_linear_model(known) -> None:
    found, change = known
    gram, slope = found.weighed.products([change])
    near = slope[0] ** 2 / gram[0, 0]
    most = fall(found.parent, change)
    beyond = found.beyond(change)
    assert 10.0 < near <= most + 0.1
    assert beyond is None or beyond[0] + beyond[2] ** 2 / beyond[1] <= most + 0.1


def test_a_run_in_which_the_change_does_far_more_than_was_missed_does_not_hide_what_it_buys_elsewhere(known) -> None:
    found, change = resting(known[0], 0), known[1]
    far = wild(change, 0)
    gram, slope = found.weighed.products([far])
    beyond = found.beyond(far)
    assert beyond is not None
    promised = beyond[0] + beyond[2] ** 2 / beyond[1]
    assert slope[0] ** 2 / gram[0, 0] < 0.5 * promised
    assert promised <= fall(found.parent, far) + 0.1


def test_a_change_within_the_errors_is_weighed_by_what_the_parent_leaves(known) -> None:
    found, change = known
    most = np.sqrt(np.max(change.squares / np.maximum(found.squares, found.parent.counts)))
    assert found.beyond(multiple(change, 0.999 / most)) is None
    assert found.beyond(multiple(change, 1.001 / most)) is not None


def test_what_is_taken_out_by_the_parents_own_promises_nothing(known) -> None:
    """A change that one of its parameters makes as well."""
    found, change = known
    assert found.parent.jacobian is not None
    scaled = [j[0] for j in found.parent.jacobian]
    same = Change(scaled, found.parent.by_block[0][:, :, 0, 0], found.parent.by_block[0][:, :, 0])
    gram, slope = found.weighed.products([same])
    prior = found.parent.space.precision[0]
    assert gram[0, 0] <= prior * (1.0 + 1e-6)
    both = found.weighed.products([same, change])[0]
    assert np.allclose(both, both.T) and np.isclose(both[1, 1], found.weighed.products([change])[0][0, 0])


@pytest.mark.parametrize("far", [np.nan, np.inf, 1e200, 1e100])
def test_a_guess_that_runs_away_changes_nothing_and_warns_of_nothing(known: tuple[Linearised, Change], far: float,
                                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    found = known[0]
    monkeypatch.setattr(Predictor, "runs", lambda self, space, x, own: [0.0 * y + far for y in found.parent.predicted])
    with np.errstate(all="raise"):
        assert found.change(found.parent.space, found.parent.x) is None

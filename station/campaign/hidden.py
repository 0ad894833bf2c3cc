"""Draws rigs with something hidden: constants within their uncertainty, and effects that show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from station.errors import WorkError
from station.model.beam import REAL_ELEMENTS
from station.model.effects import Effect, catalogue
from station.model.simulate import build, simulate_model
from station.rig import Rig
from station.runs.run import Run

CLEAR = 1000.0
"""Least chi squared that an effect must leave in the tests once the constants are fitted without it."""
STILL_MOVES = 0.3
"""Share of its range that the arm must keep, or the effect is a broken rig."""
SIZES = (0.7, 1.4)
"""Range of the factor on the size that the catalogue suggests."""
LEFT_OUT = frozenset({"clock_scale"})
"""By the angle and the acceleration alone this one is the same as other constants (a known equivalence)."""
FIT_STEPS = 8
DRAWS = 200
"""Rigs that are drawn before it is said that nothing shows."""


def places(nominal: Rig) -> list[tuple[str, str]]:
    """(effect, at) of everything that may be hidden in such a rig."""
    taken = {(effect.name, effect.at) for effect in nominal.effects}
    return [(name, at) for name, cls in catalogue().items() if name not in LEFT_OUT
            for at in cls.sites if cls.fits(nominal, at) and (name, at) not in taken]


def draw(nominal: Rig, tests: list[Run], noise: float, rng: np.random.Generator,
         hidden: Sequence[tuple[str, str]] | None = None) -> Rig:
    """A rig whose constants lie within two sigma of the nominal's, with effects of the catalogue.

    ``hidden`` are their names and places; None for one at random.  ``tests`` are runs whose references, controllers
    and commands stand for the tests to come, ``noise`` is the accelerometer's (counts): an effect that does not show
    in them by itself, or keeps the arm from moving, is drawn again.  WorkError where none shows.
    """
    choice = places(nominal)
    for _ in range(DRAWS):
        clean = _draw_constants(nominal, rng)
        chosen = [choice[rng.integers(len(choice))]] if hidden is None else hidden
        effects = [_draw_size(catalogue()[name], at, clean, rng) for name, at in chosen]
        if any(effect is None for effect in effects):
            continue
        alone = [clean.with_effects([*clean.effects, effect]) for effect in effects if effect is not None]
        found = clean.with_effects([*clean.effects, *(effect for effect in effects if effect is not None)])
        if all(_shows(nominal, clean, rig, tests, noise) for rig in alone) and (
                len(effects) < 2 or _moves(_outputs(clean, tests), _outputs(found, tests))):
            return found.with_elements(REAL_ELEMENTS)
    names = " and ".join(f"{name} at the {at}" for name, at in hidden) if hidden else "effect"
    raise WorkError(f"{nominal.name}: in {DRAWS} draws no {names} showed in the tests")


def _draw_constants(nominal: Rig, rng: np.random.Generator) -> Rig:
    """Logarithms from the prior, each of its factors cut at two sigma."""
    paths = list(nominal.constants())
    values, vectors = np.linalg.eigh(nominal.log_covariance(paths))
    scores = rng.normal(size=len(paths))
    while np.any(far := np.abs(scores) > 2.0):
        scores[far] = rng.normal(size=int(far.sum()))
    shift = vectors @ (np.sqrt(np.maximum(values, 0.0)) * scores)
    constants = nominal.constants()
    return nominal.with_constants({path: constants[path] * float(np.exp(d))
                                   for path, d in zip(paths, shift, strict=True)})


def _draw_size(kind: type[Effect], at: str, rig: Rig, rng: np.random.Generator) -> Effect | None:
    """One of the catalogue's suggestions for this rig, each size changed by a factor; None where out of bounds."""
    guesses = kind.guesses(rig, at)
    values = dict(guesses[rng.integers(len(guesses))])
    factor = float(np.exp(rng.uniform(*np.log(SIZES))))
    for name, info in kind.parameters().items():
        if info.periodic:
            values[name] += rng.uniform(-0.5, 0.5)
        elif name == "cycles":
            continue
        elif info.neutral is not None and np.isfinite(info.neutral):
            values[name] = info.neutral + (values[name] - info.neutral) * factor
        else:
            values[name] *= factor
    try:
        return kind(at=at, **values)
    except ValueError:
        return None


def _shows(nominal: Rig, clean: Rig, hidden: Rig, tests: list[Run], noise: float) -> bool:
    """Whether the effect shows in the tests beyond what other constants could imitate, and lets the arm move."""
    without, with_it = _outputs(clean, tests), _outputs(hidden, tests)
    return _moves(without, with_it) and severity(nominal, hidden, with_it, tests, noise) > CLEAR


def _moves(without: list[np.ndarray], with_it: list[np.ndarray]) -> bool:
    """Whether the arm still moves in every test."""
    return all(np.ptp(after[0]) >= STILL_MOVES * np.ptp(before[0])
               for before, after in zip(without, with_it, strict=True))


def severity(nominal: Rig, hidden: Rig, with_it: list[np.ndarray], tests: list[Run], noise: float) -> float:
    """Chi squared that the best re-fitted rig without the effect leaves, less that of the hidden rig itself.

    min over w of |y - y(w)|^2 + |w|^2, outputs y in units of their noise and free of each channel's mean, w the
    logarithms of the constants from the nominal ones in units of their stated uncertainty; by a few Gauss-Newton
    steps from the hidden constants, so that what is told is never too small.  ``with_it``: the hidden rig's outputs
    (channels, rows) per test, counts.
    """
    paths = list(nominal.constants())
    values = np.array(list(nominal.constants().values()))
    root = np.linalg.cholesky(nominal.log_covariance(paths))
    true = np.linalg.solve(root, np.log(np.array(list(hidden.constants().values())) / values))

    def residual(w: np.ndarray) -> np.ndarray:
        rig = nominal.with_constants(dict(zip(paths, values * np.exp(root @ w), strict=True)))
        try:
            return np.concatenate([_flat(_outputs(rig, tests), with_it, noise), w])
        except ArithmeticError:         # a step to constants that do not simulate: the solver takes a shorter one
            return np.full(sum(one.size for one in with_it) + len(w), np.inf)

    best = least_squares(residual, true, diff_step=1e-4, max_nfev=FIT_STEPS)
    return float(2.0 * best.cost - true @ true)


def _outputs(rig: Rig, tests: list[Run]) -> list[np.ndarray]:
    """Encoder and accelerometer (channels, rows) of each test, counts, not rounded."""
    model = build(rig)
    made = [simulate_model(model, run, rounding=False) for run in tests]
    return [np.array([one.encoder] if one.accel is None else [one.encoder, one.accel]) for one in made]


def _flat(outputs: list[np.ndarray], reference: list[np.ndarray], noise: float) -> np.ndarray:
    """Differences in units of their noise, each channel's mean taken off, as one vector."""
    sigma = np.sqrt(1.0 / 12.0 + np.array([0.0, noise**2]))
    return np.concatenate([
        ((a - b - (a - b).mean(axis=1, keepdims=True)) / sigma[: len(a), None]).ravel()
        for a, b in zip(outputs, reference, strict=True)])

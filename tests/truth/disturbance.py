"""Imperfect worlds: what a measured rig has besides its causes, by one level, the share of the signals that it takes.

At a level l of 0.02, with the rms of a run's torque by command and of its accelerometer's signal taken from the run
without any of this:

- torque missing at the motor: rms l of the command's torque, half of its power a coloured torque, half a gain that
  drifts slowly, within a run and from run to run;
- error of the accelerometer: rms l of its signal, half of its power by a coloured force at the tip (through the rig's
  linear part), half coloured noise of its own;
- modes slightly unlike the beam's: each of its frequencies with the root held by a factor of its own, log-normal with
  sigma l / 2, as a rigidity that varies by l along the beam gives;
- a start not quite at rest: turning with a speed, and bent in the first mode, normal with sigma l of their rms.

Coloured means Gauss-Markov: stationary, x' = -x / time + white noise, sampled exactly at the ticks and held.  The times
are drawn once for a case.  What is stated are standard deviations; one run's own rms scatters about them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve, lfilter

from .plant import MODES, transition

if TYPE_CHECKING:
    from .simulate import Output, Truth

Array = NDArray[np.float64]

TIMES = {"torque": (0.1, 2.0), "drift": (3.0, 20.0), "force": (0.02, 0.3), "noise": (0.004, 0.05)}
"""Range of each correlation time, s; drawn evenly in the logarithm."""
PIECE = 1000
"""Ticks whose readings' covariance is worked out whole; of a longer run what disturbs one piece of it is taken to be
independent of what disturbs the next."""
HELD = 5
"""Ticks for which a drift, which takes seconds, is held where its covariance is worked out."""
STREAM = 0xD157
"""Keeps these draws apart from all others of a seed."""


@dataclass(frozen=True)
class World:
    """How a case's world is imperfect; the same for all of its runs."""

    level: float
    times: dict[str, float]
    """Correlation time of each coloured disturbance, s."""
    detuning: tuple[float, ...]
    """Factor on each frequency of the beam with its root held."""


@dataclass(frozen=True)
class Pushes:
    """What disturbs one run, tick by tick (n)."""

    torque: Array  # N m on the motor
    drift: Array  # of the motor's gain, relative
    force: Array  # N on the tip
    noise: Array  # counts of the accelerometer
    speed: float  # rad/s at the start
    bend: float  # m at the tip at the start


def draw_world(seed: int, level: float) -> World | None:
    """The imperfect world of a case's seed; None at level 0."""
    if level == 0.0:
        return None
    rng = np.random.default_rng([seed, STREAM])
    times = {name: math.exp(rng.uniform(math.log(low), math.log(high))) for name, (low, high) in TIMES.items()}
    detuning = np.exp(0.5 * level * np.clip(rng.standard_normal(MODES), -2.0, 2.0))
    return World(level, times, tuple(detuning.tolist()))


def gauss_markov(rng: np.random.Generator, n: int, period: float, time: float) -> Array:
    """n samples of a stationary Gauss-Markov process of variance 1."""
    kept = math.exp(-period / time)
    white = math.sqrt(1.0 - kept * kept) * rng.standard_normal(n)
    white[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -kept], white)


def draw_pushes(world: World, truth: Truth, quiet: Output, seed: int) -> Pushes:
    """Disturbances of one run, in proportion to what `quiet`, the same run without any, shows."""
    rng = np.random.default_rng([seed, STREAM])
    n, level = len(quiet.t), world.level
    path = {name: gauss_markov(rng, n, truth.period, time) for name, time in world.times.items()}
    command, signal = shown(truth, quiet)
    share = level / math.sqrt(2.0)
    turns, bends = (level * float(np.std(x)) * rng.standard_normal() for x in _motion(truth, quiet))
    force = np.zeros(n)
    if truth.has_accelerometer:
        force = path["force"] * share * signal / rms(force_response(truth, path["force"]))
    return Pushes(torque=share * command * path["torque"], drift=share * path["drift"], force=force,
                  noise=share * signal * path["noise"], speed=turns, bend=bends)


def rms(x: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(x * x)))


def shown(truth: Truth, quiet: Output) -> tuple[float, float]:
    """rms of the torque by command, N m, and of the accelerometer's signal without its offset, counts."""
    accel = quiet.unrounded[1]
    return truth.gain * rms(quiet.trace[:, 13]), 0.0 if accel is None else float(np.std(accel))


def force_response(truth: Truth, force: Array) -> Array:
    """Accelerometer (n), counts, of the rig's linear part under a force (n), N, on the tip, in open loop."""
    system = truth.system
    a, b = transition(system, truth.period)
    z, out = np.zeros(len(a)), np.zeros(len(force))
    for i in range(1, len(force)):
        z = a @ z + b[:, 3] * force[i - 1]
        out[i] = system.c_acc @ z + system.d_acc[3] * force[i - 1]
    return truth.par["acc_gain"] * out


def _motion(truth: Truth, quiet: Output) -> tuple[Array, Array]:
    """Base speed, rad/s, and the tip's deflection from the line of the root, m; 0 without a beam."""
    speed, root, tip = quiet.trace[:, 3], quiet.trace[:, 4], quiet.trace[:, 6]
    return speed, tip - root * truth.rig["beam"]["length"] if truth.mech.has_tip else np.zeros(len(speed))


def covariances(world: World, truth: Truth, quiet: Output, run: Callable[..., Output]) -> list[tuple[Array, Array]]:
    """Covariance, counts^2, of what disturbances do to a run's readings, and its rows of all readings, piece by piece.

    `run(truth, pushes)` gives the run on a rig, without rounding and noise. Readings (c n) are all of a channel after
    the other; a piece has up to PIECE ticks, (c m), (c m, c m). What acts tick by tick goes through the loop's response
    to one tick of it (linear, as where nothing is at its limit): torque and drift at the motor, force at the tip, the
    accelerometer's own noise. Modes and start: by finite differences.
    """
    n, share = len(quiet.t), world.level / math.sqrt(2.0)
    channels = 2 if truth.has_accelerometer else 1
    decay = {name: math.exp(-truth.period / time) for name, time in world.times.items()}
    command, signal = shown(truth, quiet)

    def answer(**tick: float) -> Array:
        """(c, n) to so much of something at the first tick, per unit."""
        (name, size), = tick.items()
        pushed, still = (_readings(run(truth, _still(n, **{name: size * (np.arange(n) == k)}), np.zeros(n)))
                         for k in (0, n))
        return np.array([(a - b) / size for a, b in zip(pushed, still, strict=True)])[:channels]

    by_torque = answer(torque=1e-3 * truth.gain * truth.par["limit"])
    carried = [((share * command) ** 2, by_torque, decay["torque"])]
    if truth.has_accelerometer:
        kept = decay["force"]
        alone = lfilter([1.0], [1.0, -kept], force_response(truth, (np.arange(n) == 0).astype(float))) ** 2
        variance = float(np.mean((1.0 - kept * kept) * np.cumsum(alone) + kept * kept * alone))  # C[i, i] of `_carried`
        carried += [((share * signal) ** 2 / variance, answer(force=1e-3), kept),
                    ((share * signal) ** 2, answer(noise=1.0), decay["noise"])]
    acting = quiet.trace[np.minimum(np.arange(n) + 1, n - 1), 13]  # a tick's trace shows what acted until then
    drift = np.repeat(_shocks(-(-n // HELD), decay["drift"] ** HELD), HELD, axis=0)[:n]
    gains = share * truth.gain * acting[:, None] * drift
    moved = [np.concatenate([fftconvolve(a[:, None], gains, axes=0)[:n] for a in by_torque])]
    moved += [np.concatenate(small[:channels])[:, None] for small in _small(world, truth, quiet, run)]
    columns, found = np.hstack(moved), []
    for begin in range(0, n, PIECE):
        end = min(begin + PIECE, n)
        rows = np.concatenate([np.arange(begin, end) + n * channel for channel in range(channels)])
        total = sum(variance * _carried(answers, kept, begin, end) for variance, answers, kept in carried)
        found.append((rows, total + columns[rows] @ columns[rows].T))
    return found


def _carried(answers: Array, decay: float, begin: int, end: int) -> Array:
    """Covariance (c m, c m) at m ticks of a Gauss-Markov path of variance 1, behind responses (c, n) to one tick of it.

    With g the response to a shock that decays, shocks of variance 1 - decay^2, the first of 1, give

        C[i, j] = (1 - decay^2) sum over k <= min(i, j) of g[i - k] g'[j - k] + decay^2 g[i] g'[j].
    """
    g = lfilter([1.0], [1.0, -decay], answers, axis=1)[:, :end]
    channels, m = len(g), end - begin
    total = np.zeros((channels, m, channels, m))
    for one in range(channels):
        for other in range(channels):
            total[one, 0, other] = np.correlate(g[other], g[one, : begin + 1], "valid")
            total[other, :, one, 0] = total[one, 0, other]
    for i in range(1, m):
        total[:, i, :, 1:] = total[:, i - 1, :, :-1] + g[:, begin + i, None, None] * g[:, begin + 1 :]
    first = decay * g[:, begin:].ravel()
    return (1.0 - decay * decay) * total.reshape(channels * m, -1) + np.outer(first, first)


def _shocks(n: int, decay: float) -> Array:
    """(n, n) a Gauss-Markov path of variance 1 by its independent shocks: the covariance's lower Cholesky factor."""
    ages = np.subtract.outer(np.arange(n), np.arange(n))
    sizes = np.where(np.arange(n) == 0, 1.0, math.sqrt(1.0 - decay * decay))
    return np.where(ages >= 0, decay ** np.maximum(ages, 0), 0.0) * sizes


def _small(world: World, truth: Truth, quiet: Output, run: Callable[..., Output]) -> list[Array]:
    """(2, n) each: what one standard deviation of a start's speed and bend, and of every mode's factor, does."""
    n, still = len(quiet.t), np.array(_readings(quiet))
    speed, bend = (world.level * float(np.std(x)) for x in _motion(truth, quiet))
    starts = _still(n, speed=speed), _still(n, bend=bend)
    found = [np.array(_readings(run(truth, start))) - still for start in starts]
    for mode in range(MODES if truth.mech.has_tip else 0):
        factors = np.ones(MODES)
        factors[mode] = math.exp(0.05 * world.level)
        found.append((np.array(_readings(run(truth.detuned(factors), None))) - still) / 0.1)
    return found


def _still(n: int, **pushes: Any) -> Pushes:
    zero = np.zeros(n)
    return Pushes(**({"torque": zero, "drift": zero, "force": zero, "noise": zero, "speed": 0.0, "bend": 0.0} | pushes))


def _readings(out: Output) -> tuple[Array, Array]:
    return out.encoder, np.zeros(len(out.encoder)) if out.accel is None else out.accel

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
NODES = 5.0
"""Per correlation time, of paths that are worked out rather than drawn."""
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


def directions(world: World, truth: Truth, quiet: Output, run: Callable[..., Output]) -> tuple[Array, Array]:
    """What slow disturbances may do to a run's encoder and accelerometer: (n, m) counts each, columns of variance 1.

    `run(truth, pushes)` gives the run on a rig, without rounding and noise. Torque and drift: nodes NODES per
    correlation time, joined by straight lines, through the loop's response to one tick of torque (linear, as where
    nothing is at its limit). Modes and start: by finite differences. Force and noise are left to `signal_share`.
    """
    n, share = len(quiet.t), world.level / math.sqrt(2.0)
    acting = quiet.trace[np.minimum(np.arange(n) + 1, n - 1), 13]  # a tick's trace shows what acted until then
    paths = [share * shown(truth, quiet)[0] * _nodes(n, truth.period, world.times["torque"]),
             share * truth.gain * acting[:, None] * _nodes(n, truth.period, world.times["drift"])]
    tick = 1e-3 * truth.gain * truth.par["limit"]
    pulse = [_readings(run(truth, _still(n, torque=tick * (np.arange(n) == k)), np.zeros(n))) for k in (0, n)]
    answers = [(one - other)[:, None] / tick for one, other in zip(*pulse, strict=True)]
    found = [fftconvolve(answers[channel], np.hstack(paths), axes=0)[:n] for channel in (0, 1)]
    speed, bend = (world.level * float(np.std(x)) for x in _motion(truth, quiet))
    still = [_readings(quiet)]
    moved = [_readings(run(truth, _still(n, speed=speed))), _readings(run(truth, _still(n, bend=bend)))]
    for mode in range(MODES if truth.mech.has_tip else 0):
        factors = np.ones(MODES)
        factors[mode] = math.exp(0.05 * world.level)
        change = [(a - b) / 0.1 for a, b in zip(_readings(run(truth.detuned(factors), None)), still[0], strict=True)]
        moved.append([b + c for b, c in zip(still[0], change, strict=True)])
    for channel in (0, 1):
        extra = np.array([row[channel] - still[0][channel] for row in moved]).T
        found[channel] = np.hstack([found[channel], extra])
    return found[0], found[1]


def signal_share(world: World, truth: Truth, quiet: Output) -> float:
    """Standard deviation of the accelerometer's own disturbance, by force and noise together, counts."""
    return world.level * shown(truth, quiet)[1]


def _nodes(n: int, period: float, time: float) -> Array:
    """Paths (n, m) of a Gauss-Markov process of variance 1, one per independent number."""
    count = max(2, math.ceil(NODES * n * period / time)) + 1
    places = np.linspace(0.0, n * period, count)
    lower = np.linalg.cholesky(np.exp(-np.abs(places[:, None] - places) / time))
    t = np.arange(n) * period
    hats = np.array([np.interp(t, places, row) for row in np.eye(count)]).T
    return hats @ lower


def _still(n: int, **pushes: Any) -> Pushes:
    zero = np.zeros(n)
    return Pushes(**({"torque": zero, "drift": zero, "force": zero, "noise": zero, "speed": 0.0, "bend": 0.0} | pushes))


def _readings(out: Output) -> tuple[Array, Array]:
    encoder, accel = out.unrounded
    return encoder, np.zeros(len(encoder)) if accel is None else accel

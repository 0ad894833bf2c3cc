"""Blind cases: tests of the station on a hidden rig, and how plainly the hidden cause shows in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from station.runs.run import Run, RunMetadata

from . import sizes
from .disturbance import Pushes, World, covariances, draw_pushes, draw_world
from .rigs import SERVO, SFLR, RigDict, draw_logs, get_constant, own_sigma, shifted, uncertain_keys, with_constants
from .simulate import CONTROLLERS, OUTSIDE, Effect, Output, Truth

Array = NDArray[np.float64]
REST = 0.2  # s before every test


@dataclass(frozen=True)
class Test:
    """One test: what the station's metadata say of it, the compensator's name, the reference in counts."""

    __test__ = False
    kind: dict[str, Any]
    controller: str
    reference: Array

    @property
    def name(self) -> str:
        return f"{self.kind['kind']}-{self.controller}"


def step_test(rate: float, controller: str, amplitude: float, duration: float = 2.0) -> Test:
    """Rest, then a step of `amplitude` counts."""
    reference = np.zeros(round(duration * rate))
    reference[round(REST * rate) :] = amplitude
    return Test({"kind": "step", "amplitude": amplitude, "duration": duration}, controller, reference)


def pulse_test(rate: float, amplitude: float, width: float = 0.1, both: bool = True, duration: float = 2.0) -> Test:
    """Open loop: rest, a pulse of `amplitude` counts, and from 60 % of the run on the opposite one."""
    reference = np.zeros(round(duration * rate))
    first, long = round(REST * rate), round(width * rate)
    second = round(0.6 * duration * rate) if both else len(reference)
    reference[first : first + long] = amplitude
    reference[second : second + long] = -amplitude
    kind = {"kind": "pulse", "amplitude": amplitude, "width": width, "second": second / rate, "duration": duration}
    return Test(kind, "open", reference)


def sweep_test(
    rate: float,
    amplitude: float,
    f0: float = 0.3,
    f1: float = 15.0,
    duration: float = 12.0,
    controller: str = "p1",
) -> Test:
    """Rest, then a sine of whole counts whose frequency grows exponentially from f0 to f1 Hz."""
    n, rest = round(duration * rate), round(REST * rate)
    t = np.arange(n - rest) / rate
    length = (n - rest) / rate
    k = math.log(f1 / f0) / length
    reference = np.zeros(n)
    reference[rest:] = np.floor(amplitude * np.sin(2 * np.pi * f0 * (np.exp(k * t) - 1.0) / k) + 0.5)
    kind = {"kind": "sweep", "amplitude": amplitude, "f0": f0, "f1": f1, "duration": duration}
    return Test(kind, controller, reference)


def multisine_test(rate: float, amplitude: float, seed: int, duration: float = 4.0, controller: str = "p1") -> Test:
    """Rest, then twelve sines from 0.5 to 12 Hz, random phases, scaled so that the largest value is
    `amplitude`."""
    rng = np.random.default_rng(seed)
    n, rest = round(duration * rate), round(REST * rate)
    t = np.arange(n - rest) / rate
    tones = np.geomspace(0.5, 12.0, 12)[:, None]
    wave = np.sin(2 * np.pi * tones * t + rng.uniform(0, 2 * np.pi, (12, 1))).sum(axis=0)
    wave -= wave[0]
    reference = np.zeros(n)
    reference[rest:] = np.floor(amplitude * wave / np.max(np.abs(wave)) + 0.5)
    kind = {"kind": "multisine", "amplitude": amplitude, "seed": seed, "duration": duration}
    return Test(kind, controller, reference)


def prbs_test(rate: float, amplitude: float, seed: int, hold: float = 0.04, duration: float = 3.0) -> Test:
    """Open loop: rest, then +-amplitude at random every `hold` seconds, every other interval the opposite."""
    rng = np.random.default_rng(seed)
    n, rest, each = round(duration * rate), round(REST * rate), round(hold * rate)
    halves = rng.choice([-1.0, 1.0], size=n // (2 * each) + 1)
    signs = np.column_stack([halves, -halves]).ravel()
    reference = np.zeros(n)
    reference[rest:] = amplitude * np.repeat(signs, each)[: n - rest]
    kind = {"kind": "prbs", "amplitude": amplitude, "seed": seed, "hold": hold, "duration": duration}
    return Test(kind, "open", reference)


def draw_tests(rng: np.random.Generator, rig: RigDict = SFLR, count: int | None = None) -> list[Test]:
    """Five to eight tests: at least a pulse and two steps under different compensators; whole amplitudes."""
    rate = rig["sample_rate"]
    loops = ["p1", "p2", "lead"] + (["lead_accel"] if rig.get("accelerometer") else [])

    def amplitude(low: int, high: int) -> float:
        return float(rng.choice([-1, 1], p=[0.25, 0.75]) * rng.integers(low, high + 1))

    def step(controller: str) -> Test:
        return step_test(rate, controller, amplitude(30, 200), float(rng.choice([2.0, 2.0, 3.0])))

    def pulse() -> Test:
        width = float(rng.choice([0.06, 0.1, 0.2]))
        return pulse_test(rate, amplitude(60, 180), width, bool(rng.random() < 0.7), float(rng.choice([2.0, 3.0])))

    count = int(rng.integers(5, 9)) if count is None else count
    tests = [pulse(), *(step(c) for c in rng.permutation(loops)[:2])]
    while len(tests) < count:
        pick = rng.choice(["step", "pulse", "sweep", "multisine", "prbs"], p=[0.45, 0.2, 0.2, 0.1, 0.05])
        if pick == "sweep" and any(t.kind["kind"] == "sweep" for t in tests):
            pick = "step"
        if pick == "step":
            tests.append(step(str(rng.choice(loops))))
        elif pick == "pulse":
            tests.append(pulse())
        elif pick == "sweep":
            f1, duration = float(rng.uniform(8.0, 20.0)), float(rng.choice([8.0, 10.0, 14.0]))
            tests.append(sweep_test(rate, abs(amplitude(20, 60)), 0.3, f1, duration))
        elif pick == "multisine":
            tests.append(multisine_test(rate, abs(amplitude(40, 100)), int(rng.integers(1 << 30))))
        else:
            tests.append(prbs_test(rate, abs(amplitude(60, 160)), int(rng.integers(1 << 30))))
    return [tests[i] for i in rng.permutation(count)]


def draw_servo_tests(rng: np.random.Generator, rig: RigDict, count: int | None = None) -> list[Test]:
    """Five to eight tests of a servo under its own position loop, soft and stiff: sweeps, sums of sines and steps."""
    rate = rig["sample_rate"]
    count = int(rng.integers(5, 9)) if count is None else count
    tests = []
    for k in range(count):
        loop = ("servo_soft", "servo_stiff")[k % 2]
        kind = rng.choice(["sweep", "multisine", "step"]) if k > 1 else ("sweep", "multisine")[k]
        if kind == "step" and loop == "servo_stiff":
            tests.append(step_test(rate, loop, float(rng.choice([-1, 1]) * rng.integers(150, 401)), 3.0))
        elif kind == "multisine":
            tests.append(multisine_test(rate, float(rng.integers(400, 1001)), int(rng.integers(1 << 30)), 6.0, loop))
        else:
            f1 = float(rng.uniform(1.0, 3.0))
            tests.append(sweep_test(rate, float(rng.integers(300, 901)), 0.2, f1, 6.0, loop))
    return [tests[i] for i in rng.permutation(count)]


@dataclass(frozen=True)
class Conditions:
    """What surrounds one run and no cause explains: nuisances and noise."""

    start: str = "released"
    start_angle: float = 0.0  # rad
    gap_place: float = 0.0  # of half the gap
    zero_angle: float = 0.0  # rad
    accel_offset: float = 0.0  # counts
    accel_sigma: float = 1.0  # counts, before rounding
    seed: int = 0


@dataclass(frozen=True)
class Case:
    """`runs` is all that a diagnosis may see; `truth` is sealed: causes, constants, conditions, severity."""

    runs: list[Run]
    truth: dict[str, Any]
    rig: RigDict
    effects: list[Effect] = field(repr=False)
    tests: list[Test] = field(repr=False)
    conditions: list[Conditions] = field(repr=False)


def simulate_case(
    constants: RigDict,
    effects: Sequence[Effect],
    tests: Sequence[Test],
    conditions: Sequence[Conditions],
    exact: bool = False,
    step: float = 1e-4,
    world: World | None = None,
) -> list[Output]:
    """Every test of a case on one rig. `exact` leaves rounding and noise away, for severities; `world` is what else
    disturbs the runs."""
    truth = Truth(constants, effects, step, detuning=world.detuning if world else ())
    outputs = []
    for test, c in zip(tests, conditions, strict=True):
        made = _run(truth, test, c, exact)
        if world is not None:
            made = _run(truth, test, c, exact, draw_pushes(world, truth, made, c.seed))
        outputs.append(made)
    return outputs


def _run(
    truth: Truth, test: Test, c: Conditions, exact: bool, pushes: Pushes | None = None, reference: Array | None = None
) -> Output:
    """One test under its conditions; `reference` in place of its own."""
    return truth.run(
        test.reference if reference is None else reference,
        CONTROLLERS[test.controller],
        start=c.start,
        start_angle=c.start_angle,
        gap_place=c.gap_place,
        zero_angle=c.zero_angle,
        accel_offset=c.accel_offset,
        accel_sigma=0.0 if exact else c.accel_sigma,
        rounding=not exact,
        rng=np.random.default_rng(c.seed),
        pushes=pushes,
    )


def _weighted(outputs: Sequence[Output], conditions: Sequence[Conditions], read: bool = False) -> Array:
    """All outputs in one column, each over the sigma of its noise and rounding; `read`: as read, else before that."""
    parts = []
    for out, c in zip(outputs, conditions, strict=True):
        channels = (out.encoder, out.accel) if read else out.unrounded
        parts += [y / sigma for y, sigma in zip(channels, _sigmas(c), strict=True) if y is not None]
    return np.concatenate(parts)


def _sigmas(c: Conditions) -> tuple[float, float]:
    """Of noise and rounding of the encoder and the accelerometer, counts."""
    return math.sqrt(0.05**2 + 1 / 12), math.sqrt(c.accel_sigma**2 + 1 / 12)


class Severity:
    """Chi squared that the best re-fitted rig without a cause loses against the rig with it, on the case's own data.

    `constants` is the drawn rig, `logs` and `commons` what it was drawn with (`draw_logs`), which the uncertainty
    weighs; `others` are causes that both rigs have. Fitted without the cause, by Gauss-Newton from the true constants,
    a parameter cause's included: every uncertain constant and common factor under its uncertainty, each run's
    starting angle and accelerometer offset freely. The same freedom, linearised, is granted with the cause; a
    parameter cause has its own uncertainty set aside there. The fit sees outputs of loops without rounding and noise
    (rounding inside a loop moves every rig at random). The smaller of two numbers counts: as it stands, and with the
    rounding and noise of the case's own readings in both rigs' residuals. So what hides below the rounding counts for
    nothing, and what the rounding feigns does neither.

    In an imperfect `world` the errors are not white: a misfit counts by what noise and disturbances together leave of
    it (generalised least squares; `covariances` of the disturbances, on the rig without effects).
    """

    def __init__(
        self,
        constants: RigDict,
        logs: dict[str, float],
        commons: dict[str, float],
        tests: Sequence[Test],
        conditions: Sequence[Conditions],
        others: Sequence[Effect] = (),
        world: World | None = None,
    ) -> None:
        self.constants, self.tests, self.conditions, self.others = constants, tests, conditions, list(others)
        sigmas = constants["uncertainty"]
        self.keys = uncertain_keys(constants)
        self.tables = sorted({k.split(".")[0] for k in self.keys} & set(sigmas))
        self.own = np.array([own_sigma(sigmas, k) for k in self.keys] + [sigmas[t] for t in self.tables])
        drawn = [logs[k] for k in self.keys]
        drawn += [max((v for k, v in commons.items() if k.startswith(f"{t}.")), key=abs) for t in self.tables]
        self.z0 = np.array(drawn) / self.own
        n = len(tests)
        self.start = np.r_[self.z0, np.zeros(2 * n)]
        self.weight = np.r_[np.ones(len(self.own)), np.full(2 * n, 1e-3)]
        per_row = 2 if constants.get("accelerometer") and constants.get("beam") else 1
        self.edges = np.cumsum([0] + [len(t.reference) * per_row for t in tests])
        self.white = self._whitening(world) if world is not None else []
        self.y0 = self._model(self.start)
        self.s0 = self._slopes(self.start, self.y0)

    def _whitening(self, world: World) -> list[tuple[Array, Array]]:
        """Rows of the weighted outputs, and the lower Cholesky factor of their covariance by noise and disturbances."""
        truth, found = Truth(self.constants), []
        for test, c, first in zip(self.tests, self.conditions, self.edges[:-1], strict=True):

            def run(truth: Truth, pushes: Pushes | None, reference: Array | None = None, test: Test = test,
                    c: Conditions = c) -> Output:
                return _run(truth, test, replace(c, start="released"), True, pushes, reference)

            for rows, covariance in covariances(world, truth, run(truth, None), run):
                scale = 1.0 / np.array(_sigmas(c))[rows // len(test.reference)]
                whole = np.eye(len(rows)) + scale[:, None] * covariance * scale
                found.append((first + rows, cholesky(whole, lower=True)))
        return found

    def _counted(self, columns: Array) -> Array:
        """Differences of weighted outputs (n, ...) with noise and disturbances made white."""
        if not self.white:
            return columns
        counted = np.empty_like(columns)
        for rows, lower in self.white:
            counted[rows] = solve_triangular(lower, columns[rows], lower=True)
        return counted

    def _model(self, z: Array) -> Array:
        """Weighted outputs without the cause; z: constants in sigmas, angles in 0.01 rad, offsets in counts."""
        m, n = len(self.own), len(self.tests)
        moved = (z[:m] - self.z0) * self.own
        by_key = dict(zip(self.keys, moved, strict=False))
        for table, shift in zip(self.tables, moved[len(self.keys) :], strict=True):
            for name in ("inertia", "damping", "gain"):
                if f"{table}.{name}" in by_key:
                    by_key[f"{table}.{name}"] += shift
        around = [
            replace(c, start_angle=c.start_angle + 0.01 * a, accel_offset=c.accel_offset + b)
            for c, a, b in zip(self.conditions, z[m : m + n], z[m + n :], strict=True)
        ]
        outputs = simulate_case(shifted(self.constants, by_key), self.others, self.tests, around, exact=True)
        return _weighted(outputs, around)

    def _slopes(self, z: Array, y: Array) -> Array:
        """Derivatives of the outputs y at z by z, noise and disturbances made white."""
        m, n = len(self.own), len(self.tests)
        s = np.zeros((len(y), len(z)))
        for k in range(m):
            d = np.zeros(len(z))
            d[k] = 1e-5 / max(self.own[k], 0.05)
            s[:, k] = (self._model(z + d) - y) / d[k]
        for block in (m, m + n):  # one run's nuisance moves that run alone
            d = np.zeros(len(z))
            d[block : block + n] = 1e-3
            moved = (self._model(z + d) - y) / 1e-3
            for r in range(n):
                rows = slice(self.edges[r], self.edges[r + 1])
                s[rows, block + r] = moved[rows]
        return self._counted(s)

    def _imitation(self, cause: Effect) -> Array:
        """The move of the constants that is this cause: of a constant itself; of a clock, time measured in its ticks.

        With true time = ratio x clock time, M q'' + C q' + K q reads M / ratio^2, C / ratio, K in clock time, and an
        acceleration in clock time is ratio^2 times the true one.
        """
        move = np.zeros(len(self.start))
        name = cause["effect"].removeprefix("parameter:")
        for k, key in enumerate(self.keys):
            last = key.split(".")[1]
            log = 0.0
            if key == name:
                log = math.log(cause["value"] / get_constant(self.constants, key))
            elif name == "clock_scale" and (
                last in ("inertia", "mass", "mass_per_length") or key == "accelerometer.gain"
            ):
                log = -2.0 * math.log(cause["ratio"])
            elif name == "clock_scale" and last == "damping":
                log = -math.log(cause["ratio"])
            move[k] = log / self.own[k]
        return move

    def of(self, cause: Effect, turns: int = 12) -> float:
        """The severity of `cause`; with few turns an upper bound of it. inf where the rig runs away."""
        effects = [*self.others, cause]
        outputs = simulate_case(self.constants, effects, self.tests, self.conditions, exact=True)
        truth = _weighted(outputs, self.conditions)
        if not np.all(np.isfinite(truth)):
            return math.inf
        z, y, s = self.start, self.y0, self.s0
        with_z, with_s, free = z, s, self.weight
        name = cause["effect"].removeprefix("parameter:")
        if name in self.keys or name == "clock_scale":  # constants alone can be this truth: the fit starts there
            z, y = z + self._imitation(cause), truth
            s = self._slopes(z, y)
        if name in self.keys:
            with_z, with_s, free = z, s, self.weight.copy()
            free[self.keys.index(name)] = 0.0

        def objective(y: Array, z: Array) -> float:
            gap = truth - y
            if not np.all(np.isfinite(gap)):
                return math.inf
            return float(np.sum(self._counted(gap) ** 2) + np.sum((self.weight * z) ** 2))

        best = objective(y, z)
        for turn in range(turns):
            if turn:
                s = self._slopes(z, y)
            move = _least_squares(s, self._counted(truth - y), self.weight, z)
            reach = min(1.0, 6.0 / float(np.max(np.abs(move[: len(self.own)]))))
            for shrink in reach * np.array([1.0, 0.4, 0.1, 0.02]):
                y_new = self._model(z + shrink * move)
                value = objective(y_new, z + shrink * move)
                if np.isfinite(value) and value < best:
                    break
            else:
                break
            gained, best, z, y = best - value, value, z + shrink * move, y_new
            if gained < 0.02 * max(best, 5.0):
                break
        outputs = simulate_case(self.constants, effects, self.tests, self.conditions)
        noise = self._counted(_weighted(outputs, self.conditions, read=True) - _weighted(outputs, self.conditions))
        known = noise
        if name == "stuck_bit":  # what the bit adds is noise to the rig without it alone
            quiet = simulate_case(self.constants, self.others, self.tests, self.conditions)
            known = self._counted(_weighted(quiet, self.conditions, read=True) - _weighted(quiet, self.conditions))
        # Both rigs' constants at last make of the noise, and of nearness to nominal, what pays.
        gap = self._counted(truth - y)
        read = _best(s, gap + noise, self.weight, z) - _best(with_s, known, free, with_z)
        if name == "stuck_bit":
            return read
        return min(read, _best(s, gap, self.weight, z) - _best(with_s, 0.0 * gap, free, with_z))


def _least_squares(s: Array, residual: Array, weight: Array, z: Array) -> Array:
    """The move that minimises |residual - s move|^2 + |weight (z + move)|^2, columns scaled alike."""
    scale = 1.0 / np.sqrt(np.sum(s * s, axis=0) + weight * weight + 1e-12)
    scaled_s = s * scale
    normal = scaled_s.T @ scaled_s + np.diag((weight * scale) ** 2 + 1e-12)
    return scale * np.linalg.solve(normal, scaled_s.T @ residual - scale * weight * weight * z)


def _best(s: Array, residual: Array, weight: Array, z: Array) -> float:
    """The minimum of |residual - s move|^2 + |weight (z + move)|^2 over the move."""
    move = _least_squares(s, residual, weight, z)
    return float(np.sum((residual - s @ move) ** 2) + np.sum((weight * (z + move)) ** 2))


def behaves(outputs: Sequence[Output], tests: Sequence[Test], rig: RigDict) -> bool:
    """Whether the runs are of a rig that a laboratory would work with.

    Every reading finite and within three times the reference and one turn; every step under a compensator has
    calmed down: over the last 0.4 s the encoder stays within a third of the step of its mean, and that mean
    is within half a step of the reference.
    """
    turn = rig["encoder"]["counts_per_revolution"]
    tail = round(0.4 * rig["sample_rate"])
    for out, test in zip(outputs, tests, strict=True):
        if not np.all(np.isfinite(out.encoder)):
            return False
        closed = test.controller != "open"
        if np.max(np.abs(out.encoder)) > (3 * np.max(np.abs(test.reference)) + 50 if closed else 2 * turn):
            return False
        if out.accel is not None and not np.all(np.abs(out.accel) < 2000):
            return False
        if test.kind["kind"] == "step":
            size = abs(test.kind["amplitude"])
            end = out.encoder[-tail:]
            if np.ptp(end) > size / 3 + 4 or abs(end.mean() - test.reference[-1]) > size / 2 + 10:
                return False
    return True


def make_case(
    seed: int,
    effects: Sequence[str | tuple[str, str] | Effect] = (),
    tests: Sequence[Test] | None = None,
    *,
    nominal: RigDict = SFLR,
    band: str | tuple[float, float] | None = "clear",
    limit: float = 2.0,
    accel_sigma: float | None = None,
    count: int | None = None,
    host_time: bool | None = None,
    disturbance: float = 0.0,
    sized_in_world: bool = False,
    known_controller: bool = True,
) -> Case:
    """A blind case, the same for the same arguments.

    `effects`: names, (name, at) or whole effects. A named effect is drawn and, alone on this rig in these tests,
    sized until its severity falls into `band` ("clear", "subtle", a range, or None for the size as drawn); a whole
    effect stays as given. Two kinds are not sized: clock_scale, which constants imitate exactly and which only
    `host_time` shows (columns that every second case has, and every one with that effect, unless told otherwise), and
    effects outside the catalogue, which are drawn until their severity exceeds 200. A rig that does not behave
    (`behaves`: without and with its effects) is drawn again. A ValueError says that no draw reached the band; for a
    parameter cause also that its own uncertainty is too wide for any size to reach it.

    `disturbance` is the level of what is imperfect besides (`disturbance`), 0 for a perfect world. Rig, causes, their
    sizes and severities, tests and conditions are those of the perfect world, unless its disturbed runs do not behave.
    What was plain there may be hard to see here: `severity_in_world` says how plain it is (`Severity`). With
    `sized_in_world` it is this severity that falls into the band; rig, tests and conditions may then be others.
    Without `known_controller` the runs do not say what closed their loops.
    """
    world = draw_world(seed, disturbance)
    rng = np.random.default_rng([seed, 0x57A7])
    target = sizes.BANDS[band] if isinstance(band, str) else band
    for name in (e for e in effects if isinstance(e, str) and e.startswith("parameter:")):
        most = sizes.largest_parameter(name, nominal) ** 2
        if target is not None and most < target[0]:
            raise ValueError(
                f"{name}: moved as far as is physical it costs its own uncertainty {most:.0f} of chi squared"
            )
    reason, unsized = "no rig behaved", 0
    for _ in range(40):
        own, common = draw_logs(nominal, None, rng, limit)
        rig = shifted(nominal, own, common)
        if rig.get("drive") is None and "back_emf" not in rig["motor"]:
            # No rig file says it; of a generator of its own, so that seeds keep their other draws.
            rig["motor"]["back_emf"] = float(np.random.default_rng([seed, 0xE3F]).uniform())
        draw = draw_servo_tests if nominal["name"] == SERVO["name"] else draw_tests
        drawn_tests = list(tests) if tests is not None else draw(rng, nominal, count)
        conditions = _draw_conditions(rng, drawn_tests, accel_sigma)
        if not behaves(simulate_case(rig, [], drawn_tests, conditions), drawn_tests, rig):
            continue
        measure = Severity(rig, own, common, drawn_tests, conditions, world=world if sized_in_world else None)
        settled: list[Effect] = []
        grades: dict[str, float] = {}
        for wanted in effects:
            effect = _sized(wanted, rig, nominal, common, measure, target, rng)
            if effect is None:
                reason = f"no size of {wanted} reached {target}"
                break
            settled.append(effect[0])
            grades[f"{effect[0]['effect']}@{effect[0]['at']}"] = effect[1]
        if len(settled) < len(effects):
            unsized += 1
            if unsized == 8:
                break
            continue
        conditions = _settle_conditions(rng, rig, settled, conditions)
        outputs = simulate_case(rig, settled, drawn_tests, conditions)
        if not behaves(outputs, drawn_tests, rig):
            reason = "no rig behaved with its effects"
            continue
        if world is not None:
            outputs = simulate_case(rig, settled, drawn_tests, conditions, world=world)
            if not behaves(outputs, drawn_tests, rig):
                reason = "no rig behaved in this world"
                continue
        case = _case(seed, rig, nominal, settled, grades, drawn_tests, conditions, outputs, own, common, rng, host_time)
        if world is not None:
            other = Severity(rig, own, common, drawn_tests, conditions, world=None if sized_in_world else world)
            seen = dict(zip(grades, map(other.of, settled), strict=True))
            perfect, here = (seen, grades) if sized_in_world else (grades, seen)
            case.truth.update(severity=perfect, severity_in_world=here, disturbance=asdict(world))
        if not known_controller:
            case.runs[:] = [replace(r, metadata=r.metadata.model_copy(update={"controller": {"kind": "unknown"}}))
                            for r in case.runs]
        return case
    raise ValueError(f"seed {seed}, {list(effects)}: {reason}")


def _draw_conditions(rng: np.random.Generator, tests: Sequence[Test], sigma: float | None) -> list[Conditions]:
    """Starting angles of a bench that is not zeroed between runs; noise like that of the measured rig."""
    level = float(rng.uniform(0.4, 1.3)) if sigma is None else sigma
    spread = float(rng.choice([0.25, 3.0])) * 2 * math.pi / 1024
    return [
        Conditions(
            start_angle=float(rng.normal(0.0, spread)),
            gap_place=float(rng.uniform(-1.0, 1.0)),
            accel_offset=float(rng.normal(0.0, 1.5)),
            accel_sigma=level,
            seed=int(rng.integers(1 << 31)),
        )
        for _ in tests
    ]


def _settle_conditions(
    rng: np.random.Generator, rig: RigDict, effects: Sequence[Effect], conditions: list[Conditions]
) -> list[Conditions]:
    """One case in six starts in equilibrium, where there is one."""
    if rng.random() > 1 / 6:
        return conditions
    truth = Truth(rig, effects)
    try:
        for c in conditions:
            angle, _ = truth.equilibrium(c.start_angle, c.gap_place)
            if abs(angle - c.start_angle) > 0.3:
                return conditions
    except ValueError:
        return conditions
    return [replace(c, start="equilibrium") for c in conditions]


def _sized(
    wanted: str | tuple[str, str] | Effect,
    rig: RigDict,
    nominal: RigDict,
    common: dict[str, float],
    severity: Severity,
    target: tuple[float, float] | None,
    rng: np.random.Generator,
) -> tuple[Effect, float] | None:
    """The effect at a size whose severity lies in the band, and that severity; None where none does."""
    tests, conditions = severity.tests, severity.conditions

    def grade(effect: Effect, turns: int = 12) -> float:
        if not behaves(simulate_case(rig, [effect], tests, conditions), tests, rig):
            return math.nan
        return severity.of(effect, turns)

    if isinstance(wanted, dict):
        return wanted, grade(wanted)
    name, at = (wanted, None) if isinstance(wanted, str) else wanted
    centre = shifted(nominal, common)
    if name == "clock_scale":
        effect = sizes.draw_effect(name, rng, rig, at)
        return effect, grade(effect)
    if name in OUTSIDE:
        for _ in range(8):
            effect = sizes.draw_effect(name, rng, rig)
            value = grade(effect)
            if np.isfinite(value) and (target is None or value >= 200.0):
                return effect, value
        return None
    shape = sizes.draw_effect(name, rng, rig, at)
    if target is None:
        effect = sizes.scaled(shape, 1.0, rig, centre)
        return (effect, grade(effect)) if effect else None
    low, high, factor = None, None, 1.0
    top = target[1]
    if name.startswith("parameter:"):
        top = max(min(top, 0.85 * sizes.largest_parameter(name, nominal) ** 2), target[0])
    goal = math.exp(rng.uniform(math.log(target[0]), math.log(top)))
    if name.startswith("parameter:"):  # severity is at most the squared distance in sigmas
        factor = max(1.0, math.sqrt(1.1 * goal) / sizes.PARAMETER_SIGMAS)
    for _ in range(16):
        effect = sizes.scaled(shape, factor, rig, centre)
        value = grade(effect, 1) if effect else math.nan
        if effect and 0.6 * goal < value < 1.6 * goal:
            value = grade(effect)
            if target[0] <= value <= target[1]:
                return effect, value
        if effect and value < goal:
            low = factor
        else:
            high = factor
        if low is None:
            factor = high / 3.0
            if name.startswith("parameter:"):
                factor = max(1.0, high / 1.4)
                if high == 1.0:
                    return None  # plainer than asked at the smallest size that is a cause, or not a workable rig
        elif high is None:
            factor = low * (1.3 if name.startswith("parameter:") else 3.0)
        else:
            factor = math.sqrt(low * high)
            if high / low < 1.01:
                return None
    return None


def _case(
    seed: int,
    rig: RigDict,
    nominal: RigDict,
    effects: list[Effect],
    grades: dict[str, float],
    tests: list[Test],
    conditions: list[Conditions],
    outputs: list[Output],
    own: dict[str, float],
    common: dict[str, float],
    rng: np.random.Generator,
    host_time: bool | None,
) -> Case:
    """Blind runs and the sealed truth."""
    clocked = bool(rng.random() < 0.5) or any(e["effect"] == "clock_scale" for e in effects)
    clocked = clocked if host_time is None else host_time
    ratio = next((e["ratio"] for e in effects if e["effect"] == "clock_scale"), 1.0)
    runs = []
    for k, (test, c, out) in enumerate(zip(tests, conditions, outputs, strict=True)):
        n = np.arange(len(out.t), dtype=float)
        late = float(rng.uniform(0.0, 1e4)) + rng.exponential(2e-4, len(n))
        metadata = RunMetadata(
            rig=nominal["name"],
            controller=CONTROLLERS[test.controller],
            test=test.kind,
            zero_id="bench",
            start=c.start,
            command_row=-1,
            accel_zero=out.accel_zero,
        )
        runs.append(
            Run(
                name=f"{k + 1:02d}-{test.name}",
                t=out.t,
                reference=out.reference,
                command=out.command,
                encoder=out.encoder,
                accel=out.accel,
                metadata=metadata,
                n=n,
                device_time=out.t.copy() if clocked else None,
                host_time=out.t * ratio + late if clocked else None,
            )
        )
    moved = {e["effect"].removeprefix("parameter:"): e["value"] for e in effects if ":" in e["effect"]}
    truth = {
        "seed": seed,
        "causes": [dict(e) for e in effects],
        "outside": [e["effect"] for e in effects if e["effect"] in OUTSIDE],
        "constants": {k: v for k, v in with_constants(rig, moved).items() if k != "uncertainty"},
        "logs": own,
        "common": common,
        "severity": grades,
        "conditions": [vars(c) for c in conditions],
    }
    return Case(runs, truth, rig, effects, tests, conditions)

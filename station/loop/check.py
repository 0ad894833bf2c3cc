"""Check: small pulses either way, before a closed loop is trusted with the rig.

What comes back is compared with what the rig's own model does under the same pulses: the sign of their correlation
tells a motor, an encoder or an accelerometer that is the wrong way round, and a sensor that is dead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from station.control.references import pulse
from station.device.client import Client, Identity
from station.device.limits import DeviceLimits
from station.device.line import MOST_ANSWER_TICKS, Line
from station.device.port import Port
from station.device.simulated import PlantSource
from station.errors import UsageError
from station.loop import checked
from station.loop.display import watched
from station.loop.engine import Counts, Session, Setup
from station.loop.run_test import connect, measure_rest
from station.rig import Rig

LEAST_TRAVEL = 4.0
"""Counts that the model must predict for a verdict on a sensor."""
_CLEAR = 0.4
"""Correlation beyond which a direction is certain."""


@dataclass(frozen=True)
class CheckResult:
    """What the pulses showed.  Signs: 1 as the rig file says, -1 the wrong way, 0 not to be told.

    travel, expected_travel: largest move of the encoder, measured and in the model (counts); accel_peak,
    expected_accel_peak: the same for the accelerometer.  words: the findings, one sentence each.
    """

    passed: bool
    motor: int
    encoder: int
    accelerometer: int
    travel: float
    expected_travel: float
    accel_peak: float
    expected_accel_peak: float
    counts: Counts
    words: tuple[str, ...]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0


def _smooth(values: np.ndarray, rows: int) -> np.ndarray:
    return np.convolve(values, np.full(rows, 1.0 / rows), mode="same") if rows > 1 else values


def _expected(rig: Rig, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encoder and accelerometer (counts) of the rig's model under these commands."""
    source = PlantSource(rig, 0.0, 0.0, 0.0, 0)
    rows = []
    for command in commands.tolist():
        rows.append(source.sample())
        source.advance(command, True)
    encoder, accel = np.array(rows, dtype=float).T
    return encoder, accel


def check(port: Port, rig: Rig, amplitude: float = 20.0, progress: Callable[[int, int], None] | None = None,
          ) -> CheckResult:
    """Send +amplitude and -amplitude counts for 0.15 s each and judge what comes back.

    WorkError and UsageError as in ``run_test``; the motor is at zero however it ends.
    """
    if not 1.0 <= amplitude <= rig.command_limit:
        raise UsageError(f"amplitude: from 1 to the rig's limit of {rig.command_limit:g} counts, not {amplitude:g}")
    rate = rig.sample_rate
    client = Client(port)
    identity = connect(client, rig, MOST_ANSWER_TICKS)
    answer_ticks = Line.of(port, identity).least_answer_ticks(rate) or MOST_ANSWER_TICKS
    rest = measure_rest(client, rig, identity, answer_ticks)
    commands = np.floor(pulse(rate, amplitude, 0.15, 1.6, 0.2, second=0.9) + 0.5)
    ahead = [*commands[answer_ticks:].astype(int).tolist(), *[0] * answer_ticks]
    rows: list[tuple[int, int, int, int]] = []
    setup = Setup(identity, rate, amplitude, answer_ticks, DeviceLimits.of_rig(rig))
    session = Session(client, setup, len(commands), lambda row, encoder, accel: ahead[row],
                      lambda row, clock, encoder, accel, command, *others: rows.append((row, encoder, accel, command)))
    with watched(session, None if progress is None else lambda row: progress(row, len(commands))):
        counts = session.run()
    index, encoder, accel, applied = np.array(rows).T
    in_force = np.zeros(len(commands))
    in_force[index] = applied
    expected_encoder, expected_accel = _expected(rig, in_force)
    found = _judge(rig, encoder - rest.encoder, accel - rest.accel_zero, rest.accel_sigma,
                   expected_encoder[index], expected_accel[index], counts)
    return found if checked.is_simulated(port.url, identity) else _noted(found, identity, rig)


def _noted(found: CheckResult, identity: Identity, rig: Rig) -> CheckResult:
    """Remember what closed loops will ask for, or take it back."""
    try:
        (checked.remember if found.passed else checked.forget)(identity, rig)
    except OSError as error:
        words = f"the outcome could not be noted ({error.strerror}: {checked.store()}): closed loops will want --force"
        return replace(found, words=(*found.words, words))
    return found


def _judge(rig: Rig, encoder: np.ndarray, accel: np.ndarray, sigma: float, expected_encoder: np.ndarray,
           expected_accel: np.ndarray, counts: Counts) -> CheckResult:
    travel, expected_travel = (float(np.max(np.abs(values))) for values in (encoder, expected_encoder))
    smoothing = max(round(0.01 * rig.sample_rate), 1)
    accel, expected_accel = _smooth(accel, smoothing), _smooth(expected_accel, smoothing)
    peak, expected_peak = (float(np.max(np.abs(values))) for values in (accel, expected_accel))
    words: list[str] = []
    seen_encoder = _direction(encoder, expected_encoder, travel > 1.0, expected_travel)
    noise = 4.0 * max(sigma, 0.3) / np.sqrt(smoothing)
    seen_accel = (_direction(accel, expected_accel, peak > noise, expected_peak)
                  if rig.accelerometer is not None else None)
    motor = encoder_sign = accel_sign = 0
    if expected_travel < LEAST_TRAVEL:
        words.append(f"by the rig file these pulses move the arm by {expected_travel:.1f} counts only: "
                     "use a larger amplitude")
    elif seen_encoder is None:
        moved = seen_accel is not None and seen_accel != 0
        words.append("the encoder is dead: the accelerometer moved, the encoder did not" if moved else
                     "nothing moved: see that the motor has power, then its enable and the wiring; "
                     "if friction holds the arm, use a larger amplitude")
    elif seen_encoder == 0:
        words.append("the encoder moves, but not as these pulses would make it: was the arm touched?")
    elif seen_encoder > 0:
        motor = encoder_sign = 1
        words.append("motor and encoder agree with the rig file")
    elif seen_accel is not None and seen_accel < 0:
        motor, encoder_sign = -1, 1
        words.append("the motor turns the wrong way: encoder and accelerometer agree on it; swap the motor's leads, "
                     "or give motor.gain the other sign")
    elif seen_accel is not None and seen_accel > 0:
        motor, encoder_sign = 1, -1
        words.append("the encoder counts the wrong way: swap its channels A and B "
                     "(or motor and accelerometer both are: these pulses cannot tell)")
    else:
        motor, encoder_sign = 0, -1
        words.append("motor and encoder disagree: swap the motor's leads or the encoder's channels A and B")
    if rig.accelerometer is not None and expected_peak >= LEAST_TRAVEL and travel > 1.0:
        accel_sign = _accel_words(seen_accel, motor, words)
    if encoder_sign > 0 and motor > 0 and not 0.2 < travel / expected_travel < 5.0:
        words.append(f"it moved by {travel:.0f} counts, the rig file says {expected_travel:.0f}: check motor.gain")
    passed = motor == 1 and encoder_sign == 1 and (accel_sign == 1 or rig.accelerometer is None
                                                  or expected_peak < LEAST_TRAVEL)
    return CheckResult(passed, motor, encoder_sign, accel_sign, travel, expected_travel, peak, expected_peak, counts,
                       tuple(words))


def _direction(values: np.ndarray, expected: np.ndarray, moved: bool, expected_peak: float) -> int | None:
    """1 or -1 with or against the model, 0 unclear, None: dead where the model moves."""
    if not moved:
        return None if expected_peak >= LEAST_TRAVEL else 0
    correlation = _correlation(values, expected)
    return 0 if abs(correlation) < _CLEAR else (1 if correlation > 0.0 else -1)


def _accel_words(seen: int | None, motor: int, words: list[str]) -> int:
    """Judge the accelerometer once the motor's direction is known; returns its sign."""
    if seen is None:
        words.append("the accelerometer is dead: the arm moved, its reading did not")
        return 0
    if seen == 0:
        words.append("the accelerometer's reading does not follow the model: its direction cannot be told")
        return 0
    if motor == 0:
        return 0
    if seen == motor:
        words.append("the accelerometer agrees with the rig file")
        return 1
    words.append("the accelerometer reads the wrong way: turn it round, or give accelerometer.gain the other sign")
    return -1

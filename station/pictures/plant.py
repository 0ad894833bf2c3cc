"""The rig's linear model, driven by torques at any place: what reaches its modes, and how its places move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from station.errors import UsageError
from station.model.assembly import Assembly, torque_input
from station.model.modal import ModalForm, dense
from station.rig import Rig


class Plant(NamedTuple):
    """The rig's linear model: torques held over a period drive its modes, from which the channels are read."""

    rig: Rig
    parts: Assembly
    form: ModalForm
    period: float
    channels: int
    """1: the encoder; 2: the accelerometer as well."""

    @property
    def modes(self) -> int:
        """Number of modal coordinates."""
        return 2 * self.form.blocks

    def response(self, port: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the modes (modes) to 1 N m held over a period, output rows (channels, modes), and outputs at once."""
        rig, parts, form, period, channels = self
        force = form.inverse @ torque_input(parts, port)
        rows, feed = [form.basis[parts.base] / rig.angle_per_count], [0.0]
        if channels == 2 and rig.accelerometer is not None and parts.tip is not None:
            tip = rig.accelerometer.gain * form.basis[parts.size + parts.tip]
            rows.append(tip @ dense(form.rates()))
            feed.append(float(tip @ force))
        return dense(form.integral(period)) @ force, np.array(rows), np.array(feed)


class Motion(NamedTuple):
    """Angles and speeds of all coordinates at the ticks, (n, coordinates)."""

    angle: np.ndarray
    speed: np.ndarray

    def along(self, port: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle and speed of a port (see ``port_vector``), each (n), between a tick and the next."""
        return between(self.angle @ port), between(self.speed @ port)


def port_vector(rig: Rig, parts: Assembly, at: str) -> np.ndarray:
    """Generalised torque of 1 N m (tip: force of 1 N) at a place, and the motion that it works on, by virtual work."""
    if at in ("motor", "base") or at in ("drive", "clamp") and getattr(rig, at) is not None:
        return parts.rotation(at)
    if at == "tip" and parts.tip is not None:
        return parts.unit(parts.tip)
    raise UsageError(f"missing torque at {at!r}: rig {rig.name} has no such place")


def following(values: np.ndarray) -> np.ndarray:
    """Row i: what is held from tick i on, which the state notes at tick i + 1."""
    return np.append(values[1:], values[-1:], axis=0)


def between(values: np.ndarray) -> np.ndarray:
    """Row i: halfway between tick i and the next."""
    return 0.5 * (values + following(values))

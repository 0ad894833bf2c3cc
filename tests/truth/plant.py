"""The continuous linear part of a rig, from textbook beam theory, as one state-space system with ports.

Beam: Hermite cubic elements with consistent mass (Euler-Bernoulli; Craig and Kurdila, Fundamentals of
Structural Dynamics, ch. 14), reduced to the root's rotation and the lowest modes with the root held
(Craig-Bampton, ibid. ch. 17). All coordinates are inertial; rotations in radians.

Inputs of the system, held constant over one step:
0 torque on the motor, 1 torque on the base, 2 torque on the beam root, 3 force on the tip, 4 force on a loose
mass, 5 an acceleration added to the tip's (m/s^2), 6 the command after the static part of the amplifier
(counts). Port outputs: angle and speed of motor, base, root, then position and speed of tip and loose mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, expm

Array = NDArray[np.float64]
ELEMENTS = 16
MODES = 8
INPUTS = 7
PORTS = 5  # motor, base, root, tip, loose mass


def beam_matrices(
    mass_per_length: float, length: float, rigidity: float, elements: int, tip_mass: float, tip_inertia: float
) -> tuple[Array, Array]:
    """Mass and stiffness over [w0, r0, w1, r1, ...], w in m, r = dw/dx in rad, tip body at the last node."""
    h = length / elements
    me = (mass_per_length * h / 420.0) * np.array(
        [
            [156.0, 22 * h, 54.0, -13 * h],
            [22 * h, 4 * h * h, 13 * h, -3 * h * h],
            [54.0, 13 * h, 156.0, -22 * h],
            [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
        ]
    )
    ke = (rigidity / h**3) * np.array(
        [
            [12.0, 6 * h, -12.0, 6 * h],
            [6 * h, 4 * h * h, -6 * h, 2 * h * h],
            [-12.0, -6 * h, 12.0, -6 * h],
            [6 * h, 2 * h * h, -6 * h, 4 * h * h],
        ]
    )
    size = 2 * (elements + 1)
    mass, stiffness = np.zeros((size, size)), np.zeros((size, size))
    for e in range(elements):
        at = slice(2 * e, 2 * e + 4)
        mass[at, at] += me
        stiffness[at, at] += ke
    mass[-2, -2] += tip_mass
    mass[-1, -1] += tip_inertia
    return mass, stiffness


def reduced_beam(
    beam: dict[str, Any],
    tip: dict[str, Any],
    elements: int = ELEMENTS,
    modes: int = MODES,
    detuning: Sequence[float] = (),
) -> tuple[Array, Array, Array, Array]:
    """Mass, stiffness, and rows of the tip's displacement and of the moment that bends the root, over [root
    rotation, mode 1, ..., mode `modes`].

    With the root's translation fixed, a static root rotation carries the whole beam rigidly: w = x r. `detuning` are
    factors on the modes' frequencies, for a beam that is not quite uniform.
    """
    mass, stiffness = beam_matrices(
        beam["mass_per_length"],
        beam["length"],
        beam["flexural_rigidity"],
        elements,
        tip.get("mass", 0.0),
        tip.get("inertia", 0.0),
    )
    x = np.linspace(0.0, beam["length"], elements + 1)
    rigid = np.ones(2 * elements + 2)
    rigid[0::2] = x
    inner = slice(2, None)
    squares, shapes = eigh(stiffness[inner, inner], mass[inner, inner])
    modes = min(modes, len(squares))
    for i, factor in enumerate(detuning[:modes]):
        squares[i] *= factor**2
    basis = np.zeros((2 * elements + 2, 1 + modes))
    basis[:, 0] = rigid
    basis[inner, 1:] = shapes[:, :modes]
    return basis.T @ mass @ basis, np.diag(np.r_[0.0, squares[:modes]]), basis[-2], stiffness[1] @ basis


@dataclass(frozen=True)
class Mechanics:
    """M q'' + C q' + K q = sum over ports of port[j] * force_j; `gain_port` is what the motor's torque acts
    on."""

    mass: Array
    damping: Array
    stiffness: Array
    port: Array  # (PORTS, nq): rows that read a port's position, and along which its force acts
    encoder: Array  # row that the encoder reads
    lift: Array  # (3, nq) q for a unit common rotation, a unit motor twist (motor alone), a unit tip by the first mode
    load: Array  # (2, nq) rows on q and q': torque that the beam takes from the base, and the back-EMF
    has_tip: bool


def mechanics(
    rig: dict[str, Any],
    outside: dict[str, dict[str, float]] | None = None,
    without_drive: bool = False,
    elements: int = ELEMENTS,
    modes: int = MODES,
    detuning: Sequence[float] = (),
) -> Mechanics:
    """Assemble the rig's bodies, springs and dampers.

    `outside` adds bodies that no rig file knows: "second_appendage" (inertia, stiffness, damping) on the
    base, "mount_compliance" (inertia, stiffness, damping) between the frame and the ground, "tip_rattle"
    (mass). `without_drive` leaves the drive's spring and damper to the nonlinear laws (backlash); its two
    sides stay apart.
    """
    outside = outside or {}
    names = ["motor", "base", "root"]
    beam = rig.get("beam")
    n_modes = 0
    if beam:
        mb, kb, w_tip, bends = reduced_beam(beam, rig.get("tip") or {}, elements, modes, detuning)
        n_modes = len(mb) - 1
    names += [f"mode{i}" for i in range(n_modes)]
    names += [n for n in ("second_appendage", "mount_compliance", "tip_rattle") if n in outside]
    index = {n: i for i, n in enumerate(names)}
    size = len(names)

    def e(name: str) -> Array:
        row = np.zeros(size)
        row[index[name]] = 1.0
        return row

    frame = e("mount_compliance") if "mount_compliance" in outside else np.zeros(size)
    motor, base, root = e("motor") - frame, e("base") - frame, e("root")
    mass, damping, stiffness = np.zeros((3, size, size))

    def joint(row: Array, k: float, c: float) -> None:
        stiffness[...] += k * np.outer(row, row)
        damping[...] += c * np.outer(row, row)

    mass += rig["motor"]["inertia"] * np.outer(e("motor"), e("motor"))
    damping += rig["motor"]["damping"] * np.outer(motor, motor)
    if rig.get("base"):
        mass += rig["base"]["inertia"] * np.outer(e("base"), e("base"))
    drive, clamp = rig.get("drive"), rig.get("clamp")
    if drive and not without_drive:
        joint(e("motor") - e("base"), drive["stiffness"], drive["damping"])
    if clamp and beam:
        joint(e("base") - root, clamp["stiffness"], clamp["damping"])
    tip_row = np.zeros(size)
    if beam:
        at = np.r_[index["root"], [index[f"mode{i}"] for i in range(n_modes)]].astype(int)
        grid = np.ix_(at, at)
        mass[grid] += mb
        stiffness[grid] += kb
        damping[grid] += beam["damping"] * kb
        tip_row[at] = w_tip
    for name in ("second_appendage", "mount_compliance"):
        if name in outside:
            body = outside[name]
            mass += body["inertia"] * np.outer(e(name), e(name))
            joint(
                e(name) - (e("base") if name == "second_appendage" else 0.0),
                body["stiffness"],
                body["damping"],
            )
    load = np.zeros((2, size))
    if beam and clamp:
        load[0], load[1] = clamp["stiffness"] * (base - root), clamp["damping"] * (base - root)
    elif beam:
        load[:, at] = np.outer([1.0, beam["damping"]], bends)
    load[1] -= rig["motor"]["damping"] * rig["motor"].get("back_emf", 1.0) * motor
    loose = np.zeros(size)
    if "tip_rattle" in outside:
        loose = e("tip_rattle")
        mass += outside["tip_rattle"]["mass"] * np.outer(loose, loose)

    # Ties: a part that is left out makes its two sides one.
    tied = {}
    if not drive:
        tied["motor"] = "base"
    if not beam or not clamp:
        tied["root"] = "base"
    free = [n for n in names if n not in tied]
    tie = np.zeros((size, len(free)))
    for n in names:
        tie[index[n], free.index(tied.get(n, n))] = 1.0

    lift = np.zeros((3, size))
    lift[0, : len(names)] = [1.0 if n in ("motor", "base", "root", "second_appendage") else 0.0 for n in names]
    if "tip_rattle" in outside:
        lift[0, index["tip_rattle"]] = beam["length"]
    lift[1, index["motor"]] = 1.0
    if n_modes:
        lift[2, index["mode0"]] = 1.0 / w_tip[1]
    # The common rotation, read on the free coordinates.
    pick = [index[n] for n in free]
    reduced_mass = tie.T @ mass @ tie
    if np.linalg.cond(reduced_mass) > 1e16 or np.any(np.diag(reduced_mass) <= 0.0):
        raise ValueError(f"rig {rig.get('name')}: a part has no inertia")
    return Mechanics(
        mass=reduced_mass,
        damping=tie.T @ damping @ tie,
        stiffness=tie.T @ stiffness @ tie,
        port=np.array([motor, base, root, tip_row, loose]) @ tie,
        encoder=base @ tie,
        lift=lift[:, pick],
        load=load @ tie,
        has_tip=bool(beam),
    )


@dataclass(frozen=True)
class LinearSystem:
    """z' = a z + b u; ports y = c_port z; the accelerometer's chain before delay and gain: c_acc z + d_acc
    u."""

    a: Array
    b: Array
    c_port: Array  # (2 * PORTS, nz): position and speed of each port
    c_encoder: Array
    c_acc: Array
    d_acc: Array
    nq: int
    lag_state: int  # index of the actuator's lag, or -1


def linear_system(
    mech: Mechanics,
    gain: float,
    actuator_lag: float = 0.0,
    highpass: float = 0.0,
    accelerometer_lag: float = 0.0,
) -> LinearSystem:
    """State space with the actuator's lag and the accelerometer's filters as states; a zero leaves a filter
    out."""
    nq = len(mech.mass)
    filters = [name for name, tau in (("act", actuator_lag), ("hp", highpass), ("lp", accelerometer_lag)) if tau > 0]
    place = {name: 2 * nq + i for i, name in enumerate(filters)}
    nz = 2 * nq + len(filters)
    inv = np.linalg.inv(mech.mass)
    a, b = np.zeros((nz, nz)), np.zeros((nz, INPUTS))
    a[:nq, nq : 2 * nq] = np.eye(nq)
    a[nq : 2 * nq, :nq] = -inv @ mech.stiffness
    a[nq : 2 * nq, nq : 2 * nq] = -inv @ mech.damping
    b[nq : 2 * nq, :PORTS] = inv @ mech.port.T
    torque = gain * (inv @ mech.port[0])
    if "act" in place:
        i = place["act"]
        a[nq : 2 * nq, i] = torque
        a[i, i] = -1.0 / actuator_lag
        b[i, 6] = 1.0 / actuator_lag
    else:
        b[nq : 2 * nq, 6] = torque

    c_port = np.zeros((2 * PORTS, nz))
    c_port[0::2, :nq] = mech.port
    c_port[1::2, nq : 2 * nq] = mech.port
    c_encoder = np.zeros(nz)
    c_encoder[:nq] = mech.encoder

    c_acc, d_acc = mech.port[3] @ a[nq : 2 * nq], mech.port[3] @ b[nq : 2 * nq]
    d_acc[5] += 1.0
    if "hp" in place:  # y = x - s, s' = (x - s) / tau
        i = place["hp"]
        a[i] = c_acc / highpass
        a[i, i] -= 1.0 / highpass
        b[i] = d_acc / highpass
        c_acc = c_acc.copy()
        c_acc[i] -= 1.0
    if "lp" in place:  # s' = (x - s) / tau, y = s
        i = place["lp"]
        a[i] = c_acc / accelerometer_lag
        a[i, i] -= 1.0 / accelerometer_lag
        b[i] = d_acc / accelerometer_lag
        c_acc, d_acc = np.zeros(nz), np.zeros(INPUTS)
        c_acc[i] = 1.0
    return LinearSystem(a, b, c_port, c_encoder, c_acc, d_acc, nq, place.get("act", -1))


def transition(system: LinearSystem, h: float) -> tuple[Array, Array]:
    """Exact step over h seconds with inputs held (Van Loan 1978)."""
    nz = len(system.a)
    block = np.zeros((nz + INPUTS, nz + INPUTS))
    block[:nz, :nz] = system.a
    block[:nz, nz:] = system.b
    e = expm(block * h)
    return np.ascontiguousarray(e[:nz, :nz]), np.ascontiguousarray(e[:nz, nz:])

"""The compiled run: ticks, exact linear steps between them, implicit port laws inside each step.

Every tick interval is cut at the instants where something happens (the command switches, a late sensor is
read), and each piece into equal steps of at most the asked size. Within a step the linear part moves exactly
and the port forces are constant: the mean of their laws over the step, found implicitly from the motion that
they cause. Dry friction is a complementarity: the torque that stops the part at the end of the step if the
level allows it, else the level against the motion. Nothing is smoothed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_COMPILE = {"cache": True, "fastmath": {"reassoc", "contract", "nsz"}}

# fmt: off
PARAMETERS = (
    # timing and controller
    "period", "limit", "rounding", "command_row", "command_shift", "encoder_shift", "accel_shift",
    # amplifier
    "dead_zone", "clip", "curve", "ratio", "bias", "fade", "fade_time",
    # encoder
    "counts", "zero", "ecc_amplitude", "ecc_phase",
    # accelerometer
    "acc_gain", "acc_offset", "acc_limit", "centripetal", "stuck_bit", "stuck_value",
    # motor
    "coulomb", "static", "stribeck", "stribeck_speed", "load", "drag", "drag_speed", "ripple",
    "axis_gain", "ripple_cycles", "ripple_phase", "drift", "drift_time", "bristle", "bristle_stiffness", "bristle_wave",
    "bristle_cycles", "bristle_phase",
    # base
    "base_coulomb", "base_wave", "base_wave_cycles", "base_wave_phase", "quadratic", "tilt", "tilt_angle",
    "cable", "cable_rest", "snag", "snag_low", "snag_high", "stop_angle", "stop_stiffness", "stop_damping",
    # joints
    "drive_nl", "drive_k", "drive_c", "gap", "drive_k3", "clamp_k3", "rattle_gap", "rattle_k", "rattle_c",
)
# fmt: on
"""Names of the numbers that choose the laws; a law's neutral number is 0 unless `simulate` says otherwise."""
INDEX = {name: i for i, name in enumerate(PARAMETERS)}

PERIOD, LIMIT, ROUNDING, COMMAND_ROW = (INDEX[n] for n in ("period", "limit", "rounding", "command_row"))
C_SHIFT, E_SHIFT, A_SHIFT = (INDEX[n] for n in ("command_shift", "encoder_shift", "accel_shift"))
DEAD, CLIP, CURVE, RATIO, BIAS = (INDEX[n] for n in ("dead_zone", "clip", "curve", "ratio", "bias"))
FADE, FADE_TIME = INDEX["fade"], INDEX["fade_time"]
COUNTS, ZERO, ECC_A, ECC_P = (INDEX[n] for n in ("counts", "zero", "ecc_amplitude", "ecc_phase"))
ACC_GAIN, ACC_OFFSET, ACC_LIMIT, CENTRI = (INDEX[n] for n in ("acc_gain", "acc_offset", "acc_limit", "centripetal"))
STUCK_BIT, STUCK_VALUE = INDEX["stuck_bit"], INDEX["stuck_value"]
COULOMB, STATIC, STRIBECK, STRIBECK_W = (INDEX[n] for n in ("coulomb", "static", "stribeck", "stribeck_speed"))
LOAD, DRAG, DRAG_W = (INDEX[n] for n in ("load", "drag", "drag_speed"))
AXIS_GAIN = INDEX["axis_gain"]
RIPPLE, RIPPLE_N, RIPPLE_P = (INDEX[n] for n in ("ripple", "ripple_cycles", "ripple_phase"))
DRIFT, DRIFT_TIME = INDEX["drift"], INDEX["drift_time"]
BRISTLE, BRISTLE_K = INDEX["bristle"], INDEX["bristle_stiffness"]
BRISTLE_A, BRISTLE_N, BRISTLE_P = (INDEX[n] for n in ("bristle_wave", "bristle_cycles", "bristle_phase"))
B_COULOMB = INDEX["base_coulomb"]
B_WAVE, B_WAVE_N, B_WAVE_P = (INDEX[n] for n in ("base_wave", "base_wave_cycles", "base_wave_phase"))
QUAD, TILT, TILT_P, CABLE, CABLE_REST = (INDEX[n] for n in ("quadratic", "tilt", "tilt_angle", "cable", "cable_rest"))
SNAG, SNAG_LOW, SNAG_HIGH = (INDEX[n] for n in ("snag", "snag_low", "snag_high"))
STOP, STOP_K, STOP_C = (INDEX[n] for n in ("stop_angle", "stop_stiffness", "stop_damping"))
DRIVE_NL, DRIVE_K, DRIVE_C, GAP, DRIVE_K3 = (INDEX[n] for n in ("drive_nl", "drive_k", "drive_c", "gap", "drive_k3"))
CLAMP_K3 = INDEX["clamp_k3"]
RATTLE_GAP, RATTLE_K, RATTLE_C = (INDEX[n] for n in ("rattle_gap", "rattle_k", "rattle_c"))

# Port rows, and the rows of the trace that a run returns.
TH_M, W_M, TH_B, W_B, TH_R, W_R, X_T, V_T, X_L, V_L = range(10)
TRACE = 16  # ten port rows, motor friction, base friction, drive torque by laws, command after the static chain,
# then the two readings without rounding, noise and stuck bits


@njit(**_COMPILE)
def excess(d0: float, d1: float, half: float) -> tuple[float, float, float]:
    """Means over a straight path from d0 to d1: share of it beyond +-half, the excess, the excess cubed."""
    e0 = d0 - min(max(d0, -half), half)
    e1 = d1 - min(max(d1, -half), half)
    if e0 * e1 > 0.0:
        s = e0 + e1
        return 1.0, 0.5 * s, 0.25 * s * (e0 * e0 + e1 * e1)
    if e0 == 0.0 and e1 == 0.0:
        inside = 1.0 if half == 0.0 else 0.0
        return inside, 0.0, 0.0
    span = abs(d1 - d0)
    if span == 0.0:
        return 1.0, e0, e0 * e0 * e0
    return (
        (abs(e0) + abs(e1)) / span,
        0.5 * (e0 * abs(e0) + e1 * abs(e1)) / span,
        0.25 * (e0 * abs(e0) ** 3 + e1 * abs(e1) ** 3) / span,
    )


@njit(**_COMPILE)
def smooth_laws(ya, yb, h, par, snag_on, p):
    """Fill p[0:6] with the mean of every law but dry friction over a step from ya to yb; return the drive's
    torque.

    The drive's torque is the whole one (motor on base); what the linear part already carries is left out of
    p.
    """
    wm = 0.5 * (ya[W_M] + yb[W_M])
    wb = 0.5 * (ya[W_B] + yb[W_B])
    thb = 0.5 * (ya[TH_B] + yb[TH_B]) + h * (ya[W_B] - yb[W_B]) / 12.0
    motor = 0.0
    base = 0.0
    if par[DRAG] != 0.0:
        motor -= par[DRAG] * wm / (1.0 + abs(wm) / par[DRAG_W])
    if par[RIPPLE] != 0.0:
        thm = 0.5 * (ya[TH_M] + yb[TH_M]) + h * (ya[W_M] - yb[W_M]) / 12.0
        motor += par[RIPPLE] * np.sin(par[RIPPLE_N] * thm + par[RIPPLE_P])
    if par[QUAD] != 0.0:
        base -= par[QUAD] * wb * abs(wb)
    if par[TILT] != 0.0:
        base -= par[TILT] * np.sin(thb - par[TILT_P])
    if par[CABLE] != 0.0:
        base -= par[CABLE] * (thb - par[CABLE_REST])
    if par[SNAG] != 0.0 and snag_on:
        # Pulls back while the base is inside the window: the share of the step's path that is inside.
        lo, hi = min(ya[TH_B], yb[TH_B]), max(ya[TH_B], yb[TH_B])
        if hi > lo:
            share = max(0.0, min(hi, par[SNAG_HIGH]) - max(lo, par[SNAG_LOW])) / (hi - lo)
        else:
            share = 1.0 if par[SNAG_LOW] < lo < par[SNAG_HIGH] else 0.0
        base -= par[SNAG] * share
    if par[STOP_K] != 0.0:
        share, deep, _ = excess(ya[TH_B], yb[TH_B], par[STOP])
        push = par[STOP_K] * deep + par[STOP_C] * wb * share
        if push * deep > 0.0:
            base -= push

    drive = 0.0
    if par[DRIVE_NL] != 0.0 or par[LOAD] != 0.0:
        rate = wm - wb
        share, deep, cubed = excess(ya[TH_M] - ya[TH_B], yb[TH_M] - yb[TH_B], 0.5 * par[GAP])
        drive = par[DRIVE_K] * deep + par[DRIVE_C] * rate * share + par[DRIVE_K3] * cubed
        carried = drive if par[DRIVE_NL] == 2.0 else par[DRIVE_K3] * cubed
        motor -= carried
        base += carried

    root = 0.0
    if par[CLAMP_K3] != 0.0:
        _, _, cubed = excess(ya[TH_B] - ya[TH_R], yb[TH_B] - yb[TH_R], 0.0)
        root = par[CLAMP_K3] * cubed
        base -= root

    loose = 0.0
    if par[RATTLE_K] != 0.0:
        share, deep, _ = excess(ya[X_T] - ya[X_L], yb[X_T] - yb[X_L], 0.5 * par[RATTLE_GAP])
        rate = 0.5 * (ya[V_T] + yb[V_T] - ya[V_L] - yb[V_L])
        push = par[RATTLE_K] * deep + par[RATTLE_C] * rate * share
        if push * deep > 0.0:
            loose = push

    p[0] = motor
    p[1] = base
    p[2] = root
    p[3] = -loose
    p[4] = loose
    w0, w1 = ya[W_B], yb[W_B]
    p[5] = par[CENTRI] * (w0 * w0 + w0 * w1 + w1 * w1) / 3.0
    return drive


@njit(**_COMPILE)
def motor_level(w: float, time: float, drive: float, par) -> float:
    """Dry friction level on the motor at speed w, N m; at w = 0 the most that it holds."""
    level = par[COULOMB] + par[LOAD] * abs(drive)
    if par[DRIFT_TIME] > 0.0:
        level += par[COULOMB] * par[DRIFT] * (1.0 - np.exp(-time / par[DRIFT_TIME]))
    if par[STATIC] > 0.0:
        r = w / par[STRIBECK_W]
        level += par[STATIC] + (par[STRIBECK] - par[STATIC]) * (1.0 - np.exp(-r * r))
    return level


@njit(**_COMPILE)
def base_level(angle: float, par) -> float:
    """Dry friction level on the base at an angle, N m."""
    level = par[B_COULOMB]
    if par[B_WAVE] != 0.0:
        level *= 1.0 + par[B_WAVE] * np.sin(par[B_WAVE_N] * angle + par[B_WAVE_P])
    return level


@njit(**_COMPILE)
def static_chain(c: float, par) -> float:
    """Delayed command to the command that the motor's gain or the lag sees, counts."""
    width = par[DEAD]
    if c > width:
        c -= width
    elif c < -width:
        c += width
    else:
        c = 0.0
    c = min(max(c, -par[CLIP]), par[CLIP])
    if par[CURVE] != 0.0 and c != 0.0:
        c *= abs(c / par[LIMIT]) ** par[CURVE]
    if c < 0.0:
        c *= par[RATIO]
    return c + par[BIAS]


@njit(**_COMPILE)
def scale_encoder(angle: float, extra: float, par) -> float:
    """Counts before rounding: scale, eccentricity, zero, counts lost."""
    return angle * par[COUNTS] / (2.0 * np.pi) + par[ECC_A] * np.sin(angle + par[ECC_P]) - par[ZERO] + extra


@njit(**_COMPILE)
def scale_accel(value: float, noise: float, par) -> float:
    """m/s^2 after the filters and the delay to counts before rounding, clipped."""
    x = par[ACC_GAIN] * value + par[ACC_OFFSET] + noise
    return min(max(x, -par[ACC_LIMIT]), par[ACC_LIMIT])


@njit(**_COMPILE)
def read_accel(x: float, par) -> float:
    """Counts: half up, then what the converter's stuck bit makes of it."""
    if par[ROUNDING] == 0.0:
        return x
    x = np.floor(x + 0.5)
    if par[STUCK_BIT] >= 0.0:
        weight = 2.0 ** par[STUCK_BIT]
        word = x + 32768.0  # offset binary, as a converter sends it
        bit = np.floor(word / weight) % 2.0
        x += (par[STUCK_VALUE] - bit) * weight
    return x


@njit(**_COMPILE)
def run_kernel(
    reference, noise, slip, snag, torque, drift, force, disturbed,
    num, den, acc_num, acc_den, kind, accel_zero,
    seg_h, seg_n, seg_encoder, seg_accel, seg_switch, seg_matrix,
    a_all, b_all, g_all, c_port, c_encoder, c_acc, d_acc, c_load,
    par, z, u, nonlinear,
):  # fmt: skip
    """One run.

    reference, noise, slip, snag: (n,) counts, counts, counts, 0 or 1. torque, drift, force: (n,) N m on the motor,
    relative change of its gain, N on the tip, all held over a tick; `disturbed` whether there are any. num, den on
    the error, acc_num, acc_den on the accelerometer; kind 0 open, 1 on the error, 2 with the accelerometer, 3 less
    acc_num on the encoder's readings. seg_*: (s,) step (s), steps, what happens at the start of the piece, which
    matrix. a_all (m, nz, nz), b_all (m, nz, 7), g_all (m, 10, 7) = c_port b. c_load (nz,) motor torque less the
    beam's torque on the base where there is no drive, axis_gain times u apart. z (nz,) start state, u the command
    after the static chain before sample 0. Returns encoder, accel, command (n,) and the trace at the ticks (n,
    TRACE).
    """
    n = len(reference)
    nz = len(z)
    encoder, accel, command, recursion = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    angle_at, value_at = np.zeros(n), np.zeros(n)
    error, corrected = np.zeros(n), np.zeros(n)
    trace = np.zeros((n, TRACE))
    zf = np.empty(nz)
    p, q = np.zeros(7), np.zeros(7)
    ya, yb, yf = np.empty(10), np.empty(10), np.empty(10)
    row = int(par[COMMAND_ROW])
    c_shift, e_shift, a_shift = int(par[C_SHIFT]), int(par[E_SHIFT]), int(par[A_SHIFT])
    start_angle, start_value = 0.0, 0.0
    for k in range(nz):
        start_angle += c_encoder[k] * z[k]
    for r in range(10):
        s = 0.0
        for k in range(nz):
            s += c_port[r, k] * z[k]
        ya[r] = s
    lam_m, lam_b, drive, value = 0.0, 0.0, 0.0, start_value
    bristle, heat = 0.0, 0.0
    dry_m = par[COULOMB] > 0.0 or par[STATIC] > 0.0 or par[LOAD] > 0.0
    dry_b = par[B_COULOMB] > 0.0
    axis = par[LOAD] != 0.0 and par[DRIVE_K] == 0.0
    time = 0.0

    for i in range(n):
        for seg in range(len(seg_h)):
            if seg_encoder[seg] or seg_accel[seg]:
                # The left limit: the motion so far, the forces as they stand, the command before any switch.
                if seg_encoder[seg]:
                    s = 0.0
                    for k in range(nz):
                        s += c_encoder[k] * z[k]
                    angle_at[i] = s
                if seg_accel[seg]:
                    value_at[i] = value
            if seg == 0:
                j = i - e_shift
                x = scale_encoder(angle_at[j] if j >= 0 else start_angle, slip[i], par)
                encoder[i] = np.floor(x + 0.5) if par[ROUNDING] != 0.0 else x
                trace[i, 14] = x
                j = i - a_shift
                x = value_at[j] if j >= 0 else start_value
                accel[i] = read_accel(scale_accel(x, noise[i], par), par)
                trace[i, 15] = scale_accel(x, 0.0, par)
                # The command of row i, from what row i + command_row read.
                k0 = i + row
                if kind == 0:
                    v = reference[i]
                    v = min(max(v, -par[LIMIT]), par[LIMIT])
                elif k0 < 0:
                    v = 0.0
                else:
                    target = reference[i]
                    if kind == 2:
                        s = 0.0
                        for m in range(len(acc_num)):
                            if k0 - m >= 0:
                                s += acc_num[m] * (accel[k0 - m] - accel_zero)
                        for m in range(1, len(acc_den)):
                            if i - m >= 0:
                                s -= acc_den[m] * corrected[i - m]
                        corrected[i] = s
                        target -= s
                    error[i] = target - encoder[k0]
                    v = 0.0
                    for m in range(len(num)):
                        if i - m >= 0:
                            v += num[m] * error[i - m]
                    for m in range(1, len(den)):
                        if i - m >= 0:
                            v -= den[m] * recursion[i - m]
                    if kind == 3:
                        for m in range(len(acc_num)):
                            v -= acc_num[m] * encoder[max(k0 - m, 0)]
                    v = min(max(v, -par[LIMIT]), par[LIMIT])
                recursion[i] = v
                command[i] = np.floor(v + 0.5) if par[ROUNDING] != 0.0 else v
                for r in range(10):
                    trace[i, r] = ya[r]
                trace[i, 10], trace[i, 11], trace[i, 12], trace[i, 13] = lam_m, lam_b, drive, u
            if seg_switch[seg]:
                j = i - c_shift
                u = static_chain(command[j] if j >= 0 else 0.0, par)
                if par[FADE_TIME] > 0.0:
                    heat += ((u / par[LIMIT]) ** 2 - heat) * (1.0 - np.exp(-par[PERIOD] / par[FADE_TIME]))
                    u /= 1.0 + par[FADE] * heat

            a = a_all[seg_matrix[seg]]
            b = b_all[seg_matrix[seg]]
            g = g_all[seg_matrix[seg]]
            h = seg_h[seg]
            for _ in range(seg_n[seg]):
                for r in range(nz):
                    s = b[r, 6] * u
                    for k in range(nz):
                        s += a[r, k] * z[k]
                    zf[r] = s
                if disturbed:
                    for r in range(nz):
                        zf[r] += b[r, 0] * torque[i] + b[r, 3] * force[i] + b[r, 6] * drift[i] * u
                for r in range(10):
                    s = 0.0
                    for k in range(nz):
                        s += c_port[r, k] * zf[k]
                    yf[r] = s
                    yb[r] = s
                if nonlinear:
                    # Implicit forces: each pass uses the end of the step that the last pass gave.
                    for r in range(10):
                        s = yf[r]
                        for k in range(6):
                            s += g[r, k] * p[k]
                        yb[r] = s
                    for _turn in range(60):
                        drive = smooth_laws(ya, yb, h, par, snag[i] != 0.0, q)
                        if axis:
                            # What the gears carry where there is no drive: motor torque less external torque.
                            drive = par[AXIS_GAIN] * u + q[0] - q[1]
                            for k in range(nz):
                                moved = zf[k]
                                for m in range(6):
                                    moved += b[k, m] * p[m]
                                drive += 0.5 * c_load[k] * (z[k] + moved)
                        if par[BRISTLE] > 0.0:
                            w = 0.5 * (ya[W_M] + yb[W_M])
                            top = par[BRISTLE] * (
                                1.0 + par[BRISTLE_A] * np.sin(par[BRISTLE_N] * ya[TH_M] + par[BRISTLE_P])
                            )
                            bend = (bristle + 0.5 * h * w) / (1.0 + 0.5 * h * abs(w) * par[BRISTLE_K] / top)
                            q[0] -= par[BRISTLE_K] * bend
                        if dry_m:
                            free = yf[W_M] + g[W_M, 1] * (q[1] + lam_b)
                            free += g[W_M, 0] * q[0] + g[W_M, 2] * q[2] + g[W_M, 3] * q[3] + g[W_M, 4] * q[4]
                            hold = -free / g[W_M, 0]
                            if abs(hold) <= motor_level(0.0, time, drive, par):
                                lam_m = hold
                            else:
                                level = motor_level(0.5 * (ya[W_M] + yb[W_M]), time, drive, par)
                                lam_m = -level if free > 0.0 else level
                        if dry_b:
                            free = yf[W_B] + g[W_B, 0] * (q[0] + lam_m)
                            free += g[W_B, 1] * q[1] + g[W_B, 2] * q[2] + g[W_B, 3] * q[3] + g[W_B, 4] * q[4]
                            hold = -free / g[W_B, 1]
                            level = base_level(ya[TH_B], par)
                            lam_b = min(max(hold, -level), level)
                        q[0] += lam_m
                        q[1] += lam_b
                        change = 0.0
                        for r in range(10):
                            s = yf[r]
                            for k in range(6):
                                s += g[r, k] * q[k]
                            change = max(change, abs(s - yb[r]))
                            yb[r] = s
                        for k in range(6):
                            p[k] = q[k]
                        if change < 1e-13:
                            break
                    if par[BRISTLE] > 0.0:
                        bristle = 2.0 * bend - bristle
                    for r in range(nz):
                        s = zf[r]
                        for k in range(6):
                            s += b[r, k] * p[k]
                        zf[r] = s
                for r in range(nz):
                    z[r] = zf[r]
                for r in range(10):
                    ya[r] = yb[r]
                time += h
            # What the accelerometer's filters give at the end of this piece.
            value = d_acc[6] * u
            if disturbed:
                value += d_acc[0] * torque[i] + d_acc[3] * force[i] + d_acc[6] * drift[i] * u
            if nonlinear:
                drive = smooth_laws(ya, ya, 0.0, par, snag[i] != 0.0, q)
                q[0] += lam_m
                q[1] += lam_b
                if par[BRISTLE] > 0.0:
                    q[0] -= par[BRISTLE_K] * bristle
                for k in range(6):
                    value += d_acc[k] * q[k]
            for k in range(nz):
                value += c_acc[k] * z[k]
    return encoder, accel, command, trace

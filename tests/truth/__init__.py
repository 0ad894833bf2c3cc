"""The independent truth: rigs with hidden effects, simulated by other means than the station's own model.

Nothing here imports `station.model`, `station.control` or `station.diagnose`; of the project only the `Run`
record is used. Beam: 16 Hermite elements, reduced to 8 modes with the root held. Motion: the linear part
moves exactly (matrix exponential), the nonlinear torques are implicit means over steps of 0.1 ms, dry
friction is a complementarity.

    case = make_case(7, ["coulomb_friction"])  # or ("coulomb_friction", "base"), or a whole effect as a dict
    case.runs  # blind: what a diagnosis may see
    case.truth  # sealed: causes, constants, severity, conditions

How the contract is read where it leaves room:

- Tick. At tick i the sensors are read first (left limit: the command of row i has not acted yet), then row
  i's command acts. With command_row = -k, rows i < k have seen no sample: command 0, and the recursion has
  not begun.
- Released. Sample 0 is read before anything acts: encoder at the starting angle, accelerometer at its
  offset. From then on every torque acts, a bias too, also while an input delay still holds the command at 0:
  the delay comes before the bias in the chain. The actuator's lag starts at 0.
- Equilibrium. The base stands at the starting angle. Its own constant torques are carried by the drive's
  twist and the motor's friction holds the rest; failing that, the motor is balanced and the base's friction
  holds the rest; failing that, the base stands at the nearest stable angle where all torques balance. The
  actuator's lag starts at the bias.
- Late sensors. Before t = delay the encoder holds its starting reading, the accelerometer reads zero
  acceleration.
- Noise joins the accelerometer with the offset, before clip and rounding.
- accel_zero: the mean of 0.2 s of readings at rest before sample 0 (offset, noise, clip, rounding as in the
  run). It is written to the metadata of runs that use it, and is 0 in others.
- Backlash: the law as written. In contact the damper acts with the whole relative speed, so it strikes on
  entry and may pull on the way out, until |motor - base| falls to gap / 2.
- Hardening in the drive cubes what exceeds the gap; load_friction takes spring, damper and cubic together. Without
  a drive its load is motor torque (gain times command, less the back-EMF, ripple and drag at the motor) less
  external torque (what acts at the base, and the beam's). Back-EMF is that share of motor.damping which
  motor.back_emf says, all of it by default; cases draw it from 0 to 1 where the nominal rig states none.
- stribeck_friction: static_torque holds at rest, the curve applies once it moves. Dry frictions of one part
  add.
- A rig without drive has motor and base in one: frictions at both add.
- Encoder zero: all runs of a case share one (`zero_id` "bench"); angles in effects count from it. A run
  simulated with another `zero_angle` keeps angles of effects, eccentricity included, on the machine's own
  zero.
- Beam damping is proportional to the beam's own bending stiffness, not to the clamp's.
- clock_scale: the rig lives in true seconds, one tick lasting ratio / sample_rate; compensators and `t` do
  not know.
- beam.length is uncertain like the beam's other constants ("default covers beam"); elements are not a
  constant here.
- accelerometer_centripetal takes the base's speed; its fraction may have either sign.

Effects that a rig dict holds belong to the nominal rig, which a diagnosis is given; their values are exact. `SERVO` has
gravity so, is tested under its own position loop, and may be drawn without saying so (`known_controller=False`).

Rigs are drawn within 2 sigma (`rigs.draw_logs`) and kept if `cases.behaves`. Severity (`cases.Severity`) is
the chi squared lost by the best re-fitted rig without the cause.

A case's world is perfect but for its causes and noise, or imperfect by a level (`make_case(..., disturbance=0.02)`,
module `disturbance`): torque, gain, modes, sensor and start each a little off, the hidden causes the same. What is
plain in a perfect world may drown there: `severity_in_world` takes the disturbances into account.

Outside the catalogue (`OUTSIDE`), none of which is a law of the contract: presliding_friction (a bristle
that bends over degrees, its level wavy with angle), angle_friction (dry friction of the base, wavy with
angle), friction_drift (dry friction that warms up or fades during a run), second_appendage (one more
flexible body on the base), mount_compliance (the frame yields, the encoder reads against it), motor_fade
(the gain falls with the heat of past commands), cable_snag (a torque inside a window of angles, at some
times), encoder_slip (counts lost at some moments), stuck_bit (of the accelerometer's converter), end_stop
(stops on either side of the base), tip_rattle (a loose mass).
"""

from __future__ import annotations

from .cases import (
    Case,
    Conditions,
    Severity,
    Test,
    behaves,
    draw_servo_tests,
    draw_tests,
    make_case,
    multisine_test,
    prbs_test,
    pulse_test,
    simulate_case,
    step_test,
    sweep_test,
)
from .rigs import RIGID_AXIS, SERVO, SFLR, SFLR_UNIT, TWO_MASS, RigDict, draw_constants, draw_logs, uncertain_keys
from .simulate import CATALOGUE, CONTROLLERS, OUTSIDE, Effect, Output, Truth
from .sizes import draw_effect, outside_names, scaled
from .sizes import names as effect_names

__all__ = [
    "CATALOGUE",
    "CONTROLLERS",
    "OUTSIDE",
    "RIGID_AXIS",
    "SERVO",
    "SFLR",
    "SFLR_UNIT",
    "TWO_MASS",
    "Case",
    "Conditions",
    "Effect",
    "Output",
    "RigDict",
    "Severity",
    "Test",
    "Truth",
    "behaves",
    "draw_constants",
    "draw_effect",
    "draw_logs",
    "draw_servo_tests",
    "draw_tests",
    "effect_names",
    "make_case",
    "multisine_test",
    "outside_names",
    "prbs_test",
    "pulse_test",
    "scaled",
    "simulate_case",
    "step_test",
    "sweep_test",
    "uncertain_keys",
]

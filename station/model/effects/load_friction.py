"""Load-dependent friction: gears rub in proportion to the torque that they carry."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def level(x, v, w, p, s, h):
    """Level fraction * load, N m (as in models of gear friction, e.g. Dohring et al. 1993)."""
    return p[0] * w


class LoadFriction(Effect):
    """Opposes the motor's velocity with a fraction of the load on its gears; holds at rest; adds to other friction.

    The load is the size of the drive's torque.  On a rig without a drive, whose gears are thought of as stiff between
    the motor and what it moves, it is |motor torque - external torque|, each as it acts on the axis (Duclusaud,
    Passault et al., Extended Friction Models for the Physics Simulation of Servo Actuators, 2024, model M3).  Motor
    torque is motor.gain times the command that acts, less the back-EMF (motor.back_emf of motor.damping, times
    speed), and what acts at the motor (ripple, drag); external torque is what acts at the base (gravity, cable, drag)
    and the torque of a beam.  A motor that holds a weight with 0.3 N m so has a load of 0.6 N m.  Dry friction is no
    load.
    """

    name, title = "load_friction", "load-dependent friction"
    sites: ClassVar = ("drive", "motor")
    stage, law = Stage.FRICTION, level
    picture = "speed"
    experiment: ClassVar = {"kind": "step", "amplitude": 100, "controller": "lead"}
    telling = ("the motor is braked while the gears work hard and hardly while it coasts; Coulomb friction brakes "
               "alike in both")

    fraction: float = parameter("1", 0.0, 0.999, neutral=0.0)

    @classmethod
    def fits(cls, rig, at):
        """At the drive; at the motor only where there is no drive."""
        return super().fits(rig, at) and (at == "drive" or rig.drive is None)

    @classmethod
    def guesses(cls, rig, at):
        return [{"fraction": value} for value in (0.05, 0.2, 0.5)]

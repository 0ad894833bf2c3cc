"""Air drag: grows with the square of the speed."""

from typing import ClassVar

from station.model.effects.base import USUAL_SPEED, Effect, Stage, parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = -k w |w|, N m."""
    return -p[0] * v * abs(v)


class QuadraticDrag(Effect):
    """Opposes the base's motion with the square of its speed."""

    name, title = "quadratic_drag", "quadratic drag"
    sites: ClassVar = ("base",)
    stage, law = Stage.TORQUE, torque
    picture = "speed"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = ("fast swings are braked out of proportion; a wrong motor.damping brakes fast and slow ones alike, "
               "sublinear drag the slow ones more")

    coefficient: float = parameter("N m s^2/rad^2", 0.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"coefficient": share * torque_scale(rig) / 50.0} for share in (0.01, 0.1, 0.5)]

    @classmethod
    def guesses_at(cls, rig, at, speed):
        """The same torques at the runs' speed."""
        return [{"coefficient": guess["coefficient"] * (USUAL_SPEED / speed) ** 2} for guess in cls.guesses(rig, at)]

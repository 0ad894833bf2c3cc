"""Pictures specific to a cause: what was measured once the cause is taken out, and the fitted law drawn through it.

The rig that points are taken against is the extended rig without the one cause, so that other causes do not blur the
picture; the sceptic's view at the end is against the re-fitted rig alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from station.estimation.cause import constant_path, is_constant
from station.estimation.pool import Pool
from station.model.effects import Stage, catalogue
from station.pictures.joints import wind_up
from station.pictures.missing import missing_torque
from station.pictures.picture import DELAYS, Cause, Evidence
from station.pictures.responses import command_response, over_frequency
from station.pictures.sensors import centripetal, clocks, eccentricity, readings
from station.pictures.torques import against_command, against_load, against_motion, against_time, sceptics_view
from station.rig import Rig
from station.runs.run import Run


def evidence(rig: Rig, extended_rig: Rig, runs: Sequence[Run], causes: Sequence[tuple[str, str]],
             pool: Pool | None = None) -> list[Evidence]:
    """The pictures of each cause (effect or "parameter:TABLE.KEY", at), then the sceptic's view of the worst run.

    ``rig``: re-fitted without any cause; ``extended_rig``: with all.  A cause that the extended rig does not hold is
    passed over.  Without causes the whole sceptic's view is given: the torque that is missing at the motor against
    time, speed, angle, command, load and frequency.  ``pool``: processes over which the runs are spread.
    """
    found = [picture for name, at in causes for picture in _pictures(rig, extended_rig, list(runs), name, at)]
    torques = list((pool or Pool()).map(partial(missing_torque, rig), runs))
    if torques:
        worst, run = max(zip(torques, runs, strict=True), key=lambda pair: float(np.mean(pair[0].torque ** 2)))
        found += sceptics_view(worst, run)[: 1 if found else None]
    return found


def _pictures(rig: Rig, extended: Rig, runs: list[Run], name: str, at: str) -> list[Evidence]:
    """Of one cause: chosen by the effect's own ``picture`` and by the stage at which it acts."""
    if is_constant(name):
        path = constant_path(name)
        stated = {(e.name, e.at): e for e in rig.effects if path.startswith(f"{e.name}.")}
        if path in rig.constants() and path in extended.constants():
            without = extended.with_constants({path: rig.constants()[path]})
        elif stated:
            without = extended.with_effects([stated.get((e.name, e.at), e) for e in extended.effects])
        else:
            return []
        return command_response(Cause(f"wrong {path}", extended, without, runs))
    effect = next((e for e in extended.effects if (e.name, e.at) == (name, at)), None)
    if effect is None:
        return []
    if effect.absolute is not None:
        zero = runs[0].metadata.zero_id
        runs = runs[:1] + [r for r in runs[1:] if zero and r.metadata.zero_id == zero]
    title = catalogue()[name].title or name if name in catalogue() else name
    cause = Cause(title, extended, extended.with_effects([e for e in extended.effects if e is not effect]), runs)
    if effect.stage is Stage.CLOCK:
        return clocks(cause) + over_frequency(cause, effect, ("gain",))
    if effect.stage in DELAYS or effect.picture == "frequency" and effect.stage is Stage.COMMAND:
        return over_frequency(cause, effect, ("phase",))
    if effect.stage is Stage.ACCEL_FILTER:
        return over_frequency(cause, effect, ("gain", "phase"))
    if effect.stage is Stage.ACCEL_INPUT:
        return centripetal(cause, effect)
    if effect.stage is Stage.ACCEL_COUNTS:
        return readings(cause, effect)
    if effect.stage is Stage.ENCODER:
        return eccentricity(cause, effect)
    if effect.stage in (Stage.GAP, Stage.SPRING):
        return wind_up(cause, effect)
    if effect.stage is Stage.COMMAND:
        return against_command(cause)
    if effect.by_load(extended, effect.at):
        return against_load(cause, effect)
    if effect.stage in (Stage.TORQUE, Stage.FRICTION) and effect.picture in ("speed", "angle"):
        return against_motion(cause, effect)
    return against_time(cause, effect)

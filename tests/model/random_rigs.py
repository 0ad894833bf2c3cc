"""Rigs that Hypothesis draws: constants around those of the flexible arm, any part missing."""

from __future__ import annotations

from hypothesis import strategies as st

from station.rig import Accelerometer, Amplifier, Base, Beam, Encoder, Joint, Motor, Rig, Tip


def _around(value: float, factor: float = 10.0) -> st.SearchStrategy[float]:
    return st.floats(-1.0, 1.0).map(lambda power: value * factor**power)


@st.composite
def rigs(draw: st.DrawFn, damped: bool = True, most_elements: int = 12) -> Rig:
    """A rig with any parts missing; constants within a factor of 10 (inertias) of the arm's, either way."""
    damping = _around if damped else (lambda value: st.just(0.0))
    has_beam = draw(st.integers(0, 4)) > 0
    has_base = draw(st.integers(0, 3)) > 0
    drive = has_base and draw(st.booleans())
    clamp = has_beam and draw(st.booleans())
    beam = tip = accelerometer = None
    if has_beam:
        beam = Beam(mass_per_length=draw(_around(0.13, 3.0)), length=draw(_around(0.41, 2.0)),
                    flexural_rigidity=draw(_around(0.21, 5.0)), damping=draw(damping(1e-4)),
                    elements=draw(st.integers(1, most_elements)))
        accelerometer = Accelerometer(gain=1.1)
        if draw(st.booleans()):
            tip = Tip(mass=draw(_around(0.006)), inertia=draw(st.sampled_from([0.0, 7e-7])))
    return Rig(
        name="drawn", sample_rate=500.0, amplifier=Amplifier(limit=200.0),
        motor=Motor(inertia=draw(_around(0.0013)), damping=draw(damping(0.016)), gain=draw(_around(0.01))),
        drive=Joint(stiffness=draw(_around(0.1)), damping=draw(damping(0.02))) if drive else None,
        base=Base(inertia=draw(_around(0.0016))) if has_base else None,
        clamp=Joint(stiffness=draw(_around(2.5)), damping=draw(damping(0.004))) if clamp else None,
        beam=beam, tip=tip, encoder=Encoder(counts_per_revolution=1024), accelerometer=accelerometer)

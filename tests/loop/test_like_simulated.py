"""What a rig does through the loop is what ``simulate`` says of it: torques act in a session alone, from sample 0."""

from dataclasses import replace

import numpy as np
import pytest

from station.control.references import reference_from_test
from station.device.client import Client
from station.device.port import open_port
from station.model.effects import effect_class
from station.model.simulate import build, simulate_model

EFFECTS = {
    "command_bias": ("amplifier", {"offset": 6.0}),
    "gravity_tilt": ("base", {"torque": 0.05, "angle": 1.2}),
    "cable_spring": ("base", {"stiffness": 0.2, "rest": 0.5}),
    "coulomb_friction": ("motor", {"torque": 0.03}),
}
TESTS = {
    "step": ({"kind": "p", "gain": 2.0}, {"kind": "step", "amplitude": 80.0, "duration": 1.5}),
    "pulse": ({"kind": "open"}, {"kind": "pulse", "amplitude": 100.0, "duration": 1.5}),
}


@pytest.fixture(params=EFFECTS)
def rig(request, rows):
    at, parameters = EFFECTS[request.param]
    return rows.rig.with_effects([effect_class(request.param)(at=at, **parameters)])


@pytest.fixture
def port(rig, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(rig.to_toml())
    with open_port(f"sim://?rig={path}") as port:
        yield port


def simulated(rig, run, **options):
    return simulate_model(build(rig), run, **options)


def with_one_row_more(run):
    """The run until the tick at which the stop found the rig."""
    def longer(column):
        return np.append(column, column[-1])

    return replace(run, t=np.append(run.t, len(run) / run.sample_rate), reference=longer(run.reference),
                   command=longer(run.command), encoder=longer(run.encoder), accel=longer(run.accel), n=None,
                   device_time=None, host_time=None, status=None, command_sent=None, latency=None, slack=None)


@pytest.mark.parametrize("test", TESTS)
def test_a_session_is_the_simulation_of_the_same_rig_wherever_it_begins(rows, rig, port, test):
    spec, asked = TESTS[test]
    reference = reference_from_test(asked, rig.sample_rate)
    angle = 0.0
    for _ in range(3):
        rows.test(port, spec, rig=rig, reference=reference, relative=True)
        run = rows.run
        assert run.metadata.start == "released"
        made = simulated(rig, run, start_angle=angle)
        assert np.max(np.abs(made.encoder - run.encoder)) <= 1
        assert np.max(np.abs(made.accel - run.accel)) <= 1
        assert np.max(np.abs(made.command - run.command)) <= 1
        assert np.ptp(run.encoder) > 20
        beyond = simulated(rig, with_one_row_more(run), start_angle=angle, rounding="inside")
        angle = float(beyond.encoder[-1]) * rig.angle_per_count
    assert angle != 0.0


def test_between_sessions_the_rig_stands_still(rows, rig, port):
    rows.test(port, TESTS["pulse"][0], rig=rig, rows=180)     # it ends at full speed
    stood = []
    client = Client(port)
    for _ in range(5):
        client.wait(0.3)
        stood.append(client.statistics().encoder)
    assert abs(rows.run.encoder[-1] - rows.run.encoder[-2]) >= 1
    assert len(set(stood)) == 1
    assert abs(stood[0] - rows.run.encoder[-1]) <= 2 * abs(rows.run.encoder[-1] - rows.run.encoder[-2])
    rows.test(port, {"kind": "open"}, rig=rig, reference=np.zeros(150))
    assert rows.run.encoder[0] == rows.run.encoder[1] == stood[0]

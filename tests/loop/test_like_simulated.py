"""What a rig does through the loop is what ``simulate`` says of it: torques act in a session alone, from sample 0."""

import numpy as np
import pytest

from station.control.references import reference_from_test
from station.device.client import Client
from station.device.port import open_port
from station.device.protocol import Status
from station.device.simulated import idle_command
from station.errors import WorkError
from station.model.effects import effect_class
from station.model.simulate import Plant, build, simulate_model

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
    return simulate_model(build(rig.meshed()), run, **options)


def angles_of_starts(port):
    """Where the arm is released at each session (rad), as the plant behind the port knows it."""
    source, angles = port.serial.device._source, []
    begin = source.begin

    def noted():
        begin()
        angles.append(float(source._plant.model.plan.base_angle @ source._plant._state.z))

    source.begin = noted
    return angles


@pytest.mark.parametrize("test", TESTS)
def test_a_session_is_the_simulation_of_the_same_rig_wherever_it_begins(rows, rig, port, test):
    spec, asked = TESTS[test]
    reference = reference_from_test(asked, rig.sample_rate)
    starts = angles_of_starts(port)
    for _ in range(3):
        rows.test(port, spec, rig=rig, reference=reference, relative=True)
        run = rows.run
        assert run.metadata.start == "released"
        made = simulated(rig, run, start_angle=starts[-1])
        assert np.max(np.abs(made.encoder - run.encoder)) <= 1
        assert np.max(np.abs(made.accel - run.accel)) <= 1
        assert np.max(np.abs(made.command - run.command)) <= 1
        assert np.ptp(run.encoder) > 20
    assert starts[-1] != 0.0


def test_after_a_session_the_arm_coasts_to_rest_and_then_stands_still(rows, rig, port):
    """It ends at full speed: the device says that the arm moves, and what the host asks of rest waits for it."""
    rows.test(port, TESTS["pulse"][0], rig=rig, rows=180)
    speed = abs(rows.run.encoder[-1] - rows.run.encoder[-2])
    assert speed >= 1
    client = Client(port)
    found = client.statistics()
    assert found.status & Status.MOVING
    rested = client.wait_for_rest(20.0)
    assert abs(rested - rows.run.encoder[-1]) > speed
    client.wait(1.0)
    stood = client.statistics().encoder  # where the brake has caught it
    client.wait(5.0)
    assert client.statistics().encoder == stood
    rows.test(port, {"kind": "open"}, rig=rig, reference=np.zeros(150))
    assert rows.run.encoder[0] == stood


def test_a_test_on_an_arm_that_moves_is_refused_and_leaves_no_log(rows, rig, port, monkeypatch):
    rows.test(port, TESTS["pulse"][0], rig=rig, rows=180)
    monkeypatch.setattr("station.loop.run_test.SETTLE_SECONDS", 0.0)
    with pytest.raises(WorkError, match="the arm still moves"):
        rows.test(port, TESTS["pulse"][0], rig=rig)
    assert len(rows.sinks) == 1


def test_a_drive_that_is_off_pushes_neither_way(rig):
    plant = Plant(rig)
    command = idle_command(rig)
    held = [plant.advance(command) or plant.sample()[0] for _ in range(200)]
    if rig.effects[0].name in ("command_bias", "coulomb_friction"):
        assert set(held) == {0}
    assert (command == -6.0) == (rig.effects[0].name == "command_bias")

"""A closed loop on a rig that may be real wants a passed check, an arm at rest and a small first command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from station.device.client import Client
from station.device.port import open_port
from station.device.simulated import SimulatedDevice
from station.errors import UsageError
from station.loop import checked
from station.loop.check import check
from station.loop.safety import FIRST_COMMAND_SHARE
from station.rig import load_rig

P = {"kind": "p", "gain": 2.0}


@pytest.fixture(autouse=True)
def real(monkeypatch, tmp_path):
    """Every device counts as one that may be real, and checks are remembered here."""
    monkeypatch.setattr(checked, "is_simulated", lambda url, identity: False)
    monkeypatch.setattr(checked, "store", lambda: tmp_path / "states" / "checks.json")


@pytest.fixture
def port():
    with open_port("sim://sflr") as port:
        yield port


def test_without_a_check_a_closed_loop_is_refused_and_arms_nothing(rows, port, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Client, "arm", lambda self: pytest.fail("armed"))
        with pytest.raises(UsageError, match=r"no passed check .* rig sflr .*station check --port sim://sflr"):
            rows.test(port, P)
    assert rows.sinks == []
    rows.test(port, {"kind": "open"})  # open loop asks for none: no sign of it can run away
    assert rows.sinks[-1].metadata.entries()["check"] is None


def test_force_goes_without_and_the_log_says_so(rows, port):
    rows.test(port, P, force=True)
    assert rows.sinks[-1].metadata.entries()["check"] == "forced"


def test_a_passed_check_holds_for_this_device_firmware_and_rig_alone(rows, port):
    identity = Client(port).identify()
    checked.remember(identity, rows.rig)
    rows.test(port, P)
    assert rows.sinks[-1].metadata.entries()["check"] == checked.passed(identity, rows.rig) is not None
    assert checked.passed(replace(identity, boot=identity.boot ^ 1), rows.rig) is None  # powered up anew
    assert checked.passed(replace(identity, build=identity.build ^ 1), rows.rig) is None
    assert checked.passed(identity, rows.rig.with_constants({"motor.gain": -rows.rig.motor.gain})) is None
    unsure = rows.rig.model_copy(update={"uncertainty": {"default": 0.5}})
    assert checked.passed(identity, unsure) is not None
    checked.forget(identity, rows.rig)
    with pytest.raises(UsageError, match="no passed check"):
        rows.test(port, P)


def test_a_check_that_passes_is_remembered_and_one_that_fails_takes_it_back(rows, tmp_path):
    turned = rows.rig.with_constants({"motor.gain": -rows.rig.motor.gain})
    path = tmp_path / "turned.toml"
    path.write_text(turned.to_toml())
    with open_port("sim://sflr?noise=1&seed=1") as port:
        assert check(port, rows.rig).passed
        identity = Client(port).identify()
        assert checked.passed(identity, rows.rig) is not None
        rows.test(port, P, relative=True)
        port.serial.device._source = SimulatedDevice.of_rig(turned)._source  # its leads are swapped now
        assert not check(port, rows.rig).passed
        with pytest.raises(UsageError, match="no passed check"):
            rows.test(port, P, relative=True)


def test_a_check_that_cannot_be_remembered_says_so(rows, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(checked, "store", lambda: tmp_path / "file" / "checks.json")
    with open_port("sim://sflr?noise=1&seed=1") as port:
        found = check(port, rows.rig)
    assert found.passed and "could not be noted" in found.words[-1]


def test_a_damaged_memory_is_none(rows, port):
    identity = Client(port).identify()
    for text in ("", "{", "[1, 2]", '{"a": 1}', '[{"board": 3}]'):
        checked.store().parent.mkdir(exist_ok=True)
        checked.store().write_text(text)
        assert checked.passed(identity, rows.rig) is None
        checked.remember(identity, rows.rig)
        assert checked.passed(identity, rows.rig) is not None


def test_the_memory_is_bounded(rows, port, monkeypatch):
    monkeypatch.setattr(checked, "KEPT", 3)
    identity = Client(port).identify()
    for boot in range(5):
        checked.remember(replace(identity, boot=boot), rows.rig)
    kept = json.loads(checked.store().read_text())
    assert [entry["boot"] for entry in kept] == ["00000002", "00000003", "00000004"]


def test_a_first_command_beyond_its_share_of_the_limit_is_refused(rows):
    limit, gain = 200.0, 2.0
    allowed = int(FIRST_COMMAND_SHARE * limit / gain)
    with open_port("sim://sflr") as port:
        for off, refused in ((allowed, False), (allowed + 1, True)):
            client = Client(port)
            client.identify()
            reference = np.full(600, client.wait_for_rest() + off, dtype=float)
            if refused:
                with pytest.raises(UsageError, match=r"the first command would be 22 counts, more than 10 % .* of 200"):
                    rows.test(port, P, reference=reference, force=True)
            else:
                rows.test(port, P, reference=reference, force=True)
    assert len(rows.sinks) == 1


@pytest.mark.parametrize(("spec", "begins"), [(P, lambda n: np.arange(n)), ({"kind": "open"}, lambda n: np.ones(n)),
                                              (P, lambda n: np.where(np.arange(n) < 99, 0.0, 5.0))])
def test_a_reference_that_does_not_begin_with_a_rest_is_refused(rows, spec, begins):
    with pytest.raises(UsageError, match=r"at least 0.2 s at rest"):
        rows.test_at("sim://sflr", spec, reference=begins(600).astype(float), force=True)


def test_simulated_rigs_need_no_check(monkeypatch, rows):
    monkeypatch.undo()
    with open_port("sim://sflr") as port:
        identity = Client(port).identify()
    assert checked.is_simulated("sim://sflr?speed=1", replace(identity, virtual_time=False))
    assert checked.is_simulated("/dev/pts/7", identity)  # its time waits for the host
    assert not checked.is_simulated("/dev/ttyUSB0", replace(identity, virtual_time=False))


def test_limits_are_held_by_the_host_and_the_device(rows, tmp_path):
    """A host whose rig file has limits stops a device that has none; a device with limits stops by itself."""
    from station.device.protocol import State
    from station.errors import WorkError
    from station.rig import Limits

    limited = load_rig("sflr").model_copy(update={"limits": Limits(travel=0.8)})
    path = tmp_path / "limited.toml"
    path.write_text(limited.to_toml())
    for url, rig, faulted in (("sim://sflr", limited, True), (f"sim://x?rig={path}", limited, True),
                              (f"sim://x?rig={path}", rows.rig, True)):
        with open_port(url) as port:
            with pytest.raises(WorkError, match=r"went (130|131|132|133|134|135|136|137|138|139|140) counts from where"
                                                r"|in fault \(travel\)"):
                rows.test(port, {"kind": "open"}, rig=rig, reference=rows.reference(amplitude=150.0))
            core = port.serial.device.core
            assert core.drive == 0 and (core.state == State.FAULT) == faulted
        assert np.max(np.abs(rows.run.encoder)) < 150
    with pytest.raises(UsageError, match=r"limits.travel = 0.8"):
        rows.test_at("sim://sflr", P, rig=limited, reference=rows.reference(amplitude=200.0), force=True)

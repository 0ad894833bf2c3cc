"""The sealed rigs that come with Station: the rig sflr but for constants within their uncertainty and one effect."""

import numpy as np
import pytest

from station.campaign.battery import NOISE
from station.campaign.hidden import CLEAR, _outputs, severity
from station.campaign.simulated import planned
from station.device.client import Client
from station.device.port import open_port
from station.device.sealed import fingerprint, seal, sealed_rigs, sealed_text, simulated_rig
from station.errors import UsageError
from station.rig import builtin_rigs, load_rig

SFLR = load_rig("sflr")


def test_there_are_some_and_no_rig_file_gives_them_away():
    assert sealed_rigs() == ["sealed-1", "sealed-2", "sealed-3"]
    assert not set(sealed_rigs()) & set(builtin_rigs())
    assert len({simulated_rig(name).effects[0].name for name in sealed_rigs()}) == 3
    with pytest.raises(UsageError, match="sealed-1"):  # not to be simulated or diagnosed with
        load_rig("sealed-1")
    with pytest.raises(UsageError, match="sealed-9: no sealed rig; there are sealed-1, sealed-2"):
        sealed_text("sealed-9")


@pytest.mark.parametrize("name", sealed_rigs())
def test_what_is_hidden_shows_in_tests_and_constants_lie_within_their_uncertainty(name):
    rig = simulated_rig(name)
    assert len(rig.effects) == 1 and rig.name == "sflr"
    tests = planned(SFLR)
    assert severity(SFLR, rig, _outputs(rig, tests), tests, NOISE) > CLEAR
    paths = list(SFLR.constants())
    shift = np.log([rig.constants()[path] / SFLR.constants()[path] for path in paths])
    assert np.all(np.abs(shift) <= 4.0 * np.sqrt(np.diag(SFLR.log_covariance(paths)))) and np.any(shift != 0.0)


@pytest.mark.parametrize("name", sealed_rigs())
def test_the_port_answers_as_the_rig_that_it_hides(name):
    with open_port(f"sim://{name}?noise=0.5&seed=1") as port:
        assert Client(port).identify().board == "sflr"
        assert port.serial.device._source._plant.model.rig.effects == simulated_rig(name).effects


def test_a_seal_holds_the_rig_file_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "rigs").mkdir()
    seal(SFLR, tmp_path / "rigs" / "x.seal")
    monkeypatch.setattr("station.device.sealed.resources.files", lambda package: tmp_path)
    assert sealed_rigs() == ["x"] and sealed_text("x") == SFLR.to_toml() and simulated_rig("x") == SFLR
    before = fingerprint("x")
    seal(SFLR.with_constants({"tip.mass": 0.007}), tmp_path / "rigs" / "x.seal")
    assert fingerprint("x") != before

"""Limits on the command line: what asks for too much is refused before anything moves; what is cut says so."""

from __future__ import annotations

import pytest

from station.cli.investigate import capped
from station.device.client import Client
from station.rig import Limits, builtin_rigs, load_rig

RIG = load_rig("sflr")
LIMITED = RIG.model_copy(update={"limits": Limits(travel=1.0, command=80.0)})


@pytest.fixture
def limited(tmp_path):
    path = tmp_path / "limited.toml"
    path.write_text(builtin_rigs()["sflr"].replace("[motor]", "[limits]\ntravel = 1.0\ncommand = 80.0\n\n[motor]"))
    return path


@pytest.mark.parametrize(("kind", "amplitude", "named"), [
    ("step", "1e9", "limits.travel = 1"), ("step", "170", "limits.travel = 1"), ("pulse", "81", "limits.command = 80"),
    ("pulse", "-1e9", "limits.command = 80")])
def test_an_amplitude_beyond_the_limits_is_refused_before_anything_moves(station, tmp_path, limited, monkeypatch, kind,
                                                                          amplitude, named):
    monkeypatch.setattr(Client, "arm", lambda self: pytest.fail("armed"))
    out = tmp_path / "run.mcap"
    ended = station("run", kind, "--port", "sim://sflr", "--rig", limited, "--amplitude", amplitude, "--out", out)
    assert ended.status == 2 and named in ended.one_line() and not out.exists()


def test_a_gain_of_the_wrong_sign_is_stopped_by_the_travel_limit(station, tmp_path, limited):
    out = tmp_path / "run.mcap"
    ended = station("run", "step", "--port", "sim://sflr", "--rig", limited, "--amplitude", "20", "--gain", "-1000",
                    "--out", out)
    assert ended.status == 1 and "counts from where it began, the limit is 162" in ended.err.splitlines()[-1]


def test_a_pulse_that_was_cut_says_so(station, tmp_path):
    ended = station("run", "pulse", "--port", "sim://sflr", "--rig", "sflr", "--amplitude", "1e9", "--width", "0.05",
                    "--out", tmp_path / "run.mcap")
    assert ended.status == 0, ended.err
    assert "the command was cut to 200 counts on 50 rows: what acted is smaller than what was asked" in ended.out
    small = station("run", "pulse", "--port", "sim://sflr", "--rig", "sflr", "--amplitude", "100", "--out",
                    tmp_path / "small.mcap")
    assert "cut to" not in small.out


@pytest.mark.parametrize(("size", "open_loop", "rig", "cap", "then"), [
    (100.0, True, RIG, None, 100.0), (300.0, True, RIG, None, 200.0), (-150.0, True, LIMITED, None, -80.0),
    (150.0, False, LIMITED, None, 101.0), (150.0, False, RIG, None, 150.0), (150.0, False, RIG, 60.0, 60.0),
    (-150.0, True, LIMITED, 60.0, -60.0)])
def test_an_investigation_keeps_its_tests_within_limits_and_cap(size, open_loop, rig, cap, then):
    assert capped({"kind": "step", "amplitude": size}, open_loop, rig, cap) == {"kind": "step", "amplitude": then}
    assert capped({"kind": "odd"}, open_loop, rig, cap) == {"kind": "odd"}


def test_a_port_at_another_baud_rate_is_opened_so(station, monkeypatch):
    from station.device import port

    seen = []
    opened = port.serial.serial_for_url
    monkeypatch.setattr(port.serial, "serial_for_url",
                        lambda url, baudrate, **settings: seen.append(baudrate) or opened(url, baudrate, **settings))
    assert station("loopback", "--port", "sim://sflr", "--seconds", "0.1").status == 0
    assert station("loopback", "--port", "sim://sflr", "--seconds", "0.1", "--baud", "115200").status == 0
    assert seen == [921_600, 115_200]

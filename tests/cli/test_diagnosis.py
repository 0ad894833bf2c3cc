"""diagnose and demo from the command line."""

from __future__ import annotations

import hashlib
import importlib
import json

import numpy as np
import pytest

from station.campaign import hidden
from station.campaign.hidden import CLEAR, LEFT_OUT, _outputs, draw, severity
from station.campaign.simulated import planned
from station.cli.demo import APART, MADE, MARK, TESTS, _fresh, told
from station.cli.sealed import Sealed
from station.diagnose.result import Cause, Diagnosis, DiagnosisResult, Estimate, Gain, Rival
from station.model.effects import catalogue, effect_class
from station.rig import load_rig
from station.runs import load_run

SFLR = load_rig("sflr")


def test_diagnose_writes_what_was_asked_for(station, tmp_path, monkeypatch):
    hidden = tmp_path / "hidden.toml"
    hidden.write_text(SFLR.with_effects([effect_class("dead_zone")(at="amplifier", width=12.0)]).to_toml())
    runs = []
    for kind, amplitude in (("step", 50), ("pulse", 80), ("step", 25)):
        runs.append(tmp_path / f"{kind}{amplitude}.mcap")
        ended = station("run", kind, "--port", f"sim://x?rig={hidden}&noise=0.3&seed=5", "--rig", "sflr",
                        "--amplitude", amplitude, "--duration", "1.2", "--out", runs[-1])
        assert ended.status == 0, ended.err
    found, report, rig = tmp_path / "d.json", tmp_path / "r.html", tmp_path / "extended.toml"
    read = {run.stem: hashlib.sha256(run.read_bytes()).hexdigest() for run in runs}
    module = importlib.import_module("station.diagnose.diagnose")
    diagnose = module.diagnose

    def replaced_meanwhile(*args, **options):
        runs[0].write_bytes(b"another test")
        return diagnose(*args, **options)

    monkeypatch.setattr(module, "diagnose", replaced_meanwhile)
    ended = station("diagnose", "--rig", "sflr", *runs, "--effort", "quick", "--json", found, "--report", report,
                    "--save-rig", rig)
    assert ended.status == 0, ended.err
    diagnosis = Diagnosis.model_validate_json(found.read_text(encoding="utf-8"))
    assert diagnosis.verdict in ended.out.replace(" ", "_") or diagnosis.causes
    assert [(cause.effect, cause.at) for cause in diagnosis.causes][:1] == [("dead_zone", "amplifier")]
    assert "Dead zone" in ended.out or "dead zone" in ended.out
    assert {row.run: row.file_sha256 for row in diagnosis.runs} == read, "what was diagnosed, not what is there now"
    assert "<html" in report.read_text(encoding="utf-8")[:2000]
    assert any(effect.name == "dead_zone" for effect in load_rig(rig).effects)


def test_diagnose_refuses_what_it_cannot_use(station, step, tmp_path):
    ended = station("diagnose", "--rig", "sflr", step, tmp_path / "none.csv")
    assert ended.status == 1 and "none.csv" in ended.one_line()
    assert station("diagnose", "--rig", "sflr", step, "--effort", "heroic").status == 2
    ended = station("diagnose", "--rig", "sflr", step, "--report", tmp_path / "no" / "r.html")
    assert ended.status == 1 and "does not exist" in ended.one_line()


def test_a_demo_takes_away_what_an_earlier_one_made_and_nothing_else(tmp_path):
    out = tmp_path / "demo"
    assert _fresh(out) == out
    mine = [out / "notes.txt", out / "runs" / "own_run.mcap"]
    for path in (*mine, *(out / name for name in MADE)):
        path.write_text("x", encoding="utf-8")
    _fresh(out)
    assert sorted(path for path in out.rglob("*") if path.is_file()) == sorted([*mine, out / MARK])


def test_the_demo_does_the_whole_job_and_opens_the_seal(station, tmp_path):
    out = tmp_path / "demo"
    ended = station("demo", "--seed", "3", "--effort", "quick", "--out", out)
    assert ended.status == 0, ended.err
    assert sum(word in ended.out for word in ("   RIGHT:", "   PARTLY RIGHT:", "   WRONG:")) == 1
    assert {path.name for path in out.iterdir()} == {
        MARK, "runs", "diagnosis.json", "extended_rig.toml", "hidden_rig.toml", "recording.rrd", "report.html"}
    assert {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == {MARK, *MADE}
    sealed = hashlib.sha256((out / "hidden_rig.toml").read_bytes()).hexdigest()
    before_tests, _, _ = ended.out.partition("2. Tests")
    assert sealed in before_tests
    hidden = load_rig(out / "hidden_rig.toml")
    assert hidden.effects[0].name.replace("_", " ") not in before_tests
    assert {path.stem for path in (out / "runs").glob("*.mcap")} == {*TESTS, APART[0]}
    assert APART[0] not in json.loads((out / "diagnosis.json").read_text())["gain"]["held_out"]
    for path in (out / "runs").glob("*.mcap"):
        assert hidden.effects[0].name not in json.dumps(load_run(path).metadata.entries())
    load_rig(out / "extended_rig.toml")


def test_the_demo_keeps_a_folder_that_it_did_not_make(station, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    ended = station("demo", "--out", tmp_path)
    assert ended.status == 1 and "no demo made" in ended.one_line()
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("seed", [1])
def test_what_is_hidden_can_be_repeated_and_shows(seed):
    tests = planned(SFLR)
    drawn = draw(SFLR, tests, 0.5, np.random.default_rng(seed))
    assert drawn == draw(SFLR, tests, 0.5, np.random.default_rng(seed))
    assert len(drawn.effects) == 1 and drawn.effects[0].name in set(catalogue()) - LEFT_OUT
    deviation = np.log([drawn.constants()[path] / value for path, value in SFLR.constants().items()])
    whitened = np.linalg.solve(np.linalg.cholesky(SFLR.log_covariance(list(SFLR.constants()))), deviation)
    assert np.sqrt(np.mean(whitened**2)) < 2.0 and np.any(deviation != 0.0)


def test_severity_tells_an_effect_from_other_constants():
    """A rig that only has other constants leaves nothing; an effect that no constant imitates leaves much."""
    tests = planned(SFLR)[:3]
    off = SFLR.with_constants({"beam.length": SFLR.beam.length * 1.03, "drive.stiffness": 0.09})
    assert severity(SFLR, off, _outputs(off, tests), tests, 0.5) < 1.0
    moved = severity(SFLR, SFLR, _outputs(off, tests), tests, 0.5)
    assert moved < 50.0, "the fit finds the constants from elsewhere, too"
    loose = SFLR.with_effects([effect_class("backlash")(at="drive", gap=0.05)])
    assert severity(SFLR, loose, _outputs(loose, tests), tests, 0.5) > CLEAR


def test_a_refit_that_steps_to_constants_that_do_not_simulate_takes_a_shorter_step(monkeypatch):
    biased = SFLR.with_effects([effect_class("command_bias")(at="amplifier", offset=18.0)])
    tests = planned(SFLR)[:3]
    outputs, refused, real = _outputs(biased, tests), [], hidden.build

    def build(rig):
        if abs(rig.constants()["motor.damping"] / SFLR.constants()["motor.damping"] - 1.0) > 0.01:
            refused.append(rig)
            raise ArithmeticError("does not simulate")
        return real(rig)
    monkeypatch.setattr(hidden, "build", build)
    assert CLEAR < severity(SFLR, biased, outputs, tests, 0.5) < np.inf and refused


def test_a_seal_that_was_broken_is_noticed(tmp_path):
    sealed = Sealed.write(SFLR, tmp_path / "rig.toml")
    assert sealed.open() == SFLR
    sealed.path.write_text(SFLR.to_toml() + "\n")
    with pytest.raises(ValueError, match="not the file that was sealed"):
        sealed.open()


def _result(causes: list[Cause], verdict: str = "explained") -> DiagnosisResult:
    return DiagnosisResult(Diagnosis(verdict=verdict, causes=causes, gain=Gain(held_out=[])), SFLR, SFLR, SFLR, [])


def _cause(effect: str, at: str, rivals: tuple[tuple[str, str], ...] = (),
           **values: tuple[float, float, float]) -> Cause:
    return Cause(effect=effect, at=at, probability=0.9,
                 parameters={name: Estimate(value=v, low=low, high=high, unit="x")
                             for name, (v, low, high) in values.items()},
                 rivals=[Rival(effect=e, at=a, probability=0.1) for e, a in rivals])


BACKLASH = effect_class("backlash")(at="drive", gap=0.05)
FOUND = _cause("backlash", "drive", gap=(0.05, 0.04, 0.06))
OTHER = _cause("dead_zone", "amplifier", rivals=(("backlash", "drive"),), width=(3.0, 2.0, 4.0))


@pytest.mark.parametrize(("causes", "said"), [
    ([FOUND], "   RIGHT:"), ([FOUND, OTHER], "   PARTLY RIGHT:"), ([OTHER], "   WRONG:"),
    ([_cause("dead_zone", "amplifier")], "   WRONG:"), ([], "   WRONG:")])
def test_wrong_is_said_as_plainly_as_right(causes, said):
    assert told(BACKLASH, _result(causes).diagnosis)[1].startswith(said)


def test_an_interval_that_misses_the_truth_is_shown():
    missed = _cause("backlash", "drive", gap=(0.08, 0.07, 0.09))
    assert "OUTSIDE" in told(BACKLASH, _result([missed]).diagnosis)[2]
    assert "is inside" in told(BACKLASH, _result([FOUND]).diagnosis)[2]
    narrow = _cause("backlash", "drive", gap=(0.0500021, 0.0500011, 0.0500031))
    assert "0.0500011 to 0.0500031" in told(BACKLASH, _result([narrow]).diagnosis)[2]     # its ends stay apart
    tilt = effect_class("gravity_tilt")(at="base", torque=0.1, angle=-3.1)
    wrapped = _cause("gravity_tilt", "base", torque=(0.1, 0.05, 0.2), angle=(3.14, 3.0, -3.0))
    assert all("is inside" in line for line in told(tilt, _result([wrapped]).diagnosis)[2:])

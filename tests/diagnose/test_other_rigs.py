"""Diagnosis on rigs that lack parts, down to a rigid axis with an encoder: hidden effects by the independent generator.

Four runs each, quick effort, seeds 8000 to 8049; the method was not developed on them, but for the bias that all runs
share.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from station.diagnose.result import DiagnosisResult
from station.errors import UsageError
from station.model.effects import effect_class
from station.pictures.missing import missing_torque
from station.rig import Rig
from station.view.recording import write_recording
from station.view.report import write_report
from tests.truth import RIGID_AXIS, SERVO, SFLR, TWO_MASS, Case, effect_names, make_case
from tests.truth.cases import multisine_test, step_test, sweep_test

SEVERITY = (400.0, 1e5)
TABLES = {"axis": RIGID_AXIS, "two-mass": TWO_MASS,
          "no-accelerometer": {key: value for key, value in SFLR.items() if key != "accelerometer"}}
HIDDEN = [("axis", 8001, "coulomb_friction", "motor"),
          pytest.param("axis", 8002, "dead_zone", "amplifier", marks=pytest.mark.long),
          ("two-mass", 8012, "gain_asymmetry", "amplifier"),
          pytest.param("no-accelerometer", 8000, "coulomb_friction", "motor", marks=pytest.mark.long)]


@cache
def case(shape: str, seed: int, *effects: tuple[str, str]) -> Case:
    """Four runs of a hidden rig."""
    return make_case(seed, list(effects), nominal=TABLES[shape], count=4, band=SEVERITY)


@cache
def found(shape: str, seed: int, *effects: tuple[str, str]) -> DiagnosisResult:
    """What is said of them."""
    return diagnose(Rig.model_validate(TABLES[shape]), case(shape, seed, *effects).runs, effort="quick")


@pytest.mark.parametrize(("shape", "seed", "name", "at"), HIDDEN)
def test_a_hidden_effect_is_named(shape, seed, name, at):
    result = found(shape, seed, (name, at))
    first = result.diagnosis.causes[0]
    assert (first.effect, first.at) == (name, at) and result.diagnosis.verdict == "explained"
    gain = result.diagnosis.gain
    assert gain.accel is None and gain.encoder.nrmse_after < 0.7 * gain.encoder.nrmse_before
    assert gain.explained_fraction > 0.8
    picture = result.evidence[0]
    assert picture.title.endswith(effect_class(name).title) and picture.law_y is not None
    assert Rig.from_toml(result.extended_rig.to_toml()).effects == result.extended_rig.effects


def test_a_stiff_drive_that_hardens_is_named_alone():
    """It bends by thousandths of a radian, the arm's soft one by half of one."""
    cubic = 3e5
    spring = {"effect": "hardening_spring", "at": "drive", "cubic": cubic}
    hidden = make_case(8028, [spring], nominal=TWO_MASS, band=None, count=4)
    diagnosis = diagnose(Rig.model_validate(TWO_MASS), hidden.runs, effort="quick").diagnosis
    assert [(cause.effect, cause.at) for cause in diagnosis.causes] == [("hardening_spring", "drive")]
    assert diagnosis.verdict == "explained"
    assert diagnosis.causes[0].parameters["cubic"].value == pytest.approx(cubic, rel=0.3)


@pytest.mark.long
@pytest.mark.parametrize("seed", [8030, 8034])
def test_a_bias_of_a_twentieth_of_a_count_is_named_beside_sticking_friction(seed):
    """Friction of one level leads at first; what errors count for is read off again once two levels do."""
    friction = {"effect": "stribeck_friction", "at": "motor", "static_torque": 0.019, "coulomb_torque": 0.012,
                "stribeck_velocity": 0.52}
    bias = {"effect": "command_bias", "at": "amplifier", "offset": -0.05}
    hidden = make_case(seed, [friction, bias], nominal=RIGID_AXIS, band=None, count=6)
    diagnosis = diagnose(Rig.model_validate(RIGID_AXIS), hidden.runs, effort="quick").diagnosis
    assert [cause.effect for cause in diagnosis.causes] == ["stribeck_friction", "command_bias"]
    assert diagnosis.verdict == "explained"
    offset = diagnosis.causes[1].parameters["offset"]
    assert offset.low < -0.05 < offset.high


@pytest.mark.long
def test_a_clean_two_mass_rig_is_not_accused_of_what_an_observers_gains_do_with_the_sensors_noise():
    """Its errors by the quick horizon are smaller with a gap in the drive: the gap's gains feed less noise back."""
    case = make_case(1010416, [], nominal=TWO_MASS, count=None)
    assert not diagnose(Rig.model_validate(TWO_MASS), case.runs, effort="full").diagnosis.causes


@pytest.mark.parametrize(("shape", "seed"), [("axis", 8005), ("two-mass", 8010)])
def test_a_clean_rig_is_not_accused(shape, seed):
    result = found(shape, seed)
    assert result.diagnosis.verdict == "nothing_missing" and not result.diagnosis.causes
    assert {picture.kind for picture in result.evidence} >= {"time", "speed", "angle", "command", "spectrum"}


@pytest.mark.parametrize(("seed", "hidden"), [
    (8040, []), pytest.param(8042, [("load_friction", "motor")], marks=pytest.mark.long)])
def test_a_pendulum_that_does_not_hang_at_the_encoders_zero_is_not_accused(seed, hidden):
    """Counts from where a run found it: by up to 0.03 rad they err about where its rig file says that it hangs."""
    made, rig = make_case(seed, hidden, nominal=SERVO, count=4, band=SEVERITY).runs, Rig.model_validate(SERVO)
    runs = [replace(run, encoder=run.encoder + count, reference=run.reference + (0.0 if run.open_loop else count),
                    metadata=run.metadata.model_copy(update={"zero_id": None}))
            for run, count in zip(made, (13.0, -17.0, 22.0, -8.0), strict=True)]
    result = diagnose(rig, runs, effort="quick")
    assert [(cause.effect, cause.at) for cause in result.diagnosis.causes] == hidden
    assert result.diagnosis.verdict == ("explained" if hidden else "nothing_missing")
    for row, run in zip(result.comparisons, made, strict=True):     # known to two counts, and drawn from there
        zeroed = row.zeroed(rig.angle_per_count)
        np.testing.assert_allclose(zeroed.encoder, run.encoder, atol=2.0)
        np.testing.assert_allclose(zeroed.reference, run.reference, atol=0.0 if run.open_loop else 2.0)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "back_emf", "hidden"), [
    (66009, 0.0, ["load_friction", ("coulomb_friction", "motor")]), (66012, 0.3, ["load_friction"])])
def test_friction_by_load_keeps_its_value_where_bearings_rub_and_no_rig_file_says_so(seed, back_emf, hidden):
    """What rubs in the bearings the gears carry, back-EMF they do not; taken for all of it another fraction comes out,
    or friction alone is not met at all."""
    nominal = SERVO | {"motor": SERVO["motor"] | {"back_emf": back_emf}}
    case = make_case(seed, hidden, nominal=nominal, count=5, disturbance=0.02, sized_in_world=True,
                     known_controller=bool(seed % 2))
    result = diagnose(Rig.model_validate(SERVO), case.runs, effort="quick")
    causes = {(cause.effect, cause.at): cause for cause in result.diagnosis.causes}
    assert set(causes) == {(cause["effect"], cause["at"]) for cause in case.truth["causes"]}
    fraction = causes["load_friction", "motor"].parameters["fraction"]
    assert fraction.low < case.truth["causes"][0]["fraction"] < fraction.high
    assert Rig.from_toml(result.extended_rig.to_toml()).motor.back_emf == result.extended_rig.motor.back_emf
    [note] = [note for note in result.notes if "back-EMF" in note]
    share, low, high = (0.01 * float(percent) for percent in re.findall(r"\d+", note))
    assert low - 0.01 <= back_emf <= high + 0.01 and abs(share - result.extended_rig.motor.back_emf) < 0.05


def test_friction_and_a_bias_that_all_runs_share_are_named_under_a_cascade():
    """Every run may have a bias of its own, which explains as much: four that are the same are one cause."""
    loop = "cascade"
    tests = [multisine_test(500.0, 120.0, 5, controller=loop), multisine_test(500.0, 80.0, 7, controller=loop),
             sweep_test(500.0, 90.0, 0.2, 3.0, 6.0, loop), step_test(500.0, loop, 150.0)]
    bias = {"effect": "command_bias", "at": "amplifier", "offset": 1.5}
    friction = {"effect": "coulomb_friction", "at": "motor", "torque": 0.08}
    hidden = make_case(8023, [friction, bias], tests=tests, nominal=RIGID_AXIS, band=None)
    diagnosis = diagnose(Rig.model_validate(RIGID_AXIS), hidden.runs, effort="quick").diagnosis
    named = {cause.effect: cause for cause in diagnosis.causes}
    assert set(named) == {"coulomb_friction", "command_bias"} and diagnosis.verdict == "explained"
    assert named["command_bias"].parameters["offset"].value == pytest.approx(1.5, rel=0.02)
    torque = named["coulomb_friction"].parameters["torque"]
    assert torque.low < 0.08 < torque.high
    assert diagnosis.between_runs.constant is None


def test_late_command_and_late_encoder_are_the_same_on_an_axis_with_an_encoder_alone():
    """No other sensor tells on which side of the rig the delay is; a lag that short does nearly the same."""
    diagnosis = found("axis", 8003, ("input_delay", "amplifier")).diagnosis
    first = diagnosis.causes[0]
    said = {(first.effect, first.at), *((rival.effect, rival.at) for rival in first.rivals)}
    assert diagnosis.verdict == "ambiguous" and len(diagnosis.causes) == 1
    assert {("input_delay", "amplifier"), ("encoder_delay", "encoder")} <= said
    assert all(rival.probability > 0.2 for rival in first.rivals[:1]) and diagnosis.next_experiment is not None


def test_report_and_recording_of_a_rig_with_an_encoder_alone(tmp_path):
    for name, result in (("named", found("axis", 8001, ("coulomb_friction", "motor"))), ("clean", found("axis", 8005))):
        write_report(result, tmp_path / f"{name}.html")
        page = (tmp_path / f"{name}.html").read_text(encoding="utf-8")
        assert "<html" in page and "cceleration" not in page
        write_recording(tmp_path / f"{name}.rrd", result.comparisons, result.rig)
        assert (tmp_path / f"{name}.rrd").stat().st_size > 10_000


@pytest.mark.parametrize("shape", TABLES)
def test_candidates_are_what_the_rig_can_have(shape):
    """Without a drive motor and base are one part: one place for what may stand at either."""
    rig = Rig.model_validate(TABLES[shape])
    keys = {candidate.key for candidate in candidates(rig)}
    twice = {("coulomb_friction", "base")} if rig.drive is None else set()
    assert {key for key in keys if key[1]} == set(effect_names(TABLES[shape])) - twice
    assert {key[0] for key in keys if not key[1]} == {f"parameter:{path}" for path in rig.constants()}


@pytest.mark.parametrize(("shape", "places"), [("axis", {"motor", "base"}), ("two-mass", {"motor", "base", "drive"}),
                                               ("no-accelerometer", {"motor", "base", "drive", "clamp", "tip"})])
def test_torque_missing_where_the_rig_has_a_place_for_it(shape, places):
    """A friction that nobody assumed shows at the motor with its own size and sign; other places are refused."""
    hidden = case("axis", 8001, ("coulomb_friction", "motor")) if shape == "axis" else case(shape, 8010)
    rig = Rig.model_validate(hidden.truth["constants"])
    for at in ("motor", "base", "drive", "clamp", "tip"):
        if at not in places:
            with pytest.raises(UsageError, match="no such place"):
                missing_torque(rig, hidden.runs[0], at)
            continue
        estimate = missing_torque(rig, hidden.runs[0], at)
        assert np.all(np.isfinite(estimate.torque)) and np.all(estimate.sigma >= 0.0)
    if shape == "axis":
        torque = hidden.truth["causes"][0]["torque"]
        estimate = missing_torque(rig, hidden.runs[0])
        moving = np.abs(estimate.speed) > 0.3 * np.abs(estimate.speed).max()
        against = -np.sign(estimate.speed[moving]) * estimate.torque[moving]
        assert np.median(against) == pytest.approx(torque, rel=0.2)

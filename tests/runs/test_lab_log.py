"""The laboratory's logs: parsed by name, their compensators recognised, never evaluated."""

import numpy as np
import pytest

from station.control.compensators import tustin_lead
from station.errors import WorkError
from station.runs import export_run, load_run
from station.runs.lab_log import Polynomial, guess_test, lead_of_tustin
from tests.measured import LOGS, measured_log
from tests.runs.examples import assert_same

NAMES = "#t\tn\tu\tv\t$\\theta$\ta\n"


def made(tmp_path, header: str = "#kp=2.0\n", rows: int = 20, names: str = NAMES, encoder=lambda row: 0):
    path = tmp_path / "made.txt"
    body = "".join(f"{row / 500}\t{row}\t0\t{0 - 2 * encoder(row - 1)}\t{encoder(row)}\t1\n" for row in range(rows))
    path.write_text("#SLFR RTP Test\n" + header + names + body)
    return path


EXPECTED = {
    "pulse": (1000, {"kind": "open"}, ("pulse", 100.0, 0.04), True),
    "p": (1000, {"kind": "p", "gain": 2.0}, ("step", 50.0, 0.1), True),
    "lead": (1000, {"kind": "lead", "gain": 20.0, "zero": 10 * np.pi, "pole": 40 * np.pi},
             ("step", 100.0, 0.02), False),
    "lead_accel": (1000, {
        "kind": "lead_accel", "gain": 20.0, "zero": 10 * np.pi, "pole": 40 * np.pi,
        "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
        "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]}, ("step", 200.0, 0.02), False),
    "sweep": (11000, {"kind": "p", "gain": 1.0}, ("sweep", 50.0, 1.058), True),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_measured_log_has_its_shape_controller_test_and_start(name):
    rows, controller, (kind, amplitude, start), rounding = EXPECTED[name]
    run = load_run(measured_log(name))
    metadata = run.metadata
    assert run.name == LOGS[name].removesuffix(".txt")
    assert (len(run), run.sample_rate, run.lost_samples) == (rows, 500.0, 0)
    assert metadata.controller == controller
    assert metadata.test == {"kind": kind, "amplitude": amplitude, "start": start}
    assert (metadata.command_row, metadata.start, metadata.zero_id, metadata.rig) == (-1, "equilibrium", None, "sflr")
    assert metadata.rounding is rounding
    assert list(run.extra) == (["reference_shaped"] if name.startswith("lead") else [])


def test_the_logged_accelerometer_keeps_the_fraction_it_was_logged_with():
    run = load_run(measured_log("lead_accel"))
    np.testing.assert_allclose(np.mod(run.accel, 1.0), 0.04, atol=1e-9)


@pytest.mark.parametrize("form", [".mcap", ".csv", ".parquet", ".mat"])
def test_a_measured_log_goes_through_every_form_unchanged(form, tmp_path):
    run = load_run(measured_log("lead_accel"))
    export_run(run, tmp_path / f"a{form}")
    assert_same(run, load_run(tmp_path / f"a{form}"))


def test_a_log_that_moves_at_once_starts_released(tmp_path):
    assert load_run(made(tmp_path, encoder=lambda row: 0)).metadata.start == "equilibrium"
    assert load_run(made(tmp_path, encoder=lambda row: max(row, 0))).metadata.start == "released"


@pytest.mark.parametrize(("header", "words"), [
    ("#kp=__import__('os').system('true')\n", "is not a number"),
    ("#kp=nan\n", "'nan' is not a number"),
    ("#Gth num=[ 1.0 x ]\n#Gth den=[ 1.0 0.5]\n", "'x' is not a number"),
    ("#Gth num=[ 1.0 2.0 3.0]\n#Gth den=[ 1.0 0.5]\n", "Gth must be a lead"),
    ("#Gth num=[ 1.0 2.0]\n", "Gth must be a lead"),
    ("#Gth num=[ 1.0 1.0]\n#Gth den=[ 1.0 0.5]\n", "not a lead sampled by Tustin"),
    ("#Gth num=[ 18.3 -17.2]\n#Gth den=[ 1.0 -0.7]\n#Ga num=[ 1.0]\n#Ga den=[]\n", "only one of num and den"),
])
def test_a_header_that_is_no_known_compensator_is_refused_in_one_line(header, words, tmp_path):
    with pytest.raises(WorkError, match=words) as caught:
        load_run(made(tmp_path, header))
    assert str(caught.value).startswith(str(tmp_path / "made.txt")) and "\n" not in str(caught.value)


@pytest.mark.parametrize("header", ["", "#kp=2.0\n#ki=1.0\n", "#kp=2.0\n#kd=0.1\n"])
def test_a_log_whose_compensator_is_not_told_or_not_how_it_is_sampled_has_an_unknown_one(header, tmp_path):
    run = load_run(made(tmp_path, header, encoder=lambda row: row))
    assert run.metadata.controller == {"kind": "unknown"} and not np.array_equal(run.command, run.reference)


def test_unknown_and_missing_columns_are_named(tmp_path):
    with pytest.raises(WorkError, match="'t n u v x a' are not those of a laboratory log"):
        load_run(made(tmp_path, names="#t\tn\tu\tv\tx\ta\n"))


def test_a_log_cut_inside_a_row_is_refused_by_line(tmp_path):
    path = made(tmp_path)
    path.write_text(path.read_text()[:-6])
    with pytest.raises(WorkError, match="line 23: [34] fields where 6 are named"):
        load_run(path)


@pytest.mark.parametrize(("gain", "zero", "pole"), [(20.0, 10 * np.pi, 40 * np.pi), (3.5, 12.0, 150.0),
                                                    (7.25, np.pi, 62.5 * np.pi)])
def test_a_printed_tustin_lead_gives_its_round_continuous_form_back(gain, zero, pole):
    num, den = tustin_lead(gain, zero, pole, 500.0)
    found = lead_of_tustin(*(Polynomial(tuple(np.round(part, 8)), 0.5e-8) for part in (num, den)), 500.0)
    assert (found["gain"], found["zero"], found["pole"]) == pytest.approx((gain, zero, pole), rel=1e-14)


def test_a_lead_that_is_not_round_keeps_every_printed_digit():
    num, den = tustin_lead(7.123456, 33.333333, 141.421356, 500.0)
    printed = [np.round(part, 8) for part in (num, den)]
    found = lead_of_tustin(*(Polynomial(tuple(part), 0.5e-8) for part in printed), 500.0)
    again = tustin_lead(found["gain"], found["zero"], found["pole"], 500.0)
    np.testing.assert_allclose(again[0], printed[0], atol=0.5e-8)
    np.testing.assert_allclose(again[1], printed[1], atol=0.5e-8)


@pytest.mark.parametrize(("reference", "test"), [
    (np.zeros(50), {"kind": "rest"}),
    (np.repeat([0, 30], 25), {"kind": "step", "amplitude": 30.0, "start": 0.05}),
    (np.repeat([5, 25, 5, -15, 5], 10), {"kind": "pulse", "amplitude": 20.0, "start": 0.02}),
    (np.round(40 * np.sin(np.arange(300.0) ** 2 / 900)), {"kind": "sweep", "amplitude": 40.0, "start": 0.008}),
])
def test_the_kind_of_test_is_told_from_the_reference(reference, test):
    found = guess_test(np.asarray(reference, dtype=float), 500.0)
    assert found["kind"] == test["kind"]
    assert found.get("amplitude") == pytest.approx(test.get("amplitude"))
    if test["kind"] in ("step", "pulse"):
        assert found["start"] == pytest.approx(test["start"])

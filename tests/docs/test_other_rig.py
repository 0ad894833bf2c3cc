"""What docs/other_rig.md says of logs, controllers and encoders is what the code does."""

import json
import re

import numpy as np
import pytest
from scipy.linalg import expm

from station.control import compensators
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.columns import COLUMNS, LOG_COLUMNS, REQUIRED
from station.runs.run import Run, RunMetadata
from station.runs.ticks import STAMPS
from tests.docs.pages import ROOT, blocks

PAGE = ROOT / "docs" / "other_rig.md"
TEXT = PAGE.read_text(encoding="utf-8")


def table(heading: str) -> list[list[str]]:
    """The rows of the table below a line of headings, cell by cell."""
    rows = TEXT.split(heading + "\n", 1)[1].splitlines()[1:]
    end = next(i for i, row in enumerate(rows) if not row.startswith("|"))
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[:end]]


def test_every_kind_of_controller_stands_there_with_its_keys():
    found = {kind.strip("`"): tuple(re.findall(r"`(\w+)`", keys))
             for kind, keys, _ in table("| kind | keys | command |")}
    assert found == compensators._FIELDS


def test_the_line_that_names_a_controller_names_one_that_there_is():
    lines = re.findall(r"`# controller = (\{[^`]*\})`", TEXT)
    assert len(lines) == 2
    for line in lines:
        compensators.Compensator.from_spec(json.loads(line), 500.0, 200.0)


def test_the_columns_of_a_log_stand_there_and_which_are_wanted():
    found = {name.strip("`"): wanted for name, wanted, _ in table("| column | | |")}
    assert [name for name, wanted in found.items() if wanted] == list(REQUIRED)
    clocks = {"device_time", "host_time"}
    assert set(found) == {column.name for column in COLUMNS} - set(LOG_COLUMNS[6:]) | clocks and f"`{STAMPS}`" in TEXT


def test_a_link_to_the_reference_says_that_the_page_is_made():
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for paragraph in page.read_text(encoding="utf-8").split("\n\n"):
            assert "](reference/" not in paragraph or "scripts/docs" in paragraph, page.name


@pytest.fixture(scope="module")
def motor_side() -> Rig:
    """The rig whose encoder is on the motor and whose load is behind a shaft."""
    return next(Rig.from_toml(text) for text in blocks(PAGE, "toml") if "two_masses" in text)


def test_the_rig_with_its_encoder_on_the_motor_moves_as_two_masses_do(motor_side):
    rig, rows = motor_side, 2000
    load = rig.tip.mass * rig.beam.length**2 + rig.beam.mass_per_length * rig.beam.length**3 / 3.0
    motor, shaft = rig.motor, rig.clamp
    rates = np.zeros((5, 5))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = np.array([-shaft.stiffness, -shaft.damping - motor.damping, shaft.stiffness, shaft.damping,
                         motor.gain]) / motor.inertia
    rates[3, :4] = np.array([shaft.stiffness, shaft.damping, -shaft.stiffness, -shaft.damping]) / load
    step = expm(rates / rig.sample_rate)
    command = np.repeat(np.random.default_rng(1).choice([-200.0, 200.0], rows // 20), 20)
    state, angle = np.zeros(5), np.zeros(rows)
    for row in range(rows):
        angle[row] = state[0]
        state = step @ np.append(state[:4], command[row])
    made = simulate(rig, Run("a", np.arange(rows) / rig.sample_rate, command, command, np.zeros(rows),
                             metadata=RunMetadata(controller={"kind": "open"})), rounding=False)
    counts = angle / rig.angle_per_count
    assert np.abs(made.encoder - counts).max() < 1e-3 * np.ptp(counts)


def test_with_a_drive_the_encoder_is_on_the_load():
    """A motor that is held apart by a soft spring moves long before the encoder does."""
    rig = Rig.from_toml(blocks(PAGE, "toml")[0].split("[[effects]]")[0] + "[drive]\nstiffness = 1e-3\n"
                        "damping = 0.0\n[base]\ninertia = 1.0\n")
    command = np.full(100, 500.0)
    made = simulate(rig, Run("a", np.arange(100) / rig.sample_rate, command, command, np.zeros(100),
                             metadata=RunMetadata(controller={"kind": "open"})), rounding=False)
    assert 0.0 < abs(made.encoder[-1]) < 1.0

"""Rig files: what is written reads back, and may be added to."""

from __future__ import annotations

import pytest

from station.rig import Rig, load_rig
from tests.truth import RIGID_AXIS, TWO_MASS

RIGS = {"sflr": load_rig("sflr"), "axis": Rig.model_validate(RIGID_AXIS), "two-mass": Rig.model_validate(TWO_MASS)}


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_was_written_reads_back_and_takes_effects_at_its_end(name):
    rig = RIGS[name]
    assert Rig.from_toml(rig.to_toml()) == rig
    more = Rig.from_toml(rig.to_toml() + '\n[[effects]]\neffect = "dead_zone"\nwidth = 3.0\n')
    assert [effect.name for effect in more.effects] == ["dead_zone"]
    assert Rig.from_toml(more.to_toml()) == more

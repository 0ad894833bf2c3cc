"""A joint that a rig file calls soft and that is as good as rigid: far from where a fit begins, yet found."""

from __future__ import annotations

import copy

import pytest

from station.diagnose.diagnose import diagnose
from station.rig import Rig
from tests.truth import SFLR, make_case

STIFF = 500.0
"""Times the stiffness that the rig file states, with a fifth as its uncertainty."""


@pytest.mark.long
def test_a_drive_that_hardly_yields_is_told_from_the_soft_one_of_the_rig_file() -> None:
    true = copy.deepcopy(SFLR)
    true["drive"]["stiffness"] *= STIFF
    case = make_case(8200, nominal=true, count=4)
    found = diagnose(Rig.model_validate(SFLR), case.runs, effort="quick").diagnosis
    first = found.causes[0]
    assert first.effect == "parameter:drive.stiffness" and first.stability > 0.99
    assert [c.effect for c in found.causes] == [first.effect]
    ratio = first.parameters["value"].value / true["drive"]["stiffness"]
    assert 0.5 < ratio < 2.0
    assert found.gain.encoder.nrmse_after < 0.2 * found.gain.encoder.nrmse_before

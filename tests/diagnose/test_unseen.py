"""What is shown of runs left out."""

from __future__ import annotations

import pytest

from station.diagnose import unseen
from station.diagnose.diagnose import diagnose
from station.diagnose.measures import nrmse
from station.rig import Rig
from tests.diagnose.blind import RIGS, blind_task, made


@pytest.mark.parametrize("against", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_gain_is_that_of_the_rig_that_is_handed_back(monkeypatch: pytest.MonkeyPatch, against: bool) -> None:
    """Causes that runs left out speak against are not stated, and nothing that is shown holds them."""
    monkeypatch.setattr(unseen, "contradicted", lambda gains, relieved: against)
    case = made(blind_task(1, [("coulomb_friction", "motor")], disturbance=0.02, sized_in_world=True, rig="axis"))
    found = diagnose(Rig.model_validate(RIGS["axis"]), case.runs, effort="quick")
    diagnosis = found.diagnosis
    assert diagnosis.verdict == ("unexplained" if against else "partly_explained")
    assert bool(found.extended_rig.effects) is not against and bool(diagnosis.causes) is not against
    for told, row in zip(diagnosis.gain.runs, found.comparisons, strict=True):
        shown = row.refit if against else row.after
        assert told.encoder is not None and shown is not None and (row.after is None) is against
        error = nrmse(row.run.encoder[row.part], shown.encoder[row.part])
        assert told.encoder.nrmse_after == pytest.approx(error)
        assert set(told.ahead) and all(one.nrmse_after > 0.0 for one in told.ahead.values())
    handed = found.extended_rig.constants()
    assert {path: estimate.value for path, estimate in found.constants.items()} == pytest.approx(handed)

"""Runs that all begin in motion are diagnosed, without pictures, which need a start at rest."""

from __future__ import annotations

import pytest

from station.diagnose.compare import compare
from station.diagnose.diagnose import diagnose
from station.diagnose.thresholds import SHOWN_SHARE
from station.model.effects import effect_class
from tests.estimation.made import AXIS, run_of


def test_friction_is_named_from_runs_none_of_which_begins_at_rest() -> None:
    torque = 0.02 * AXIS.motor.gain * AXIS.amplifier.limit
    rig = AXIS.with_effects([effect_class("coulomb_friction")(at="motor", torque=torque)])
    runs = [run_of(rig, size, "open", f"pulses {size:g}", 3.0).slice(150) for size in (60.0, 90.0, -70.0)]
    found = diagnose(AXIS, runs, effort="quick")
    assert [(c.effect, c.at) for c in found.diagnosis.causes] == [("coulomb_friction", "motor")]
    assert found.evidence == []

    # Over the rows from which it is told how a run begins simulations were corrected: no error counts them.
    again = compare(AXIS, runs).measures
    for row, gain, compared in zip(found.comparisons, found.diagnosis.gain.runs, again, strict=True):
        before, _, after = row.errors("encoder")
        assert gain.encoder is not None and not row.rows[0] and row.rows[-1]
        assert (before, after) == pytest.approx((gain.encoder.nrmse_before, gain.encoder.nrmse_after))
        shown = [w.simulated for w in found.diagnosis.wrong if (w.run, w.measure) == (gain.run, "nrmse")]
        assert shown == ([pytest.approx(before)] if before > SHOWN_SHARE else [])
        assert compared["encoder"]["nrmse"] == pytest.approx(before, rel=0.5) and after < 0.1 * before

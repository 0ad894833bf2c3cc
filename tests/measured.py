"""Measured logs, of the flexible arm (sflr) and of a small servo (xl330): read in place, never part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

LOGS = {
    "pulse": "OL_pulse_test_sys_check_SLFR_RTP_OL_Test_uend=0.txt",
    "p": "SFLR_P_control_step_kp_2_SLFR_RTP_P_control_kp=2.0.txt",
    "lead": "step_response_Gth_comp_no_accel_FB_amp_100_duration_1000_SLFR_RTP_Motor_Comp_Gth.txt",
    "lead_accel": "step_response_Gth_comp_Ga_opt_amp_200_duration_1000_opt_case43_"
                  "SLFR_RTP_Motor_Comp_Gth.txt",
    "sweep": "swept_sine_kp_1_amp_50.txt",
}
SERVO_LOGS = tuple(f"kp{gain}_{goal}.csv" for gain in (100, 400)
                   for goal in ("sin_sin", "sin_time_square", "up_and_down"))


def measured_folder(rig: str = "sflr") -> Path:
    """Where a rig's logs are looked for: in ``STATION_MEASURED``, else in ``shared/data`` beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("STATION_MEASURED", default)) / rig


def measured_log(name: str, rig: str = "sflr") -> Path:
    """The path of one log, by its short name or its file name; skips the test where the logs are absent."""
    path = measured_folder(rig) / LOGS.get(name, name)
    if not path.is_file():
        pytest.skip(f"no measured log at {path}; STATION_MEASURED names the folder that holds {rig}/")
    return path

"""The measured logs of the flexible arm: read in place, never part of the project."""

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


def measured_folder() -> Path:
    """Where the logs are looked for: ``STATION_MEASURED``, else ``shared/data`` beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("STATION_MEASURED", default)) / "sflr"


def measured_log(name: str) -> Path:
    """The path of one log, by its short name or its file name; skips the test where the logs are absent."""
    path = measured_folder() / LOGS.get(name, name)
    if not path.is_file():
        pytest.skip(f"no measured log at {path}; STATION_MEASURED names the folder that holds sflr/")
    return path

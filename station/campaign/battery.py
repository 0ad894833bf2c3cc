"""The tests that Station runs on a rig of its own making; light to import."""

from __future__ import annotations

from typing import Any

TESTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pulse": ("open", {"kind": "pulse", "amplitude": 100.0}),
    "pulse_small": ("open", {"kind": "pulse", "amplitude": 40.0, "width": 0.2}),
    "step_p": ("p", {"kind": "step", "amplitude": 50.0}),
    "step_lead": ("lead", {"kind": "step", "amplitude": 100.0}),
    "sweep": ("p", {"kind": "sweep", "amplitude": 50.0, "f1": 20.0, "duration": 8.0}),
}
"""Controller and test by name of the run."""
NOISE = 0.5
"""Accelerometer, counts, one sigma."""

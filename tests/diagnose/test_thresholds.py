"""The table of thresholds in the docs holds every threshold with the value in force."""

from __future__ import annotations

import re
from pathlib import Path

from station.diagnose import thresholds

PAGE = Path(__file__).parents[2] / "docs" / "method.md"


def test_the_docs_state_every_threshold_with_its_value() -> None:
    stated = {name: float(value) for name, value in
              re.findall(r"^\| `([A-Z_]+)` \| (-?[\d.]+) \|", PAGE.read_text(encoding="utf-8"), re.M)}
    assert stated == {name: float(value) for name, value in vars(thresholds).items() if name.isupper()}

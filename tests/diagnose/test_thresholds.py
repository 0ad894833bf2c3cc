"""The tables of thresholds in the docs hold every threshold of their modules with the value in force."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from station.diagnose import thresholds
from station.estimation import answers

PAGE = Path(__file__).parents[2] / "docs" / "method.md"


@pytest.mark.parametrize(("table", "module"), [(0, thresholds), (1, answers)])
def test_the_docs_state_every_threshold_with_its_value(table, module) -> None:
    texts = PAGE.read_text(encoding="utf-8").split("| name | value | decides |\n")[1:]
    assert len(texts) == 2
    rows = re.findall(r"^\| `([A-Z_]+)` \| (-?[\d.]+) \|", texts[table], re.M)
    assert {name: float(value) for name, value in rows} == {
        name: value for name, value in vars(module).items() if name.isupper() and isinstance(value, (int, float))}
    assert len(rows) == len(dict(rows))

"""Runs for the tests of this folder: made up, and drawn by Hypothesis."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from station.runs.columns import COLUMNS
from station.runs.run import Run, RunMetadata

METADATA = RunMetadata(rig="sflr", controller={"kind": "lead", "gain": 20.0, "zero": 31.4, "pole": 125.7},
                       test={"kind": "step", "amplitude": 100}, zero_id="bench", session=40321, command_row=-1,
                       versions={"station": "0.1"}, firmware={"board": "host"}, note="<b>a</b> = \"ü\"\t'\\")


def full_run(rows: int = 40, rate: float = 500.0, **changes: object) -> Run:
    """A run with every column, an extra one, and NaN where a column may have it."""
    index = np.arange(rows)
    columns = {
        "t": index / rate, "reference": np.where(index < 10, 0.0, 100.0), "command": 200.0 * np.sin(index / 7.0),
        "encoder": np.round(30.0 * np.cos(index / 9.0)), "accel": np.round(9.0 * np.sin(index)) + 0.04,
        "n": index + 70000, "device_time": index / rate + 1e-7, "host_time": 1e6 + index / rate,
        "status": index % 4, "command_sent": np.where(index % 5, index / 3.0, np.nan),
        "latency": 1e-4 + index * 1e-9, "slack": np.where(index % 7, 1e-3, np.nan),
    }
    return Run(name="full", metadata=METADATA, extra={"reference_shaped": index / 7.0}, **(columns | changes))


def assert_same(one: Run, two: Run) -> None:
    """Every column bit by bit, in the same kind of number, and all metadata."""
    assert one.columns().keys() == two.columns().keys()
    for name, values in one.columns().items():
        other = two.columns()[name]
        assert values.dtype == other.dtype, name
        np.testing.assert_array_equal(values.view(np.int64), other.view(np.int64), err_msg=name)
    assert one.metadata == two.metadata


_finite = st.floats(allow_nan=False, allow_infinity=False)
_json = st.recursive(st.none() | st.booleans() | st.integers(-2**53, 2**53) | _finite | st.text(max_size=8),
                     lambda inner: (st.lists(inner, max_size=3)
                                    | st.dictionaries(st.text(max_size=5), inner, max_size=3)),
                     max_leaves=6)


@st.composite
def runs(draw: st.DrawFn) -> Run:
    """Any run: few rows, columns left out, extreme numbers, odd metadata."""
    rows = draw(st.integers(2, 6))
    rate = draw(st.sampled_from([50.0, 500.0, 999.0, 1000.0 / 3.0]))
    columns = {"t": np.arange(rows) / rate}
    for column in COLUMNS[1:]:
        if column.name == "n":
            values = np.cumsum(np.ones(rows, dtype=np.int64)) + draw(st.integers(-2**40, 2**40))
        elif column.integer:
            values = draw(hnp.arrays(np.int64, rows, elements=st.integers(-2**53, 2**53)))
        else:
            kinds = _finite | st.just(np.nan) if column.gaps else _finite
            values = draw(hnp.arrays(np.float64, rows, elements=kinds))
        if column.required or draw(st.booleans()):
            columns[column.name] = values
    extra = draw(st.dictionaries(st.from_regex(r"x[a-z0-9_]{0,30}", fullmatch=True),
                                 hnp.arrays(np.float64, rows, elements=_finite), max_size=2))
    metadata = RunMetadata(
        test=draw(st.dictionaries(st.text(max_size=6), _json, max_size=3)),
        zero_id=draw(st.none() | st.text(max_size=6)), command_row=draw(st.integers(-8, 0)),
        start=draw(st.sampled_from(["released", "equilibrium"])), rounding=draw(st.booleans()),
        **draw(st.dictionaries(st.from_regex(r"x[a-z_]{1,6}", fullmatch=True), _json, max_size=2)))
    return Run(name="drawn", metadata=metadata, extra=extra, **columns)

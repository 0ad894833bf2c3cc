"""An encoder's counter that rolls over is found, and nothing else is taken for one."""

import numpy as np
import pytest

from station.diagnose.compare import compare
from station.errors import WorkError
from station.rig import Rig
from station.runs import export_run, import_run
from station.runs.rollover import rollover, rollover_fault
from station.runs.run import Run, RunMetadata

T = np.arange(1500) / 500.0
RIG = Rig.from_toml("""name = "axis"
sample_rate = 500.0
[amplifier]
limit = 200.0
[motor]
inertia = 0.001
damping = 0.01
gain = 0.001
[encoder]
counts_per_revolution = 3000
""")


def motion(size):
    """A smooth way to and fro of so many counts, at rest for its first rows."""
    moving = np.maximum(T - 0.1, 0.0)
    return np.round(size * np.sin(2.0 * moving) * np.minimum(moving, 1.0))


def run_of(encoder):
    return Run("turned", T, 0.0 * T, 0.0 * T, encoder)


@pytest.mark.parametrize("counter", [2**8, 2**12, 2**16, 2**24, 2**32, 3000])
@pytest.mark.parametrize("first", [0, 1, -1])
@pytest.mark.parametrize("signed", [False, True])
def test_a_counter_that_rolls_over_is_found_at_its_first_row(counter, first, signed):
    whole = motion(0.7 * counter if counter < 2**20 else 5e5) + first
    low = counter // 2 if signed else 0
    whole += counter // 2 - 3 if signed else 0
    wrapped = np.mod(whole + low, counter) - low
    at = int(np.argmax(np.abs(np.diff(wrapped)) > counter / 2)) + 1
    assert rollover(wrapped, 3000.0) == (at, counter)
    assert f"period={counter})" in rollover_fault(wrapped, (at, counter), "row 1")
    np.testing.assert_array_equal(np.unwrap(wrapped, period=counter) - wrapped[0], whole - whole[0])
    assert rollover(whole, 3000.0) is None or counter == 2**8


GLITCHES = {
    "one wrong reading": lambda angle: np.where(np.arange(len(angle)) == 700, angle + 65000.0, angle),
    "a step that stays": lambda angle: angle + 250.0 * (np.arange(len(angle)) >= 700),
    "a step from rest within eight bits": lambda angle: 250.0 * (np.arange(len(angle)) >= 700),
    "a slow log of a step": lambda angle: np.array([0.0, 0, 0, 250, 252, 250, 250, 250]),
    "noise": lambda angle: np.random.default_rng(1).integers(-120, 120, len(angle)).astype(float),
    "fast": lambda angle: 900.0 * np.arange(len(angle)),
    "rest": lambda angle: 0.0 * angle,
}


@pytest.mark.parametrize("case", GLITCHES)
def test_what_is_no_counter_that_rolls_over_is_let_pass(case):
    assert rollover(GLITCHES[case](motion(100.0)), 3000.0) is None


def test_a_run_whose_counter_rolls_over_is_refused_where_it_meets_its_rig():
    with pytest.raises(WorkError, match=r"^turned: column encoder, row \d+: \d+ after \d+, a counter of 3000 that "
                                        r"rolls over; unwrap it, as by numpy.unwrap\(encoder, period=3000\)$"):
        compare(RIG, [run_of(np.mod(motion(2000.0), 3000.0))])


def test_an_import_names_the_line_and_writes_nothing(tmp_path):
    wrapped = np.mod(motion(5000.0) - 40.0, 65536.0)
    rows = "".join(f"{t:.3f},0,0,{reading:.0f}\n" for t, reading in zip(T, wrapped, strict=True))
    (tmp_path / "a.csv").write_text("t,reference,command,encoder\n" + rows)
    line = int(np.argmax(np.abs(np.diff(wrapped)) > 30000)) + 3
    with pytest.raises(WorkError, match=rf"a.csv: column encoder, line {line}: .* a counter of 65536 that rolls over"):
        import_run(tmp_path / "a.csv", tmp_path / "b.mcap")
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.parametrize("named", [True, False])
def test_a_counter_of_one_turn_is_refused_by_the_import_that_knows_the_rig(tmp_path, named):
    wrapped = np.mod(motion(2000.0), 3000)
    tables = RIG.model_dump(exclude_none=True)
    run = Run("turned", T, 0.0 * T, 0.0 * T, wrapped, metadata=RunMetadata(**({} if named else {"rig": tables})))
    export_run(run, tmp_path / "a.csv")
    with pytest.raises(WorkError, match=r"a.csv: column encoder, line \d+: .* a counter of 3000 that rolls over"):
        import_run(tmp_path / "a.csv", tmp_path / "b.mcap", **({"rig": tables} if named else {}))
    assert not (tmp_path / "b.mcap").exists()

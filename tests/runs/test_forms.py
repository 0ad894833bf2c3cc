"""Every file form: what goes in comes out, and bad input is refused in one line."""

import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import given, settings

from station.errors import StationError, UsageError, WorkError
from station.runs import export_run, import_run, list_runs, load_run, table
from station.runs.store import WRITERS
from tests.runs.examples import assert_same, full_run, runs

FORMS = (".mcap", ".csv", ".parquet", ".mat")


@pytest.mark.parametrize("form", FORMS)
def test_a_round_trip_loses_nothing(form, tmp_path):
    run = full_run(3000)
    export_run(run, tmp_path / f"full{form}")
    again = load_run(tmp_path / f"full{form}")
    assert again.name == "full"
    assert_same(run, again)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=25, deadline=None)
@given(run=runs())
def test_a_round_trip_of_any_run_loses_nothing(form, tmp_path_factory, run):
    path = tmp_path_factory.mktemp("any") / f"drawn{form}"
    export_run(run, path)
    assert_same(run, load_run(path))


def test_a_run_goes_through_every_form_in_turn_unchanged(tmp_path):
    run = full_run(100)
    export_run(run, tmp_path / "full.csv")
    for before, after in zip(FORMS[1:] + FORMS[:1], FORMS[2:] + FORMS[:2], strict=True):
        import_run(tmp_path / f"full{before}", tmp_path / f"full{after}", overwrite=True)
    assert_same(run, load_run(tmp_path / "full.csv"))


def test_import_adds_what_the_source_does_not_hold(tmp_path):
    (tmp_path / "a.csv").write_text("t,reference,command,encoder\n0,0,0,0\n0.002,1,1,0\n")
    run = import_run(tmp_path / "a.csv", tmp_path / "b.mcap", rig="sflr", zero_id="bench", start=None)
    assert run.metadata.rig == "sflr" and run.metadata.zero_id == "bench" and run.metadata.start == "released"
    assert_same(run, load_run(tmp_path / "b.mcap"))
    with pytest.raises(WorkError, match="a.csv: metadata command_row"):
        import_run(tmp_path / "a.csv", tmp_path / "c.mcap", command_row=3)
    assert not (tmp_path / "c.mcap").exists()


def test_the_csv_form_of_the_contract_is_read(tmp_path):
    path = tmp_path / "step.csv"
    path.write_text('# rig = "sflr"\n# controller = {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}\n'
                    '# test = {"kind": "step", "amplitude": 100}\n# zero_id = "bench"\n'
                    "t,reference,command,encoder,accel\n0,0,0,0,1\n0.002,100,200,0,-1\n0.004,100,200,1,0\n")
    run = load_run(path)
    assert (run.name, run.sample_rate, run.metadata.zero_id) == ("step", 500.0, "bench")
    assert run.metadata.controller["pole"] == 125.6637 and run.metadata.command_row == 0
    np.testing.assert_array_equal(run.accel, [1, -1, 0])


def test_line_endings_and_a_byte_order_mark_make_no_difference(tmp_path):
    text = '# rig = "sflr"\nt,reference,command,encoder\n0,0,0,0\n0.002,1,1,0\n'
    (tmp_path / "a.csv").write_bytes(text.encode())
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert_same(load_run(tmp_path / "a.csv"), load_run(tmp_path / "b.csv"))


HEAD = "t,reference,command,encoder,accel\n0,0,0,0,0\n"
BAD_TEXT = {
    "empty": ("", "the file is empty"),
    "no rows": ("t,reference,command,encoder\n", "0 rows"),
    "no encoder": ("t,reference,command\n0,0,0\n0.002,0,0\n", "column encoder is missing"),
    "no header": ("0,0,0,0\n0.002,0,0,0\n", "the column '[^']*' stands twice"),
    "repeated column": ("t,t,reference,command,encoder\n0,0,0,0,0\n1,1,1,1,1\n", "stands twice"),
    "a word": (HEAD + "0.002,0,zero,0,0\n0.004,0,0,0,0\n", "line 3: 'zero' is not a number, in column 'command'"),
    "an underscore": (HEAD + "0.002,0,1_0,0,0\n", "line 3: '1_0' is not a number"),
    "an empty field": (HEAD + "0.002,0,,0,0\n", "line 3: '' is not a number, in column 'command'; leave"),
    "cut short": (HEAD + "0.002,0,0,0,0\n0.004,0,0", "line 4: 3 fields where 5 are named; leave out"),
    "one field too many": (HEAD + "0.002,0,0,0,0,0\n", "line 3: 6 fields where 5"),
    "an empty line": (HEAD + "\n0.002,0,0,0,0\n", "line 3 is empty"),
    "nan": (HEAD + "0.002,0,0,nan,0\n", "column encoder, line 3: nan where a finite number is wanted; leave out"),
    "irregular": (HEAD + "0.002,0,0,0,0\n0.009,0,0,0,0\n0.011,0,0,0,0\n", "column t, line 4: irregular time"),
    "a long line": (HEAD + "0.002,0,0,0," + "0" * 9000 + "\n", "line 3 is longer than 8192"),
    "a long first line": ("x" * 9000 + "\n", "line 1 is longer than 8192"),
    "a huge header": ("# note = \"" + "x" * (1 << 20) + '"\n' + HEAD, "line 1: note: .* bytes|header is longer"),
    "no json": ("# rig = sflr\n" + HEAD, "line 1: rig: not JSON"),
    "nan in json": ("# controller = {\"gain\": NaN}\n" + HEAD, "line 1: controller: not JSON"),
    "no key": ("# by hand\n" + HEAD, "line 1: a header line reads .# key = JSON., not .by hand.; keep a remark as"),
    "key twice": ('# rig = "a"\n# rig = "b"\n' + HEAD, "line 2: the key rig stands twice"),
    "wrong type": ("# command_row = \"late\"\n" + HEAD, "metadata command_row"),
    "code": ("# rig = __import__('os').getcwd()\n" + HEAD, "line 1: rig: not JSON"),
    "latin": ("# rig = \"\xe9\"\n" + HEAD, None),
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_a_bad_csv_is_refused_in_one_line_that_names_file_and_place(case, tmp_path):
    text, words = BAD_TEXT[case]
    path = tmp_path / "bad.csv"
    path.write_bytes(text.encode("utf-8" if words else "latin-1"))
    with pytest.raises(WorkError, match=words or "not UTF-8 text; save it as CSV in UTF-8") as caught:
        load_run(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and len(message) < 400


def test_too_many_rows_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "MAX_ROWS", 50)
    (tmp_path / "long.csv").write_text("t,reference,command,encoder\n" + "".join(
        f"{row / 500},0,0,0\n" for row in range(60)))
    with pytest.raises(WorkError, match="long.csv: more than 50 rows"):
        load_run(tmp_path / "long.csv")


def test_missing_files_folders_and_unknown_endings_are_named(tmp_path):
    with pytest.raises(WorkError, match="no such file"):
        load_run(tmp_path / "none.mcap")
    with pytest.raises(WorkError, match="not a file"):
        load_run(tmp_path)
    with pytest.raises(WorkError, match="no such file"):
        load_run("nul\0byte.csv")
    with pytest.raises(UsageError, match=r"'\.xls'"):
        export_run(full_run(), tmp_path / "a.xls")
    with pytest.raises(WorkError, match="does not exist"):
        export_run(full_run(), tmp_path / "none" / "a.csv")


@pytest.mark.parametrize("form", WRITERS)
def test_an_existing_file_is_never_replaced_unasked(form, tmp_path):
    path = tmp_path / f"kept{form}"
    path.write_bytes(b"kept")
    with pytest.raises(WorkError, match="exists already"):
        export_run(full_run(), path)
    assert path.read_bytes() == b"kept"
    export_run(full_run(), path, overwrite=True)
    assert path.stat().st_size > 100
    assert {found.suffix for found in tmp_path.iterdir()} <= {form, ".rbl"}


def test_a_failed_export_leaves_nothing_behind(tmp_path):
    run = full_run()
    run.metadata.model_extra["odd key"] = 1
    try:
        with pytest.raises(WorkError, match="'odd key' cannot stand in a CSV header"):
            export_run(run, tmp_path / "a.csv")
    finally:
        del run.metadata.model_extra["odd key"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "head", "words"), [
    ("a.mcap", b"\x89MCAP0\r\n", "no rows"), ("b.mcap", b"hello", "not an MCAP file"),
    ("c.parquet", b"PAR1" + b"\0" * 50, "not a readable Parquet file"), ("d.parquet", b"hello", "Parquet"),
    ("e.mat", b"MATLAB 5.0 MAT-file" + b"\0" * 40, "not a readable MATLAB"), ("f.mat", b"hello", "MATLAB"),
    ("g.mat", b"\x89HDF\r\n\x1a\n", "save it with -v7"),
    ("i.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n",
     r"an HDF5 file \(MATLAB v7.3\); save it with -v7"), ("h.rrd", b"RRF2\0\0", "an export alone"),
])
def test_broken_binary_files_are_refused_in_one_line(name, head, words, tmp_path):
    (tmp_path / name).write_bytes(head)
    with pytest.raises(WorkError, match=words) as caught:
        load_run(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", [".parquet", ".mat"])
def test_a_binary_file_cut_or_flipped_anywhere_raises_work_errors_alone(form, tmp_path):
    run = full_run(12)
    export_run(run, tmp_path / f"a{form}")
    whole = (tmp_path / f"a{form}").read_bytes()
    rng = np.random.default_rng(1)
    path = tmp_path / f"b{form}"
    for _ in range(150):
        data = bytearray(whole)
        if rng.random() < 0.5:
            data = data[:rng.integers(1, len(data))]
        else:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            load_run(path)
        except WorkError as error:
            assert "\n" not in str(error)


def test_parquet_with_text_or_missing_values_is_refused(tmp_path):
    columns = {name: [0.0, 0.002] for name in ("t", "reference", "command", "encoder")}
    for values, words in (([None, 1.0], "column accel: 1 values are missing"), (["a", "b"], "column accel: string")):
        pq.write_table(pa.table({**columns, "accel": values}), tmp_path / "a.parquet")
        with pytest.raises(WorkError, match=words):
            load_run(tmp_path / "a.parquet")


@pytest.mark.parametrize("value", [{"a": 1.0}, np.array([1, "x"], dtype=object), np.zeros((2, 2)), "text"])
def test_mat_with_structs_cells_matrices_or_text_is_refused(value, tmp_path):
    columns = {name: np.array([[0.0], [0.002]]) for name in ("t", "reference", "command", "encoder")}
    scipy.io.savemat(tmp_path / "a.mat", {**columns, "accel": value})
    with pytest.raises(WorkError, match="a.mat: variable 'accel'"):
        load_run(tmp_path / "a.mat")


def test_a_mat_without_the_variables_says_which_are_wanted_and_which_are_there(tmp_path):
    columns = {name: np.zeros((3, 1)) for name in ("t", "reference", "command", "encoder")}
    wanted = "wanted are the variables t, reference, command, encoder, each one column of numbers, found are "
    for values, words in (
            ({"log": columns}, f"'log' is a struct; {wanted}log; save.'run.mat', '-struct', 'log', '-v7'"),
            ({"x": 1.0, "data": np.zeros((3, 4))}, f"not 3x4; {wanted}x, data"),
            ({"t": columns["t"], "u": columns["t"]}, "command is missing; wanted are .*, found are t, u")):
        scipy.io.savemat(tmp_path / "a.mat", values)
        with pytest.raises(WorkError, match=words) as caught:
            load_run(tmp_path / "a.mat")
        assert "\n" not in str(caught.value)


NAMES = [("T", " Reference", "COMMAND ", "Encoder"), ("t", "reference", "Command", "encoder")]


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("form", [".csv", ".parquet", ".mat"])
def test_names_of_columns_are_read_in_any_case_and_with_blanks_around(names, form, tmp_path):
    path = tmp_path / f"a{form}"
    columns = dict(zip(names, np.arange(12.0).reshape(4, 3) / 500, strict=True))
    if form == ".csv":
        path.write_text(",".join(names) + "".join(f"\n{a},{b},{c},{d}" for a, b, c, d in zip(*columns.values(),
                                                                                             strict=True)))
    elif form == ".parquet":
        pq.write_table(pa.table(columns), path)
    else:
        scipy.io.savemat(path, {name.strip(): values for name, values in columns.items()})
    assert list(load_run(path).columns()) == ["t", "reference", "command", "encoder"]


def test_a_name_twice_in_two_cases_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("t,T,reference,command,encoder\n0,0,0,0,0\n1,1,0,0,0\n")
    with pytest.raises(WorkError, match="the column 't' stands twice"):
        load_run(tmp_path / "a.csv")


def test_a_missing_column_is_named_with_those_found_and_an_example(tmp_path):
    (tmp_path / "a.csv").write_text("t,setpoint,command,angle\n0,0,0,0\n0.002,0,0,0\n")
    with pytest.raises(WorkError, match="column reference is missing; wanted are t, reference, command, encoder, found "
                                        "are t, setpoint, command, angle; a CSV's header line reads "
                                        "t,reference,command,encoder; where no loop was closed, the metadata"):
        load_run(tmp_path / "a.csv")


@pytest.mark.parametrize("form", [".csv", ".parquet", ".mat"])
def test_of_an_open_loop_the_command_is_the_reference(form, tmp_path):
    """The contract: of the kind open, reference = command.  Of a loop that is not told it may be either."""
    path, columns = tmp_path / f"a{form}", {"t": [0.0, 0.002], "command": [0.0, 5.0], "encoder": [0.0, 1.0]}
    for known in ('{"kind": "open"}', '{"kind": "p", "gain": 2.0}', None):
        metadata = "{}" if known is None else f'{{"controller": {known}}}'
        if form == ".csv":
            header = "" if known is None else f"# controller = {known}\n"
            path.write_text(header + "t,command,encoder\n0,0,0\n0.002,5,1\n")
        elif form == ".parquet":
            pq.write_table(pa.table(columns).replace_schema_metadata({"station": metadata}), path)
        else:
            scipy.io.savemat(path, {**{key: np.array([column]).T for key, column in columns.items()},
                                    "metadata": metadata})
        if known and "open" in known:
            np.testing.assert_array_equal(load_run(path).reference, [0.0, 5.0])
        else:
            with pytest.raises(WorkError, match="column reference is missing"):
                load_run(path)


def test_mat_from_other_programs_is_read(tmp_path):
    rows = np.arange(20.0)
    scipy.io.savemat(tmp_path / "a.mat", {"t": rows / 500, "reference": rows, "command": rows,
                                          "encoder": rows.astype(np.int16), "accel": rows.astype(np.float32)})
    run = load_run(tmp_path / "a.mat")
    assert run.encoder.dtype == np.float64 and len(run) == 20 and run.metadata.controller == {"kind": "unknown"}
    assert run.open_loop and not replace(run, command=2.0 * rows).open_loop


def test_a_mat_variable_that_inflates_beyond_a_column_is_refused_early(tmp_path):
    grown = zlib.compressobj(9)
    block = bytes(1 << 20)
    packed = b"".join(grown.compress(block) for _ in range(90)) + grown.flush()
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "a.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    assert (tmp_path / "a.mat").stat().st_size < 1 << 20
    with pytest.raises(WorkError, match="a variable of more than"):
        load_run(tmp_path / "a.mat")


def test_metadata_json_is_plain_text_in_every_form(tmp_path):
    run = full_run()
    export_run(run, tmp_path / "a.csv")
    header = [line for line in (tmp_path / "a.csv").read_text().splitlines() if line.startswith("# ")]
    parsed = {line[2:].split(" = ", 1)[0]: json.loads(line.split(" = ", 1)[1]) for line in header}
    assert parsed == run.metadata.entries()


def test_a_folder_of_runs_is_listed_with_the_reason_for_what_cannot_be_read(tmp_path):
    export_run(full_run(50), tmp_path / "a.mcap")
    export_run(full_run(100), tmp_path / "b.csv")
    (tmp_path / "c.csv").write_text("hello\n")
    (tmp_path / "notes.md").write_text("not a run")
    found = {summary.name: summary for summary in list_runs(tmp_path)}
    assert list(found) == ["a", "b", "c"]
    assert found["a"].rows == 50 and found["a"].problem is None and found["b"].duration == pytest.approx(0.2)
    assert found["a"].metadata.zero_id == "bench"
    assert "c.csv: column" in found["c"].problem
    with pytest.raises(StationError, match="not a folder"):
        list_runs(tmp_path / "none")


def test_what_stands_in_a_mat_beside_a_run_is_left_out_where_it_is_no_column(tmp_path):
    rows = np.arange(20.0)
    columns = {"t": rows / 500, "reference": rows, "command": rows, "encoder": rows, "voltage": rows}
    beside = {"Comment": "a first try", "fs": 500.0, "Setup": {"a": 1.0}, "cell": np.array([1, "x"], dtype=object),
              "gains": np.zeros((2, 2)), "wave": 1j * rows[:3]}
    scipy.io.savemat(tmp_path / "a.mat", columns | beside)
    assert list(load_run(tmp_path / "a.mat").columns()) == list(columns)


def test_complex_columns_of_a_mat_are_refused_without_a_warning(tmp_path, recwarn):
    rows = np.arange(20.0)
    scipy.io.savemat(tmp_path / "a.mat", {"t": rows / 500, "reference": rows, "command": rows, "encoder": rows + 1j})
    with pytest.raises(WorkError, match=r"a.mat: column encoder: complex numbers .*; save real\(encoder\)"):
        load_run(tmp_path / "a.mat")
    assert not recwarn.list


@pytest.mark.parametrize("header", ["", '# controller = {"kind": "p",\t"gain": 2.0}\n', "# a log\tof mine\n"])
@pytest.mark.parametrize("name", ["a.csv", "a.txt"])
def test_a_csv_between_tabs_says_so_whatever_its_header_holds(header, name, tmp_path):
    (tmp_path / name).write_text(header + "t\treference\tcommand\tencoder\n0\t0\t0\t0\n0.002\t0\t0\t0\n")
    with pytest.raises(WorkError, match=f"{name}: columns stand between tabs; a comma is wanted"):
        load_run(tmp_path / name)

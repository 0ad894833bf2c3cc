"""Every marked number of README and docs is what its script makes, within the tolerance stated beside it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from scripts import kept_numbers, thesis
from scripts.kept_numbers import MAKERS, Block

BLOCKS = kept_numbers.blocks()


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.long if MAKERS[name].long else ())
                                  for name, block in BLOCKS.items() if block.compared])
def test_a_block_says_what_is_made_now(name):
    try:
        new = kept_numbers.made(BLOCKS[name])
    except thesis.NoLogs as error:
        pytest.skip(str(error))
    assert kept_numbers.differences(BLOCKS[name], new) == []


def test_everything_that_is_made_stands_in_a_page():
    assert set(MAKERS) == set(BLOCKS)


def test_tables_that_a_script_makes_are_marked():
    """A table of measured results stands between its markers and nowhere else."""
    for page in kept_numbers.pages():
        free = kept_numbers.BLOCK.sub("", page.read_text(encoding="utf-8"))
        assert re.findall(r"^\| (?:mean|thesis, 4 elements|its program|DT-TMM)[ ,|].*", free, re.MULTILINE) == [], page


def block(text: str, how: str = "") -> Block:
    return Block(Path("page.md"), "physics.mesh", how, text)


@pytest.mark.parametrize(("how", "text", "new", "same"), [
    ("", "| 1.234 |", "| 1.235 |", True), ("", "| 1.234 |", "| 1.236 |", False),
    ("within 2 %", "100.0 s", "101.9 s", True), ("within 2 %", "100.0 s", "102.1 s", False),
    ("within 0.3", "| 5.0 |", "| 5.3 |", True), ("within 0.3", "| 5.0 |", "| 5.4 |", False),
    ("within 2 %", "8.9e-06", "9.0e-06", True), ("within 2 %", "8.9e-06", "9.2e-06", False),
    ("within 2 %", "−17 counts", "−17 counts", True), ("within 2 %", "−17 counts", "17 counts", False),
    ("within 50 %", "1 of 2 rigs", "1 of 2 arms", False), ("within 50 %", "> end", "1.9", False),
    ("not compared: the machine's", "5 ms", "7 ms", True)])
def test_a_number_is_compared_within_its_stated_tolerance_and_words_as_they_are(how, text, new, same):
    assert (kept_numbers.differences(block(text, how), new) == []) is same


def test_numbers_are_put_into_the_pages_own_words(monkeypatch):
    monkeypatch.setitem(MAKERS, "physics.mesh", kept_numbers.Maker(lambda: [1.06, -2.0, 3e-4]))
    assert kept_numbers.made(block("L2 is 9.9 m, −7 rad, 0.0001 s long")) == "L2 is 1.1 m, −2 rad, 0.0003 s long"
    with pytest.raises(ValueError, match="holds 2 numbers, 3 are made"):
        kept_numbers.made(block("9.9 m, 7 rad"))


def test_a_block_is_written_where_it_stands_and_nothing_else_is(tmp_path):
    page = tmp_path / "page.md"
    around = "# A 1\n\n<!-- numbers: physics.mesh; within 1 % -->\n\n{}\n\n<!-- /numbers -->\n\nB 1\n"
    page.write_text(around.format("| 1 |"), encoding="utf-8")
    kept_numbers.write(replace(block("| 1 |", "within 1 %"), page=page), "| 2 |")
    assert page.read_text(encoding="utf-8") == around.format("| 2 |")


def test_an_unknown_tolerance_is_refused():
    with pytest.raises(ValueError, match="is no tolerance"):
        kept_numbers.differences(block("1", "about"), "2")


def test_logs_that_are_not_there_are_told_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("STATION_MEASURED", str(tmp_path))
    thesis.log.cache_clear()
    with pytest.raises(thesis.NoLogs, match="STATION_MEASURED names the folder") as caught:
        thesis.log("p")
    assert "\n" not in str(caught.value)

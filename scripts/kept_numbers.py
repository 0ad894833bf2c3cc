"""The marked numbers of README and docs: what makes each, and whether the page still says the same.

    python scripts/numbers [NAME ...] [--check] [--long] [--list]

A block of a page stands between two comments, each on a line of its own:

    <!-- numbers: NAME; within 2 % -->
    ...
    <!-- /numbers -->

Its maker gives the block's whole text, or its numbers in their order in the text; then the words stay the page's.
Tolerances: ``within 2 %`` of the number on the page, ``within 0.3`` in its unit, nothing: one unit of the last digit
printed; ``not compared: WHY`` where a number is that of the machine it was measured on.  Words are always compared.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from scripts import line_rates, measured_rig, plant_figures, rattle, thesis, thesis_model

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^<!-- numbers: (?P<name>[\w.-]+)(?:; (?P<how>[^\n]+?))? -->\n(?P<text>.*?)^<!-- /numbers -->$",
                   re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")
"""A number that stands by itself: not the 2 of L2 nor the 3 of 3rd."""


@dataclass(frozen=True)
class Maker:
    """What makes a block: text or numbers; whether it needs the measured logs, and whether it takes a diagnosis."""

    make: Callable[[], str | Sequence[float]]
    logs: bool = False
    long: bool = False


@cache
def _results(name: str) -> str:
    """A table of README's measured results, as scripts/measured_rig.py prints it."""
    folder = thesis.data_folder()
    if name == "sflr":
        rig, files, table = "sflr", sorted((folder / "sflr").glob("*.txt")), measured_rig.arm_table
    else:
        rig, files, table = str(folder / "xl330" / "rig.toml"), sorted((folder / "xl330").glob("*.csv")), \
            measured_rig.servo_table
    if not files:
        raise thesis.NoLogs(f"no logs in {folder}; STATION_MEASURED names the folder that holds sflr/ and xl330/")
    with tempfile.TemporaryDirectory() as place:
        if name == "xl330-no-controller":
            files = [_without_controller(path, Path(place)) for path in files]
        with contextlib.redirect_stdout(io.StringIO()):
            result, _ = measured_rig.diagnosed(rig, files, None)
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            table(result)
    return said.getvalue().strip()


def _without_controller(path: Path, folder: Path) -> Path:
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    copy = folder / path.name
    copy.write_text("".join(line for line in lines if not line.startswith("# controller")), encoding="utf-8")
    return copy


def _feedback_after() -> list[float]:
    run = thesis.log("p")
    return thesis_model.feedback_after(run.command, run.encoder)


def _own_effect() -> str:
    """What scripts/own_effect.py prints."""
    done = subprocess.run([sys.executable, str(ROOT / "scripts" / "own_effect.py")], capture_output=True, text=True,
                          check=True, cwd=ROOT)
    said = "\n".join(textwrap.fill(line, 119) for line in done.stdout.splitlines())
    return f"```\npython scripts/own_effect.py\n{said}\n```"


RUNS = {"pulse": "pulse, open loop", "p": "P", "lead": "lead", "lead_accel": "lead + accelerometer",
        "sweep": "swept sine, P"}
NEED_LOGS = {"thesis.bode", "thesis.pulse", "thesis.p", "thesis.lead", "thesis.lead_accel", "thesis.settling",
             "thesis.times", "thesis.extended"}
MAKERS = {
    "physics.frequencies": Maker(plant_figures.frequency_table),
    "physics.elements": Maker(plant_figures.meshed_elements),
    "physics.mesh": Maker(plant_figures.mesh_table),
    "physics.transfer": Maker(plant_figures.transfer_table),
    "physics.overhang": Maker(plant_figures.overhang_numbers),
    "physics.lumped": Maker(plant_figures.lumped_numbers),
    "physics.zeros": Maker(plant_figures.zero_and_mode_numbers),
    "physics.phase": Maker(thesis.phase_bands, logs=True),
    **{name: Maker(make, logs=name in NEED_LOGS, long=name == "thesis.extended")
       for name, make in thesis.MAKERS.items()},
    "thesis_model.program": Maker(thesis_model.program_table),
    "thesis_model.elements": Maker(thesis_model.elements_table),
    "thesis_model.ends": Maker(thesis_model.feedback_ends),
    "thesis_model.after": Maker(_feedback_after, logs=True),
    "thesis_model.modes": Maker(thesis_model.feedback_modes),
    "firmware.rates": Maker(line_rates.table),
    "thesis.above": Maker(lambda: rattle.shares({words: thesis.log(name) for name, words in RUNS.items()}), logs=True),
    "thesis.multiples": Maker(lambda: f"{rattle.multiples(thesis.log('sweep'))}.", logs=True),
    "thesis.rattle": Maker(lambda: rattle.tries(thesis.log("sweep")), logs=True, long=True),
    "own_effect.said": Maker(_own_effect, long=True),
    "results.sflr": Maker(lambda: _results("sflr"), logs=True, long=True),
    "results.xl330": Maker(lambda: _results("xl330"), logs=True, long=True),
    "results.xl330-no-controller": Maker(lambda: _results("xl330-no-controller"), logs=True, long=True),
}


@dataclass(frozen=True)
class Block:
    """A marked block of a page."""

    page: Path
    name: str
    how: str
    text: str

    @property
    def compared(self) -> bool:
        """Whether its numbers are the same on every machine."""
        return not self.how.startswith("not compared")


def pages() -> list[Path]:
    """Where numbers may be marked."""
    return [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks() -> dict[str, Block]:
    """Every marked block, by name.  ValueError: two blocks of one name, or one that nothing makes."""
    found: dict[str, Block] = {}
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if text.count("\n<!-- numbers:") != text.count("\n<!-- /numbers -->"):
            raise ValueError(f"{page.name}: a block of numbers is not closed")
        for match in BLOCK.finditer(text):
            name = match["name"]
            if name in found:
                raise ValueError(f"{page.name}: {name} stands in {found[name].page.name} too; one fact, one place")
            if name not in MAKERS:
                raise ValueError(f"{page.name}: nothing makes {name}; known are {', '.join(MAKERS)}")
            found[name] = Block(page, name, match["how"] or "", match["text"].strip("\n"))
    return found


def known() -> list[str]:
    """Names of all blocks, in the order of the pages."""
    return list(blocks())


def made(block: Block) -> str:
    """The block's text as it is made now.  NoLogs: it needs logs that are not there."""
    new = MAKERS[block.name].make()
    if isinstance(new, str):
        return new.strip("\n")
    values = list(new)
    spans = list(NUMBER.finditer(block.text))
    if len(spans) != len(values):
        raise ValueError(f"{block.page.name}: {block.name} holds {len(spans)} numbers, {len(values)} are made: "
                         f"{', '.join(f'{value:.6g}' for value in values)}")
    text = block.text
    for span, value in reversed(list(zip(spans, values, strict=True))):
        sign = "−" if "−" in block.text else "-"
        word = f"{value:.{_decimals(span.group())}f}".replace("-", sign)
        text = text[:span.start()] + word + text[span.end():]
    return text


def _decimals(word: str) -> int:
    return len(word.partition("e")[0].partition(".")[2])


def _tolerance(how: str, word: str) -> float:
    """By how much a number may differ from the one on the page."""
    mantissa, _, exponent = word.replace("−", "-").partition("e")
    unit = 10.0 ** (int(exponent or 0) - _decimals(mantissa))
    stated = re.fullmatch(r"within ([\d.]+)( %)?", how)
    if how and stated is None:
        raise ValueError(f"{how!r} is no tolerance: within 2 %, within 0.3, or not compared: WHY")
    if stated is None:
        return unit
    return max(abs(_value(word)) * float(stated[1]) / 100.0, unit) if stated[2] else float(stated[1])


def _value(word: str) -> float:
    return float(word.replace("−", "-"))


def differences(block: Block, new: str) -> list[str]:
    """Where the page and what is made now differ beyond the stated tolerance."""
    if not block.compared:
        return []
    old_words, new_words = (NUMBER.sub("#", text) for text in (block.text, new))
    if old_words != new_words:
        line = next((f"{a!r} is now {b!r}" for a, b in zip(old_words.split("\n"), new_words.split("\n"), strict=False)
                     if a != b), "a line more or less")
        return [f"{block.page.name}: {block.name}: {line}"]
    found = []
    for old, now in zip(NUMBER.findall(block.text), NUMBER.findall(new), strict=True):
        if abs(_value(old) - _value(now)) > 1.0001 * _tolerance(block.how, old):
            found.append(f"{block.page.name}: {block.name}: {old} is now {now} ({block.how or 'last digit'})")
    return found


def write(block: Block, new: str) -> None:
    """Put a block's new text into its page."""
    text = block.page.read_text(encoding="utf-8")
    match = next(m for m in BLOCK.finditer(text) if m["name"] == block.name)
    block.page.write_text(f"{text[:match.start('text')]}\n{new}\n\n{text[match.end('text'):]}", encoding="utf-8")


def run(names: Sequence[str], *, check: bool, long: bool = False) -> int:
    """Make blocks, compare or write them; 1 where one differs."""
    status, found = 0, blocks()
    for name in names or list(found):
        block, maker = found[name], MAKERS[name]
        if maker.long and not (long or names):
            print(f"{name}: takes a diagnosis; --long makes it")
            continue
        if check and not block.compared:
            print(f"{name}: {block.how}")
            continue
        try:
            new = made(block)
        except thesis.NoLogs as error:
            print(f"{name}: left as it is: {error}")
            continue
        if check:
            wrong = differences(block, new)
            print(f"{name}: " + ("as stated" if not wrong else ""))
            print("".join(f"  {line}\n" for line in wrong), end="")
            status = status or int(bool(wrong))
        else:
            write(block, new)
            print(f"{name}: {'unchanged' if new == block.text else 'written'} in {block.page.name}")
    return status


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="scripts/numbers", description="The marked numbers of README and docs")
    parser.add_argument("names", nargs="*", metavar="NAME", help="these blocks alone")
    parser.add_argument("--check", action="store_true", help="compare within the stated tolerances; write nothing")
    parser.add_argument("--long", action="store_true", help="those too that take a diagnosis each")
    parser.add_argument("--list", action="store_true", help="name the blocks")
    options = parser.parse_args()
    found = blocks()
    if unknown := [name for name in options.names if name not in found]:
        parser.error(f"{unknown[0]}: no such block; --list names them")
    if options.list:
        for block in found.values():
            print(f"{block.name}: {block.page.relative_to(ROOT)}; {block.how or 'one unit of the last digit'}")
        return 0
    return run(options.names, check=options.check, long=options.long)


if __name__ == "__main__":
    sys.exit(main())

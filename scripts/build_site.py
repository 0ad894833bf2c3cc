"""Lay the documentation out and build it: ``scripts/docs`` runs this in .venv.

    python -m scripts.build_site [--out FOLDER]

The pages are those of the repository, at the same places, so that a link that holds in one holds in the other.  Four
are made here from the code: the public names, the commands, the keys of a rig file and the catalogue of effects.
Zensical builds them with --strict: a link to a page or a heading that is not there ends the build.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import typer

import station
from station import rig
from station.cli.app import build
from station.model.effects import catalogue

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "build" / "pages"
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)\s]*)?\)")
"""A link of a page to a file of the project."""
BESIDE = {"diagnose": "station.api.diagnose"}
"""Public names whose home is not in station._HOMES."""
RESULTS = ("station.diagnose.result.DiagnosisResult", "station.diagnose.result.Diagnosis",
           "station.diagnose.compare.Comparison", "station.runs.replay.ReplayResult")
"""What public functions return, where it has no public name."""


def sources() -> list[Path]:
    """The pages that people write."""
    return [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md")),
            *sorted((ROOT / "firmware").rglob("*.md"))]


def lay_out(folder: Path) -> None:
    """Copy the pages, and every file of the project that one of them links to; write the pages made from code."""
    shutil.rmtree(folder, ignore_errors=True)
    wanted = set((ROOT / "docs" / "theme").iterdir())
    for page in sources():
        wanted.add(page)
        for target in LINK.findall(page.read_text(encoding="utf-8")):
            found = (page.parent / target).resolve()
            if found.is_file() and found.is_relative_to(ROOT):
                wanted.add(found)
    for path in sorted(wanted):
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    made = folder / "docs" / "reference"
    made.mkdir()
    for name, text in (("python", names()), ("commands", commands()), ("rig", rig_file()), ("effects", effects())):
        (made / f"{name}.md").write_text(text, encoding="utf-8")


def homes() -> dict[str, str]:
    """Each public name and the module that defines it."""
    found = {name: f"station.{home}.{name}" for home, names in station._HOMES.items() for name in names} | BESIDE
    return {name: found[name] for name in station.__all__}


def names() -> str:
    """The public names, from their docstrings."""
    text = ("# Python names\n\n`import station as st`, then `st.load_run` and so on; [From Python](../python.md) shows "
            "them at work.\n\n")
    text += "".join(f"::: {path}\n\n" for path in sorted(homes().values(), key=lambda path: path.rpartition(".")[2]))
    return text + "## What they return\n\n" + "".join(f"::: {path}\n\n" for path in RESULTS if _exists(path))


def _exists(path: str) -> bool:
    module, _, name = path.rpartition(".")
    return hasattr(__import__(module, fromlist=[name]), name)


def _walk(group: typer.core.TyperGroup, path: str = "") -> Iterator[tuple[str, typer.core.TyperCommand]]:
    for name, command in group.commands.items():
        yield f"{path}{name}", command
        if isinstance(command, typer.core.TyperGroup):
            yield from _walk(command, f"{path}{name} ")


def _cell(text: object) -> str:
    return " ".join(str(text).split()).replace("|", "\\|").replace("<", "&lt;")


def commands() -> str:
    """Every command with its help, options and example."""
    text = "# Commands\n\nWhat `station COMMAND --help` says.\n\n"
    for name, command in _walk(typer.main.get_command(build())):
        text += f"## station {name}\n\n{_cell(command.help)}\n\n"
        if command.epilog:
            text += f"```\n{command.epilog.removeprefix('Example: ')}\n```\n\n"
        rows = []
        for option in command.params:
            if getattr(option, "hidden", False) or option.name == "help":
                continue
            said = ", ".join(f"`{word}`" for word in option.opts) if option.opts[0].startswith("-") else \
                f"`{option.metavar or option.name.upper()}`"
            shown = option.default is not None and not callable(option.default) and option.default not in ((), False)
            rows.append(f"| {said} | {_cell(getattr(option, 'help', '') or '')} | "
                        f"{f'`{option.default}`' if shown else ''} |\n")
        if rows:
            text += "| option | what it says | default |\n| --- | --- | --- |\n" + "".join(rows) + "\n"
    return text


def rig_file() -> str:
    """The tables and keys of a rig file, and a built-in one."""
    text = f"# Rig files\n\n{inspect.getdoc(rig)}\n\n[Describe another rig](../other_rig.md) shows how.\n\n"
    tables = {"[amplifier]": rig.Amplifier, "[motor]": rig.Motor, "[drive] and [clamp]": rig.Joint, "[base]": rig.Base,
              "[beam]": rig.Beam, "[tip]": rig.Tip, "[encoder]": rig.Encoder, "[accelerometer]": rig.Accelerometer,
              "[limits]": rig.Limits}
    for title, table in tables.items():
        text += f"## {title}\n\n{inspect.getdoc(table)}\n\n| key | least | default |\n| --- | --- | --- |\n"
        for key, field in table.model_fields.items():
            least = next((f"> {m.gt:g}" for m in field.metadata if getattr(m, "gt", None) is not None), "") or \
                next((f">= {m.ge:g}" for m in field.metadata if getattr(m, "ge", None) is not None), "")
            default = "must be given" if field.is_required() else (
                "left out" if field.default is None else f"`{field.default}`")
            text += f"| `{key}` | {least.replace('<', '&lt;')} | {default} |\n"
        text += "\n"
    text += ("## [uncertainty]\n\nOne sigma, relative (Gaussian in the natural logarithm): `default` for all, "
             "`\"table.key\"` for one, `table` for a common factor on a table. Exact are "
             f"{', '.join(f'`{key}`' for key in sorted(rig.EXACT))} and `sample_rate`.\n\n"
             "## [[effects]]\n\n`effect`, `at` where it may stand at more than one place, and its parameters "
             "([Effects](effects.md)).\n\n## The built-in rigs\n\n")
    for name, contents in rig.builtin_rigs().items():
        text += f"### {name}\n\n```toml\n{contents.strip()}\n```\n\n"
    return text


def _number(value: float) -> str:
    return {math.inf: "", -math.inf: "", math.pi: "π", -math.pi: "−π"}.get(value, f"{value:g}".replace("-", "−"))


def effects() -> str:
    """The catalogue: each effect with its law, places and parameters."""
    text = ("# Effects\n\nWhat a rig file may hold and a diagnosis may name. [Add an effect](../own_effect.md) says "
            "what x, v, w, p, s and h are.\n\n")
    for name, effect in catalogue().items():
        law = inspect.getdoc(effect.law) if effect.law is not None else ""
        text += f"## {name}\n\n{inspect.getdoc(effect)}\n\n"
        text += f"Stands at {', '.join(effect.sites)}; stage `{effect.stage.name}`.\n\n"
        if law:
            text += f"```\n{law}\n```\n\n"
        text += "| parameter | unit | from | to | does nothing at |\n| --- | --- | --- | --- | --- |\n"
        for key, info in effect.parameters().items():
            neutral = "" if info.neutral is None else ("∞" if math.isinf(info.neutral) else _number(info.neutral))
            text += f"| `{key}` | {info.unit} | {_number(info.low)} | {_number(info.high)} | {neutral} |\n"
        text += f"\nTold from its rivals: {_cell(effect.telling)}.\n\n" if effect.telling else "\n"
    return text


def main() -> int:
    """Lay out and build."""
    parser = argparse.ArgumentParser(prog="scripts/docs", description="Build the documentation into site/")
    parser.parse_args()
    lay_out(PAGES)
    shutil.rmtree(ROOT / tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]["site_dir"],
                  ignore_errors=True)
    return subprocess.run([sys.executable, "-m", "zensical", "build", "--strict", "--clean"], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())

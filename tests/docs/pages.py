"""The examples that stand in README, docs and the firmware's pages, and in the help texts."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorial.md"
PAGES = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md")),
         *sorted((ROOT / "firmware").rglob("*.md"))]


def blocks(page: Path, language: str = "") -> list[str]:
    """The fenced blocks of a page in a language, their indentation taken off."""
    found = re.findall(r"^( *)```(\w*)\n(.*?)^ *```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, kind, text in found if kind == language]


def lines(page: Path) -> list[str]:
    """The command lines of a page's plain blocks, fenced or indented, each on one line and without its remark."""
    text = "\n".join(blocks(page)).replace("\\\n", " ").splitlines()
    text += re.findall(r"^    (?:station|python) .*$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [" ".join(line.split("  #")[0].split()) for line in text if re.match(r" *(station|python|apt|pip) ", line)]


def inline(page: Path) -> list[str]:
    """Commands that stand in a page's sentences."""
    return re.findall(r"`(station [^`\n]*)`", page.read_text(encoding="utf-8"))

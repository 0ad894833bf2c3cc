"""The site is built whole, opens from file: and asks the network for nothing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import station as st
from scripts import build_site
from station.model.effects import catalogue

ROOT = Path(__file__).resolve().parents[2]
LOADS = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("video", "src"), ("embed", "src"),
         ("object", "data"), ("link", "href"), ("image", "href"), ("use", "href")}
"""What a browser fetches by itself; a link that is clicked is none of it."""
FREE = {"canonical", "prev", "next", "alternate"}
"""Links in a page's head that load nothing."""


class Page(HTMLParser):
    """What a page loads, links to, and can be linked to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attrs}
        self.ids |= {given[key] for key in ("id", "name") if key in given}
        for key, value in given.items():
            if (tag, key) in LOADS and not set(given.get("rel", "").split()) & FREE:
                self.loads.append(value)
            if tag == "a" and key == "href":
                self.links.append(value)
            if key == "style":
                self.loads += re.findall(r"url\(([^)]*)\)", value)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built in a copy of what it is built from, as scripts/docs does it."""
    folder = tmp_path_factory.mktemp("docs")
    build_site.lay_out(folder / "build" / "pages")
    config = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    assert 'paths = ["."]' in config
    (folder / "zensical.toml").write_text(config.replace('paths = ["."]', f"paths = ['{ROOT.as_posix()}']"),
                                          encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=folder, capture_output=True,
                          text=True, env={**os.environ, "NO_COLOR": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "site"


@pytest.fixture(scope="module")
def pages(site) -> dict[Path, Page]:
    """Every page, parsed."""
    return {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}


def test_every_page_of_the_project_is_in_the_site_and_in_its_contents(site, pages):
    config = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    for source in build_site.sources():
        name = source.relative_to(ROOT).as_posix()
        made = name.removesuffix("README.md") + "index.html" if name.endswith("README.md") else name[:-2] + "html"
        assert site / made in pages and f'"{name}"' in config, name


def test_no_page_asks_the_network_for_anything(pages):
    remote = [(path.name, target) for path, page in pages.items() for target in page.loads
              if urlsplit(target).scheme not in ("", "data") or target.startswith("//")]
    assert remote == [] and sum(len(page.loads) for page in pages.values()) > 5 * len(pages)


def test_styles_and_figures_ask_the_network_for_nothing(site):
    for path in [*site.rglob("*.css"), *site.rglob("*.svg")]:
        text = path.read_text(encoding="utf-8")
        assert re.findall(r"(?:url\(|@import\s|(?:href|src)=)[\"']?\s*(?:https?:)?//", text) == [], path.name


def test_every_link_inside_the_site_leads_somewhere(site, pages):
    broken, checked = [], 0
    for path, page in pages.items():
        for target in [*page.links, *page.loads]:
            parts = urlsplit(target)
            if parts.scheme or target.startswith("//") or path.name == "404.html":
                continue
            found = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            found = found / "index.html" if found.is_dir() else found
            checked += 1
            inside = found.is_relative_to(site.resolve()) and found.is_file()
            anchor = unquote(parts.fragment)
            if not inside or (anchor and found in pages and anchor not in pages[found].ids):
                broken.append((path.name, target))
    assert broken == [] and checked > 500


def test_strict_refuses_a_link_that_leads_nowhere(tmp_path):
    """The build above can fail: a page that links to none does not pass."""
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages" / "index.md").write_text("# A\n\n[b](b.md) [c](#c)\n", encoding="utf-8")
    (tmp_path / "zensical.toml").write_text('[project]\nsite_name = "a"\ndocs_dir = "pages"\n', encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=tmp_path, capture_output=True,
                          text=True)
    assert done.returncode != 0 and "page does not exist" in done.stdout + done.stderr


@pytest.mark.parametrize("name", st.__all__)
def test_every_public_name_stands_in_the_reference(site, pages, name):
    page = pages[site / "docs" / "reference" / "python.html"]
    assert build_site.homes()[name] in page.ids


def test_every_effect_stands_in_the_reference_with_its_parameters(site, pages):
    path = site / "docs" / "reference" / "effects.html"
    text = path.read_text(encoding="utf-8")
    for name, effect in catalogue().items():
        assert name in pages[path].ids
        assert all(f"<code>{key}</code>" in text for key in effect.parameters()), name


def test_every_command_and_every_table_of_a_rig_file_stand_in_the_reference(site):
    from tests.cli.test_help import COMMANDS

    text = (site / "docs" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f">station {name}<" not in text] == []
    rigs = (site / "docs" / "reference" / "rig.html").read_text(encoding="utf-8")
    assert all(f"<code>{key}</code>" in rigs for key in ("flexural_rigidity", "counts_per_revolution", "travel"))


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium here")
def test_a_browser_opens_the_site_from_file_and_searches_it(site):
    """No console error, no request but file: and data:, and the search finds an effect."""
    from playwright.sync_api import sync_playwright

    asked, errors = [], []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        for name in ("index.html", "docs/thesis.html", "docs/reference/python.html", "docs/tutorial.html"):
            page.goto((site / name).as_uri())
            broken = page.evaluate("[...document.images].filter(i => i.complete && !i.naturalWidth).map(i => i.src)")
            assert broken == []
        page.keyboard.press("/")
        page.get_by_placeholder("Search").fill("backlash")
        page.get_by_text("The drive carries torque").first.wait_for(timeout=20_000)
        browser.close()
    assert errors == []
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []

"""The page of a folder of runs: every run with a picture, its measures and links; static, offline, escaped."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import pytest

from station.runs import annotate, export_run, list_runs
from station.view.runs import runs_html
from tests.cli.conftest import station, step_run  # noqa: F401
from tests.view.browser import Watched, chromium


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two runs, one with an awkward name and tag, a file that is none, and a report."""
    folder = tmp_path_factory.mktemp("lab")
    export_run(step_run(name="step", rows=800), folder / "step.csv")
    export_run(step_run(name="odd", rows=100, amplitude=20.0), folder / "a & b #1.csv")
    annotate(folder / "step.csv", tags=["<script>alert(1)</script>"], note="clamp tightened")
    (folder / "broken.csv").write_text("t,reference\n", encoding="utf-8")
    (folder / "reports").mkdir()
    (folder / "reports" / "first try.html").write_text("<html></html>", encoding="utf-8")
    return folder


class Links(HTMLParser):
    """Addresses and open tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("href", "src")]


def test_every_run_has_a_picture_its_measures_and_a_link(folder):
    page = runs_html(folder, list_runs(folder))
    links = Links(page)
    assert links.addresses == ["data:,", "reports/first%20try.html", "a%20%26%20b%20%231.csv", "broken.csv", "step.csv"]
    pictures = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(pictures) == 2
    for picture in pictures:
        ET.fromstring(picture)
    assert "clamp tightened" in page and "column command is missing" in page
    assert str(folder.parent) not in page
    assert re.search(r"\d+\.\d %", page) and "3 runs in lab" in page


def test_the_page_asks_nobody_for_anything_and_runs_no_script(folder):
    page = runs_html(folder, list_runs(folder))
    assert "script" not in Links(page).tags
    assert "&lt;script&gt;alert(1)" in page
    assert not [address for address in Links(page).addresses if ":" in address.removeprefix("data:")]
    assert "default-src 'none'" in page
    assert "url(" not in page and "@import" not in page


def test_the_command_writes_the_page_and_replaces_none_unasked(station, folder):  # noqa: F811
    page = folder / "index.html"
    assert station("runs", folder, "--html").status == 0
    first = page.read_bytes()
    assert b"step.csv" in first
    assert "exists already" in station("runs", folder, "--html").one_line()
    assert station("runs", folder, "--html", "--overwrite", "--test", "sweep").status == 0
    assert b"0 runs" in page.read_bytes() and page.read_bytes() != first


@pytest.mark.parametrize(("size", "scheme"), [((390, 844), "dark"), ((1280, 800), "light")], ids=["phone", "desk"])
def test_a_browser_shows_every_run_on_a_phone_and_on_a_desk(folder, tmp_path, size, scheme):
    path = tmp_path / "index.html"
    path.write_text(runs_html(folder, list_runs(folder)), encoding="utf-8")
    with chromium() as browser:
        watched = Watched(browser, viewport=dict(zip(("width", "height"), size, strict=True)), color_scheme=scheme)
        page = watched.page
        page.goto(path.as_uri())
        assert watched.errors == [] and watched.requests == [path.as_uri()]
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        shown = page.eval_on_selector_all("tbody td.name a, .thumbnail svg", """all => all.map(e => {
            const box = e.getBoundingClientRect(); return [box.left, box.right, box.height]; })""")
        assert len(shown) == 5
        assert all(0 <= left < right <= size[0] and 10 < height < 120 for left, right, height in shown)
        angle, reference = (page.eval_on_selector(f".thumbnail polyline:{which}-of-type",
                                                  "e => getComputedStyle(e).strokeDasharray")
                            for which in ("last", "first"))
        assert angle == "none" != reference
        watched.context.close()

"""The report in a real browser: nothing is asked of the network, every figure is drawn, the gist is above the fold."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from station.view.report import write_report
from tests.view import made
from tests.view.browser import Watched, chromium

PHONE, DESK = {"width": 390, "height": 844}, {"width": 1280, "height": 800}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(made.result("ambiguous", runs=2), path)
    return path


def until(page: Any, question: str) -> None:
    """Wait for a condition, asked from outside: the page's own policy forbids waiting inside it."""
    for _ in range(400):
        if page.evaluate(question):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never true: {question}")


def bottom(page: Any, selector: str) -> float:
    return page.eval_on_selector(selector, "e => e.getBoundingClientRect().bottom")


def channels(colour: str) -> list[int]:
    return [int(value) for value in re.findall(r"\d+", colour)[:3]]


def ink(page: Any, selector: str) -> str:
    return page.eval_on_selector(selector, "e => getComputedStyle(e).color")


@pytest.mark.parametrize(("size", "verdict"), [
    pytest.param(PHONE, "ambiguous", id="phone"), pytest.param(DESK, "partly_explained", id="desk"),
    pytest.param(PHONE, "partly_explained", id="phone, the other", marks=pytest.mark.long),
    pytest.param(DESK, "ambiguous", id="desk, the other", marks=pytest.mark.long)])
def test_verdict_picture_and_gain_stand_above_the_fold(browser: Any, tmp_path: Path, size: dict[str, int],
                                                       verdict: str) -> None:
    """With the verdicts whose sentences are the longest."""
    write_report(made.result(verdict), tmp_path / "report.html")
    page = Watched(browser, viewport=size).open(tmp_path / "report.html")
    for part in ("#verdict", "#figure-hero", "#gain"):
        assert 0 < bottom(page, part) <= size["height"], part
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    assert page.eval_on_selector_all("#figure-hero .scatterlayer .trace path.js-line",
                                     "lines => lines.every(l => l.getBoundingClientRect().width > 200)")
    page.context.close()


@pytest.mark.parametrize(("verdict", "runs"), [("explained", 5), ("nothing_missing", 2)])
def test_no_console_error_no_request_and_every_figure_drawn(browser: Any, tmp_path: Path, verdict: str,
                                                                runs: int) -> None:
    path = tmp_path / "report.html"
    result = made.result(verdict, runs=runs)
    write_report(result, path)
    watched = Watched(browser, viewport=DESK)
    page = watched.open(path)
    assert watched.errors == []
    assert [url for url in watched.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert page.evaluate("document.documentElement.scrollHeight") < 6000
    folded = "document.querySelectorAll('details:not([open]) [data-figure]:not([data-drawn])').length"
    assert page.evaluate(folded) >= len(result.comparisons)
    page.evaluate("document.querySelectorAll('details').forEach(part => { part.open = true; })")
    until(page, "document.querySelectorAll('[data-figure]:not([data-drawn])').length === 0")
    lines = page.evaluate("""() => [...document.querySelectorAll('[data-figure]')].map(place => ({
        name: place.dataset.figure, drawn: place.dataset.drawn, height: place.querySelector('svg')?.clientHeight || 0,
        asked: place.data.length, there: place.querySelectorAll('.scatterlayer .trace').length}))""")
    assert len(lines) == 1 + len(result.evidence) + len(result.comparisons) + 3
    assert watched.errors == []
    for figure in lines:
        assert figure["drawn"] == "yes" and figure["height"] > 200, figure
        assert figure["there"] == figure["asked"] > 0, figure
    watched.context.close()


def test_hover_tells_values_and_the_legend_hides_a_line(browser: Any, report: Path) -> None:
    page = Watched(browser, viewport=DESK).open(report)
    box = page.query_selector("#figure-hero .nsewdrag").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector("#figure-hero .hoverlayer .legendtext, #figure-hero .hoverlayer text", timeout=20_000)
    shown = page.eval_on_selector("#figure-hero .hoverlayer", "e => e.textContent")
    assert "measured" in shown and "before" in shown
    entry = page.query_selector("#figure-hero .legend .traces:has-text('before') .legendtoggle").bounding_box()
    page.mouse.click(entry["x"] + 10, entry["y"] + entry["height"] / 2)
    until(page, "document.getElementById('figure-hero').data.some(t => t.visible === 'legendonly')")
    page.context.close()


def test_no_button_sends_the_data_anywhere(browser: Any, report: Path) -> None:
    page = Watched(browser, viewport=DESK).open(report)
    titles = page.eval_on_selector_all(".modebar-btn", "all => [...new Set(all.map(e => e.dataset.title))]")
    assert {"Zoom", "Pan", "Reset axes"} <= set(titles)
    assert not [title for title in titles if re.search("share|cloud|edit|send", title, re.I)]
    assert page.evaluate("document.getElementById('figure-hero')._context.plotlyServerURL") == ""
    page.context.close()


@pytest.mark.parametrize("width", [380, 1500])
def test_the_buttons_cover_no_entry_of_a_legend_and_no_name_of_an_axis(browser: Any, tmp_path: Path,
                                                                       width: int) -> None:
    write_report(made.result("explained", runs=5), tmp_path / "report.html")
    page = Watched(browser, viewport={"width": width, "height": 900}).open(tmp_path / "report.html")
    covered = page.evaluate("""() => [...document.querySelectorAll('[data-drawn]')].map(place => {
        const groups = [...place.querySelectorAll('.modebar-group')].map(e => e.getBoundingClientRect());
        const texts = [...place.querySelectorAll('.legend .traces, .infolayer text')];
        return [groups.length, texts.length, texts.filter(e => { const r = e.getBoundingClientRect();
            return groups.some(g => r.left < g.right && g.left < r.right && r.top < g.bottom && g.top < r.bottom);
        }).map(e => e.textContent)]; })""")
    assert len(covered) >= 5
    for groups, texts, under in covered:
        assert groups and texts and under == []
    page.context.close()


def test_a_drag_zooms_and_a_double_click_shows_all_again(browser: Any, report: Path) -> None:
    page = Watched(browser, viewport=DESK).open(report)
    reach = "document.getElementById('figure-hero').layout.xaxis.range"
    whole = page.evaluate(reach)
    box = page.query_selector("#figure-hero .nsewdrag").bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], middle + 3, steps=6)
    page.mouse.up()
    until(page, f"({reach})[1] - ({reach})[0] < 0.3 * {whole[1] - whole[0]}")
    low, high = page.evaluate(reach)
    assert low == pytest.approx(whole[0] + 0.25 * (whole[1] - whole[0]), abs=0.03 * (whole[1] - whole[0]))
    page.mouse.dblclick(box["x"] + 0.6 * box["width"], middle)
    until(page, f"Math.abs(({reach})[1] - {whole[1]}) < 1e-6")
    page.context.close()


def test_the_list_of_contents_leads_to_its_sections_and_a_run_unfolds_where_a_link_names_it(browser: Any,
                                                                                             report: Path) -> None:
    page = Watched(browser, viewport=PHONE).open(report)
    page.click("#contents a[href='#remains']")
    until(page, "Math.abs(document.getElementById('remains').getBoundingClientRect().top) < 100")
    assert page.query_selector("#run-2[open]") is None
    page.click("#gains a[href='#run-2']")
    until(page, "document.getElementById('figure-run-1').dataset.drawn === 'yes'")
    assert page.query_selector("#run-2[open]") is not None
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.context.close()


def test_lines_and_points_are_told_apart_without_colour(browser: Any, report: Path) -> None:
    """In every drawn figure: dash, width or marker differ between any two entries of a legend."""
    page = Watched(browser, viewport=DESK).open(report)
    looks = page.evaluate("""() => [...document.querySelectorAll('[data-drawn]')].map(place => place._fullData
        .filter(t => t.showlegend).map(t => [t.mode, t.mode.includes('lines') ? t.line.dash + t.line.width : '',
                                             t.mode.includes('markers') ? t.marker.symbol + t.marker.size : ''].join()))
        """)
    assert len(looks) >= 5
    for figure in looks:
        assert len(figure) == len(set(figure)) > 1, figure
    page.context.close()


@pytest.mark.long
def test_paper_shows_what_the_screen_folds(browser: Any, report: Path) -> None:
    watched = Watched(browser, viewport=DESK)
    page = watched.open(report)
    assert page.query_selector("#run-1[open]") is None
    left = page.evaluate("""() => { dispatchEvent(new Event('beforeprint'));
        return [...document.querySelectorAll('[data-figure]')].filter(place => !place.querySelector('.trace')).length
            + document.querySelectorAll('details:not([open])').length; }""")
    assert left == 0                # at once, for the browser prints when the event returns
    page.emulate_media(media="print")
    assert page.query_selector("#contents").is_visible() is False
    assert page.query_selector("details.screen pre").is_visible() is False
    assert page.query_selector("#figure-run-0").is_visible() is True
    page.emulate_media(media="screen")
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.query_selector("#run-1[open]") is None
    printed = page.pdf(prefer_css_page_size=True)
    page.evaluate("document.querySelectorAll('.run').forEach(part => part.remove())")
    assert len(printed) > 1.1 * len(page.pdf(prefer_css_page_size=True))      # the folded runs were drawn on paper
    assert watched.errors == []
    page.context.close()


@pytest.mark.long
def test_dark_mode_and_paper_turn_the_page_and_its_figures(browser: Any, report: Path) -> None:
    watched = Watched(browser, viewport={"width": 700, "height": 1000}, color_scheme="light")
    page = watched.open(report)
    page.emulate_media(color_scheme="dark")
    until(page, "document.getElementById('figure-hero').layout.font.color === '#eceff3'")
    assert min(channels(ink(page, "body"))) > 200
    assert page.eval_on_selector("#figure-hero .xtick text", "e => getComputedStyle(e).fill") == ink(page, "body")

    page.emulate_media(media="print", color_scheme="dark")
    until(page, "document.getElementById('figure-hero').layout.font.color === '#16191d'")
    assert max(channels(ink(page, "body"))) < 60
    widths = page.eval_on_selector_all("[data-drawn]", "all => all.map(e => [e.clientWidth, "
                                                        "e.querySelector('svg.main-svg').clientWidth])")
    assert all(drawing <= place + 1 for place, drawing in widths)
    pdf = page.pdf(prefer_css_page_size=True)
    assert pdf.startswith(b"%PDF") and len(re.findall(rb"/Type /Page\b(?!s)", pdf)) >= 3
    watched.context.close()


def test_hostile_names_stay_text(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(made.hostile(), path)
    watched = Watched(browser, viewport=PHONE)
    page = watched.open(path)
    page.evaluate("document.querySelectorAll('details').forEach(part => { part.open = true; })")
    until(page, "document.querySelectorAll('[data-figure]:not([data-drawn])').length === 0")
    assert page.evaluate("typeof window.stolen") == "undefined"
    assert page.query_selector_all("main img, main iframe, main b, .plot-container a") == []
    assert made.HOSTILE in page.text_content("#runs")
    assert watched.errors == [] and len(watched.requests) == 1
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    watched.context.close()

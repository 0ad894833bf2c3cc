"""The page of a campaign: whole, escaped, offline; drawn by a browser where there is one."""

from __future__ import annotations

import re

import pytest

from station.campaign.run import Results
from station.campaign.summary import summary
from station.view.campaign import campaign_html, right, write_campaign
from tests.campaign.made import DEAD_ZONE, cause, hidden, outcome
from tests.campaign.test_summary import ALL
from tests.view.browser import Watched, chromium

EVIL = '<img src=x onerror=alert(1)>"&\'</script>'


def own_text(html: str) -> str:
    """The page without Plotly's script and the style."""
    return re.sub(r"<style>.*?</style>|<script>.*?</script>", "", html, flags=re.DOTALL)


def test_the_page_shows_what_the_summary_says():
    text = own_text(campaign_html(summary(Results(ALL, {"lost": "its worker was lost 4 times"}))))
    assert "of 3 single hidden causes 1 were named first; of 2 clean rigs 1 was accused." in text
    for words in ("Dead zone", "Coulomb friction at the base", "nothing missing", "its worker was lost 4 times",
                  'id="confusion"', 'id="reliability"', 'id="gain"', "not known"):
        assert words.lower() in text.lower(), words


def test_text_from_files_is_escaped():
    found = summary(Results([outcome(EVIL, [hidden(DEAD_ZONE)], [cause((EVIL, EVIL), 0.9)], group=EVIL),
                             outcome("x" + EVIL, None, [], unmade=EVIL)], {"y" + EVIL: EVIL}))
    html = campaign_html(found, EVIL)
    assert "<img" not in own_text(html) and "onerror=alert(1)>" not in html.replace("&gt;", "")
    assert "&lt;img src=x" in html
    data = re.search(r'<script type="application/json" id="figures">(.*?)</script>', html, re.DOTALL).group(1)
    assert "<" not in data and "\\u003cimg" not in data and "lt;img" in data, "Plotly reads tags in hover texts"


def test_nothing_is_asked_of_the_network():
    html = own_text(campaign_html(summary(Results(ALL))))
    assert not re.search(r'(src|href)="(?!data:|#)', html) and "default-src 'none'" in html


def test_a_campaign_without_cases_has_a_page(tmp_path):
    write_campaign(summary(Results()), tmp_path / "r.html")
    assert "0 cases diagnosed" in (tmp_path / "r.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("row", "column", "is_right"), [
    ("clean", "nothing_missing", True), ("clean", "dead_zone@amplifier", False),
    ("outside the catalogue", "unexplained", True), ("outside the catalogue", "explained", False),
    ("dead_zone@amplifier", "dead_zone@amplifier", True), ("dead_zone@amplifier", "nothing_missing", False)])
def test_the_shade_says_what_is_right(row, column, is_right):
    assert right(row, column) == is_right


def test_a_browser_draws_it_without_a_complaint(tmp_path):
    write_campaign(summary(Results(ALL)), tmp_path / "r.html")
    with chromium() as browser:
        watched = Watched(browser, viewport={"width": 1200, "height": 900})
        page = watched.open(tmp_path / "r.html")
        assert page.locator(".figure .main-svg").count() >= 2
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert watched.errors == [] and all(not url.startswith("http") for url in watched.requests)

"""The page of runs beside their simulations: what `compare` measures, drawn; one file, offline, escaped."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from station.diagnose.compare import compare
from station.rig import Rig, load_rig
from station.runs import Run
from station.view.beside import beside_html
from station.view.wording import percent
from tests.cli.conftest import step_run
from tests.view.browser import Watched, chromium

HOSTILE = "<img src=x onerror=alert(1)>"
WRITTEN = datetime(2026, 3, 1, 9, 30, tzinfo=UTC)


def heavier(rig: Rig) -> Rig:
    return rig.with_constants(rig.constants() | {"base.inertia": 3.0 * rig.base.inertia})


def text_of(page: str) -> str:
    body = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body))


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """A step, a noisy repeat of it, and one of which nothing says how its loop was closed."""
    step = step_run(rows=900)
    noise = np.random.default_rng(3).integers(-1, 2, size=(2, 900))
    again = replace(step, name="again", encoder=step.encoder + noise[0], accel=step.accel + noise[1])
    unknown = step.metadata.model_copy(update={"controller": {"kind": "unknown"}})
    return [step, again, replace(step, name=HOSTILE, metadata=unknown)]


def test_it_says_what_compare_measures_and_what_repeats_differ_by(runs: list[Run]) -> None:
    rig = load_rig("sflr")
    compared = {"sflr": compare(rig, runs[:2]), "heavy.toml": compare(heavier(rig), runs[:2])}
    page = text_of(beside_html(compared, ["12ab", None], WRITTEN))
    first, then = (one.measures[1]["accel"]["nrmse"] for one in compared.values())
    assert 0.001 < first < 0.2 < then
    assert f"{percent(first)} → {percent(then)}" in page
    for name, one in compared.items():
        low, high = sorted(row["encoder"]["nrmse"] for row in one.measures)
        assert f"by {percent(low)} to {percent(high)} as {name} simulates it" in page
    measured, simulated = (compared["heavy.toml"].measures[0][side] for side in ("measured", "simulated"))
    assert f"{measured['overshoot_percent']:.1f} ± " in page
    assert f"{simulated['overshoot_percent']:.1f} %, " in page
    assert simulated["overshoot_percent"] > measured["overshoot_percent"] + 5.0
    assert "2026-03-01" in page and "12ab" in page and "± the standard deviation between repeats" in page
    assert "predicted" not in page


def test_one_rig_alone_is_named_as_it_is_and_a_loop_that_is_not_known_told(runs: list[Run]) -> None:
    page = text_of(beside_html({"its rig": compare(load_rig("sflr"), runs[2:])}))
    assert "1 run: the angle is off by" in page and "as its rig simulates it" in page and "→" not in page
    assert "; predicted 0.5 s ahead; " in page and "one whose loop cannot be closed again" in page
    assert HOSTILE not in page.replace("&lt;", "<x")


def test_a_servo_without_an_accelerometer_has_one_channel() -> None:
    rig = load_rig("sflr").model_copy(update={"accelerometer": None})
    run = replace(step_run(), accel=None)
    page = beside_html({"sflr": compare(rig, [run])})
    assert "--rows:2" in page and "acceleration" not in text_of(page)


def test_it_is_drawn_without_a_request_or_an_error_and_fits_a_phone(runs, tmp_path) -> None:
    rig = load_rig("sflr")
    path = tmp_path / "beside.html"
    path.write_text(beside_html({HOSTILE: compare(rig, runs), "better.toml": compare(heavier(rig), runs)}),
                    encoding="utf-8")
    with chromium() as browser:
        watched = Watched(browser, viewport={"width": 390, "height": 844})
        page = watched.open(path)
        page.click("a[href='#run-3']")
        page.wait_for_selector("#figure-run-2[data-drawn='yes']")     # to ask again a function wants eval
        names = page.eval_on_selector_all("#figure-run-2 .legendtext", "texts => texts.map(t => t.textContent)")
        assert names == ["measured", HOSTILE, "better.toml"]
        assert page.query_selector("main img") is None
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert watched.errors == [] and len(watched.requests) == 1
        watched.context.close()

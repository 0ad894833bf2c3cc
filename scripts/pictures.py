#!/usr/bin/env python3
"""Make the pictures of the docs: a diagnosis of the simulated rig, its report, its recording and a log, photographed.

    python scripts/pictures.py [FOLDER] [--report]

Needs the package installed, playwright, and a Chromium on the PATH.  FOLDER defaults to docs/images, where the docs and
the README look for them; --report leaves Rerun's pictures as they are.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from station.control.compensators import Compensator
from station.control.named import NAMED
from station.control.references import step
from station.device.port import open_port
from station.diagnose.diagnose import diagnose
from station.loop.run_test import run_test
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.rig import Rig, load_rig
from station.runs import McapLogWriter
from station.runs.run import Run, RunMetadata
from station.view import viewer, web
from station.view.recording import write_recording
from station.view.report import write_report

DESK, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
VIEWER_SECONDS = 45.0
COLOURS = 128
"""Of a picture that is kept: a third of the size, and no difference to the eye."""


def runs_of(rig: Rig, seed: int = 7) -> list[Run]:
    """Four tests on a rig with accelerometer noise of two counts: steps, a pulse, a sweep; two seconds each."""
    rng = np.random.default_rng(seed)
    t = np.arange(1000) / rig.sample_rate
    unit = np.where(t < 0.2, 0.0, 1.0)
    pulse = np.where((t > 0.2) & (t < 0.45), 60.0, 0.0) - np.where((t > 1.0) & (t < 1.25), 60.0, 0.0)
    lead = {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637}
    tests: Sequence[tuple[str, dict[str, Any], np.ndarray]] = (
        ("step-p", {"kind": "p", "gain": 2.0}, 50.0 * unit), ("step-lead", lead, 100.0 * unit),
        ("pulse", {"kind": "open"}, pulse),
        ("sweep", {"kind": "p", "gain": 1.0}, np.round(40.0 * np.sin(2.0 * np.pi * (0.5 + 2.2 * t) * t))))
    runs = []
    for name, controller, reference in tests:
        about = RunMetadata(rig=rig.name, controller=controller, test={"kind": name.partition("-")[0]}, command_row=-1,
                            zero_id="bench")
        asked = Run(name, t, reference, reference.copy(), 0.0 * t, 0.0 * t, about)
        made = simulate(rig, asked)
        noisy = np.round(made.accel + rng.normal(0.0, 2.0, len(t)))
        runs.append(replace(asked, command=made.command, encoder=made.encoder, accel=noisy))
    return runs


def photograph_finding(browser: Any, report: Path, picture: Path) -> None:
    """The README's picture: the report from its verdict to the evidence for the first cause."""
    page = browser.new_page(viewport={"width": 1120, "height": 1400})
    page.goto(report.as_uri())
    page.wait_for_selector("html[data-figures=drawn]")
    end = page.eval_on_selector("#cause figure", "e => e.getBoundingClientRect().bottom")
    page.screenshot(path=picture, clip={"x": 0, "y": 0, "width": 1120, "height": end + 8}, full_page=True)
    page.close()


def photograph_report(browser: Any, report: Path, folder: Path) -> None:
    """The report's first screen on a desk, in light and dark, and on a phone."""
    for name, size, scheme in (("report", DESK, "light"), ("report-dark", DESK, "dark"),
                               ("report-phone", PHONE, "light")):
        page = browser.new_page(viewport=size, color_scheme=scheme)
        page.goto(report.as_uri())
        page.wait_for_selector("html[data-figures=drawn]")
        page.screenshot(path=folder / f"{name}.png")
        page.close()


def photograph_in_viewer(browser: Any, files: Sequence[Path], picture: Path) -> None:
    """Files in Rerun's web viewer, as Station serves it."""
    data, port = viewer.free_port(), viewer.free_port()
    process = viewer.start(["--serve-web", "--web-viewer-port", str(port), *map(str, files)], data)
    try:
        with web.serve_page(port, data) as address:
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            answered: list[str] = []
            page.on("response", lambda answer: answered.append(answer.url))
            page.goto(f"{address}&renderer=webgl")
            page.wait_for_timeout(1e3 * VIEWER_SECONDS)
            page.screenshot(path=picture, timeout=120_000)
            page.close()
            outside = [url for url in answered if not url.startswith("http://127.0.0.1:")]
            if outside:
                raise SystemExit(f"the viewer's page was answered from outside: {', '.join(outside)}")
    finally:
        process.terminate()
        process.wait()


def log_a_test(path: Path) -> None:
    """A step on the simulated rig, logged as the loop does it, its blueprint beside it."""
    rig = load_rig("sflr")
    compensator = Compensator.from_spec(NAMED["lead"], rig.sample_rate, rig.command_limit)
    with open_port("sim://sflr?noise=1&seed=1") as port:
        run_test(port, rig, compensator, step(rig.sample_rate), log_sink=partial(McapLogWriter, path))


def main() -> None:
    """Diagnose a rig with friction that the nominal rig lacks, and photograph what comes of it."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/images"))
    parser.add_argument("--report", action="store_true", help="the report's pictures alone")
    options = parser.parse_args()
    folder: Path = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        raise SystemExit(f"no browser: none of {', '.join(BROWSERS)} is on the PATH")
    nominal = load_rig("sflr")
    true = nominal.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.12)])
    result = diagnose(nominal, runs_of(true))
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        report, recording = Path(scratch) / "report.html", Path(scratch) / "diagnosis.rrd"
        write_report(result, report)
        write_recording(recording, result.comparisons, nominal)
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox", *SOFTWARE_GL])
        photograph_finding(browser, report, folder / "finding.png")
        photograph_report(browser, report, folder)
        if not options.report:
            photograph_in_viewer(browser, [recording], folder / "recording.png")
            log = Path(scratch) / "log.mcap"
            log_a_test(log)
            photograph_in_viewer(browser, [log, log.with_suffix(".rbl")], folder / "log.png")
        browser.close()
    made = [folder / f"{name}.png" for name in ("finding", "report", "report-dark", "report-phone",
                                                *(() if options.report else ("recording", "log")))]
    for picture in made:
        with Image.open(picture) as colours:
            few = colours.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        few.save(picture, optimize=True)
    print(f"{folder}: {', '.join(picture.name for picture in made)}")


if __name__ == "__main__":
    main()

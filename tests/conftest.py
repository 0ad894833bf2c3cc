"""Settings for all tests: property tests are repeatable, and no slow machine fails them by its clock."""

import os

from hypothesis import settings

from station.estimation import pool

if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
    pool.SIZE = 1       # every core is at tests already; processes beside them cost an eighth more

settings.register_profile("station", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("station")


def pytest_terminal_summary(terminalreporter):
    """Print the figures that tests have recorded (``record_property("figure", ...)``)."""
    figures = [text for report in terminalreporter.getreports("passed") if report.when == "call"
               for name, text in report.user_properties if name == "figure"]
    if figures:
        terminalreporter.section("figures")
        for text in sorted(figures):
            terminalreporter.line(text)

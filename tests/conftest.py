"""Settings for all tests: property tests are repeatable, and no slow machine fails them by its clock."""

import os

from hypothesis import settings

from station.estimation import pool

if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
    pool.SIZE = 1       # every core is at tests already; processes beside them cost an eighth more

settings.register_profile("station", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("station")


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="tests marked long, too: more of what others hold already")


def pytest_collection_modifyitems(config, items):
    """Leave out what is marked long, where it is not asked for; begin with what wants a fresh process."""
    left = [item for item in items if item.get_closest_marker("long") and not config.getoption("--long")]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in set(left)]
    items.sort(key=lambda item: item.get_closest_marker("fresh") is None)


def pytest_terminal_summary(terminalreporter):
    """Print the figures that tests have recorded (``record_property("figure", ...)``)."""
    figures = [text for report in terminalreporter.getreports("passed") if report.when == "call"
               for name, text in report.user_properties if name == "figure"]
    if figures:
        terminalreporter.section("figures")
        for text in sorted(figures):
            terminalreporter.line(text)

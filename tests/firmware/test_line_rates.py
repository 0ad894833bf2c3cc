"""The table of rates in docs/firmware.md is what the core accepts: each rate, and no whole hertz more."""

from __future__ import annotations

import pytest

from scripts.line_rates import ADAPTER, BAUD_RATES, WIRED, highest_rate
from station.device.protocol import Result


@pytest.mark.parametrize("answer_ticks", [1, 2, 3, 4])
@pytest.mark.parametrize(("baud_rate", "allowance"), [*((rate, allowance) for rate in BAUD_RATES
                                                        for allowance in (WIRED, ADAPTER)), (0, ADAPTER)])
def test_the_core_accepts_the_highest_rate_and_no_higher(make_bench, baud_rate, allowance, answer_ticks):
    highest = highest_rate(baud_rate, allowance, answer_ticks)
    for hertz, wanted in ((highest, Result.OK), (highest + 1, Result.LINE_TOO_SLOW)):
        bench = make_bench(rate=1000 * hertz, baud_rate=baud_rate, allowance=allowance)
        bench.identify()
        assert bench.configure(rate=1000 * hertz, answer_ticks=answer_ticks, fault_ticks=2).result == wanted

"""The highest sample rates that a line holds, by the rule of firmware/core/core.c; the table of docs/firmware.md."""

from __future__ import annotations

from station.device.protocol import LIMITS, MESSAGES

BAUD_RATES = (57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000)
WIRED, ADAPTER = 500, 2000
"""Allowance for host and line, us: a UART wired to the host's own, and a USB adapter."""


def highest_rate(baud_rate: int, allowance: int, answer_ticks: int) -> int:
    """Hz, a whole number: sample, command and allowance within ``answer_ticks`` periods, each frame within one.

    ``baud_rate`` 0: USB of the chip itself, whose bytes take no time that counts.  Times in whole us, rounded up as the
    core does it.
    """
    def line_time(name: str) -> int:
        bits = MESSAGES[name].wire_size * LIMITS["line_bits_per_byte"]
        return 0 if baud_rate == 0 else -(-bits * 1_000_000 // baud_rate)

    sample, command = line_time("sample"), line_time("command")
    period = max(sample, command, -(-(sample + command + allowance) // answer_ticks))
    return 1_000_000 // period


def table() -> str:
    """Before the stroke a wired UART, behind it a USB adapter."""
    ticks = range(1, LIMITS["answer_ticks_max"] + 1)
    rows = ["| baud rate | `answer_ticks` 1 | 2 | 3 | 4 |", "| --- | --- | --- | --- | --- |"]
    for baud_rate in BAUD_RATES:
        cells = [f"{highest_rate(baud_rate, WIRED, n)} / {highest_rate(baud_rate, ADAPTER, n)}" for n in ticks]
        rows.append(f"| {baud_rate} | {' | '.join(cells)} |")
    usb = " | ".join(str(highest_rate(0, ADAPTER, n)) for n in ticks)
    return "\n".join([*rows, f"| USB of the chip itself | {usb} |"])

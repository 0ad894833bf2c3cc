"""Breaks each safety-relevant line of the firmware and of the host in turn; every mutant must turn a test red.

    python scripts/bench/mutants.py [--only WORD] [--list]

Each mutant is a copy of the sources with one line changed; the tests that run are tests/firmware and the few of
tests/loop and tests/device that concern the line.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CORE, FRAME, ENGINE, RUN, CLIENT, SIMULATED = ("firmware/core/core.c", "firmware/core/frame.c",
                                               "station/loop/engine.py", "station/loop/run_test.py",
                                               "station/device/client.py", "station/device/simulated.py")
TESTS = ("tests/firmware", "tests/loop/test_limits_sent.py", "tests/device/test_limits.py", "tests/device/test_port.py")


@dataclass(frozen=True)
class Mutant:
    """One line broken: what it guards, the file, the text and what takes its place."""

    guards: str
    path: str
    old: str
    new: str


MUTANTS = (
    Mutant("crc: checked at all", CORE, "bytes, length) == 0 ? bytes[0] : 0;", "bytes, length) == 0 ? bytes[0] : bytes[0];"),
    Mutant("crc: each bit", FRAME, "value ^= (value & 0xffu) << 5;", "value ^= (value & 0x7fu) << 5;"),
    Mutant("length of a frame", CORE, "station_body_size(bytes[0]) + 2 != length", "station_body_size(bytes[0]) + 2 > length"),
    Mutant("receive buffer", CORE, "core->received < STATION_FRAME_BYTES", "core->received <= STATION_FRAME_BYTES"),
    Mutant("unstuffing within the frame", FRAME, "code - 1 > length - read", "code - 2 > length - read"),
    Mutant("session in the CRC", CORE, "(STATION_CRC_START ^ session), bytes, length) == 0", "(STATION_CRC_START ^ 0), bytes, length) == 0"),
    Mutant("no command without a session", CORE, "[STATION_EVENT_COMMAND].next == STATION_FOREIGN)", "[STATION_EVENT_COMMAND].next == STATION_FOREIGN && 0)"),
    Mutant("session 0 refused", CORE, "if (message.session == 0) {", "if (message.session == 0 && 0) {"),
    Mutant("window above", CORE, "ahead > STATION_INDEX_WINDOW ||", "ahead > STATION_INDEX_WINDOW + 1 ||"),
    Mutant("window below", CORE, "ahead < -STATION_INDEX_WINDOW", "ahead < -STATION_INDEX_WINDOW - 1"),
    Mutant("late", CORE, "if (ahead < 0) {", "if (ahead < -1) {"),
    Mutant("early", CORE, "ahead >= core->config.answer_ticks ||", "ahead > core->config.answer_ticks ||"),
    Mutant("before the first sample", CORE, "|| ahead < core->first_ticks) {", "|| 0) {"),
    Mutant("first ticks count down", CORE, "            core->first_ticks--;", "            core->first_ticks = 0;"),
    Mutant("repeated", CORE, "if (core->slot_full[slot]) {\n        core->news", "if (0) {\n        core->news"),
    Mutant("limit above", CORE, "if (message.command > limit) {", "if (message.command > limit + 1) {"),
    Mutant("limit below", CORE, "} else if (message.command < -limit) {", "} else if (message.command < -limit - 1) {"),
    Mutant("limit: cut to it", CORE, "(int16_t)-limit;", "(int16_t)(-limit - 1);"),
    Mutant("limit: only tightened", CORE, "wanted->command_limit > board->command_limit", "0"),
    Mutant("limit: not negative", CORE, "wanted->command_limit < 0 ||", ""),
    Mutant("limits of motion only tightened", CORE, "return own == 0 || *wanted <= own;", "return 1;"),
    Mutant("limits of motion default to the board's", CORE, "    if (*wanted == 0) {\n        *wanted = own;\n    }\n", ""),
    Mutant("travel", CORE, "core->origin) > limits->travel_limit", "core->origin) > limits->travel_limit + 1"),
    Mutant("travel from the start", CORE, "        core->origin = core->encoder;\n", ""),
    Mutant("speed", CORE, "speed > limits->speed_limit", "speed > limits->speed_limit + 1u"),
    Mutant("speed over all its ticks", CORE, "% STATION_SPEED_TICKS);", "% (STATION_SPEED_TICKS - 1));"),
    Mutant("stall: level", CORE, "core->drive > level ||", "core->drive > level + 1 ||"),
    Mutant("stall: time", CORE, "stalled > core->stall_ticks_need", "stalled > core->stall_ticks_need + 1"),
    Mutant("stall: either way", CORE, "|| core->drive < -level;", ";"),
    Mutant("hold", CORE, "core->silent > core->config.hold_ticks", "core->silent > core->config.hold_ticks + 1"),
    Mutant("hold ends in zero", CORE, "(void)happen(core, STATION_EVENT_ZEROED);\n        core->drive = 0;", "(void)happen(core, STATION_EVENT_ZEROED);"),
    Mutant("fault", CORE, "core->silent >= core->config.fault_ticks", "core->silent > core->config.fault_ticks"),
    Mutant("silence ends with a command", CORE, "        core->silent = 0;\n        core->drive", "        core->drive"),
    Mutant("silence of an earlier session", CORE, "    core->silent = 0;\n    core->news", "    core->news"),
    Mutant("hold bound", CORE, "wanted.hold_ticks > STATION_HOLD_TICKS_MAX", "wanted.hold_ticks > STATION_HOLD_TICKS_MAX + 1"),
    Mutant("fault bound", CORE, "wanted.fault_ticks > fault_ticks_max", "wanted.fault_ticks > fault_ticks_max + 1"),
    Mutant("fault after hold", CORE, "wanted.fault_ticks <= wanted.hold_ticks", "wanted.fault_ticks < wanted.hold_ticks"),
    Mutant("answer bound", CORE, "wanted.answer_ticks > STATION_ANSWER_TICKS_MAX", "wanted.answer_ticks > STATION_ANSWER_TICKS_MAX + 1"),
    Mutant("rate bound", CORE, "wanted.rate > core->board.rate_max", "0"),
    Mutant("line budget", CORE, "if (!carries(&core->board, &wanted)) {", "if (0) {"),
    Mutant("line budget: each frame within a period", CORE, "return sample <= period &&", "return"),
    Mutant("stop: the drive", CORE, "static void motor_off(station_core *core)\n{\n    core->drive = 0;", "static void motor_off(station_core *core)\n{"),
    Mutant("stop: latched commands", CORE, "    memset(core->slot_full, 0, sizeof core->slot_full);\n", ""),
    Mutant("what leaves running is off", CORE, "if (cell->next != STATION_STATE_RUNNING) {", "if (cell->next == STATION_STATE_FAULT) {"),
    Mutant("clear: not with an open e-stop", CORE, "if (core->estop) {\n        return", "if (0) {\n        return"),
    Mutant("clear: the fault's code", CORE, "    core->fault = STATION_FAULT_NONE;\n", ""),
    Mutant("e-stop", CORE, "(void)happen(core, STATION_EVENT_ESTOP);", ";"),
    Mutant("overrun", CORE, "(void)happen(core, STATION_EVENT_OVERRUN);", ";"),
    Mutant("host gone", CORE, "(void)happen(core, STATION_EVENT_HOST_GONE);", ";"),
    Mutant("armed ends", CORE, "(void)happen(core, STATION_EVENT_EXPIRE);", ";"),
    Mutant("armed: no more time for asking", CORE, "if (core->state == STATION_STATE_ARMED) {", "if (0) {"),
    Mutant("challenge serves once", CORE, "    core->spent = 1;\n", ""),
    Mutant("challenge to arm", CORE, "if (message.challenge != core->challenge) {\n        return STATION_RESULT_STALE;\n    }\n    if (core->state", "if (core->state"),
    Mutant("challenge to start", CORE, "if (message.challenge != core->challenge) {\n        return STATION_RESULT_STALE;\n    }\n    memset", "memset"),
    Mutant("challenge: the clock in it", CORE, "core->random ^= input->clock;", ";"),
    Mutant("challenge: another each time", CORE, "core->random = next_random(core->random);", ";"),
    Mutant("configure since identify", CORE, "    core->configured = 0;\n    core->spent", "    core->spent"),
    Mutant("configure for each run", CORE, "    core->configured = 0; /* the next", "    /* the next"),
    Mutant("protocol trusted", CORE, "if (!core->trusted) {", "if (0) {"),
    Mutant("zero only at rest", CORE, "if (standing(core) & STATION_STATUS_MOVING) {", "if (0) {"),
    Mutant("zero is no motion", CORE, "    core->past_known = 0;\n", ""),
    Mutant("enable", CORE, "output->enable = core->state == STATION_STATE_RUNNING;", "output->enable = 1;"),
    Mutant("enable is read", SIMULATED, "self._source.advance(self.core.drive, self.core.enabled)", "self._source.advance(self.core.drive, True)"),
    Mutant("transmit margin", CORE, "core->transmit + length + WIRE_MARGIN >", "core->transmit + length >"),
    Mutant("samples that were sent", CORE, "? STATION_COUNT_SAMPLES : STATION_COUNT_UNSENT_SAMPLES", "? STATION_COUNT_SAMPLES : STATION_COUNT_SAMPLES"),
    Mutant("a late tick is told", CORE, "status |= STATION_STATUS_WOKE_LATE;", ";"),
    Mutant("host: the rig's limit is sent", RUN, "min(math.floor(limit), identity.command_limit)", "identity.command_limit"),
    Mutant("host: old samples are not new", ENGINE, "if step == 0 or step >= 0x8000:", "if step == 0:"),
    Mutant("host: limits are sent", CLIENT, "travel_limit=held.travel", "travel_limit=0"),
    Mutant("host: the tighter limit", CLIENT, "held = (limits or NO_LIMITS).within(self._limits)", "held = limits or NO_LIMITS"),
)


def apply(mutant: Mutant, folder: Path) -> None:
    """A copy of the project with the mutant in it."""
    for name in ("station", "firmware", "tests", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.svg", "*.png"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    path = folder / mutant.path
    text = path.read_text(encoding="utf-8")
    if text.count(mutant.old) < 1:
        raise SystemExit(f"{mutant.guards}: {mutant.path} has no line {mutant.old!r}; the mutant must be renewed")
    path.write_text(text.replace(mutant.old, mutant.new, 1), encoding="utf-8")


def killed_by(mutant: Mutant) -> str:
    """The first test that the mutant turns red, "" for none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        apply(mutant, folder)
        environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1",
                                    "HYPOTHESIS_STORAGE_DIRECTORY": str(folder / "hypothesis")}
        done = subprocess.run([sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-n", "0",
                               "--no-header", "--ignore=tests/firmware/test_sources.py", *TESTS], cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode == 0:
            return ""
        failed = [line for line in done.stdout.splitlines() if line.startswith(("_", "ERROR")) and " " in line]
        return failed[0].strip("_ ") if failed else done.stdout.splitlines()[-1]


def main() -> int:
    """Try each; print who kills it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="mutants whose words hold this")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    chosen = [mutant for mutant in MUTANTS if options.only in mutant.guards]
    if options.list:
        print("\n".join(mutant.guards for mutant in chosen))
        return 0
    begun, survivors = time.perf_counter(), 0
    for mutant in chosen:
        found = killed_by(mutant)
        survivors += not found
        print(f"{'killed' if found else 'SURVIVED'}  {mutant.guards}  {found}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} killed in {time.perf_counter() - begun:.0f} s")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())

"""The mutants of scripts/bench/mutants.py: each still breaks a line that is there, and one of them is tried."""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "bench" / "mutants.py"


def test_every_mutant_breaks_a_line_that_is_there():
    mutants = tomllib.loads(SCRIPT.with_suffix(".toml").read_text(encoding="utf-8"))["mutant"]
    assert len({mutant["guards"] for mutant in mutants}) == len(mutants) >= 70
    for mutant in mutants:
        text = (ROOT / mutant["file"]).read_text(encoding="utf-8")
        assert mutant["old"] in text, mutant["guards"]
        assert text.replace(mutant["old"], mutant["new"], 1) != text, mutant["guards"]


def test_a_mutant_of_the_limit_turns_a_test_red():
    done = subprocess.run([sys.executable, str(SCRIPT), "--only", "limit above"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 of 1 killed" in done.stdout

"""`python -m tests.truth SEED [EFFECT ...] --out DIR`: one blind case as CSV runs, its truth sealed in
truth.json."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from station.runs.run import Run

from . import make_case


def write_csv(run: Run, path: Path) -> None:
    """The contract's CSV form; a rig without accelerometer has an empty last column left out."""
    columns = {"t": run.t, "reference": run.reference, "command": run.command, "encoder": run.encoder}
    if run.accel is not None:
        columns["accel"] = run.accel
    keys = ("rig", "controller", "test", "zero_id", "start", "command_row", "accel_zero")
    known = run.metadata.model_dump(include=set(keys))
    lines = [f"# {k} = {json.dumps(known[k])}" for k in keys] + [",".join(columns)]
    lines += [",".join(f"{v:.10g}" for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """Parse the arguments, make the case, write it."""
    parser = argparse.ArgumentParser(prog="python -m tests.truth", description=__doc__)
    parser.add_argument("seed", type=int)
    parser.add_argument("effect", nargs="*", help="names of effects, or parameter:TABLE.KEY; none: a clean rig")
    parser.add_argument("--band", choices=["clear", "subtle", "drawn"], default="clear")
    parser.add_argument("--disturbance", type=float, default=0.0, metavar="LEVEL",
                        help="share of command torque and accelerometer signal that the world disturbs; 0.02 is 2 %%")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    case = make_case(args.seed, args.effect, band=None if args.band == "drawn" else args.band,
                     disturbance=args.disturbance)
    args.out.mkdir(parents=True, exist_ok=True)
    for run in case.runs:
        write_csv(run, args.out / f"{run.name}.csv")
    (args.out / "truth.json").write_text(json.dumps(case.truth, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()

"""`station unseal`: what is hidden in a sealed simulated rig, and whether a diagnosis has found it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from station.cli.options import Json, Overwrite, command, need_outputs
from station.cli.terminal import as_json, say, spoken, write_text
from station.errors import UsageError, WorkError

app = typer.Typer()


@command(app, "unseal", "Start here", "station unseal sealed-1")
def unseal(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A sealed rig, as `station ports` lists them.")],
    diagnosis: Annotated[Path | None, typer.Option("--diagnosis", metavar="FILE", help=(
        "What `station diagnose --json` wrote of runs on it: say whether it was right."))] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Write the hidden rig (TOML).")] = None,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Open the seal of a simulated rig: what is hidden behind sim://sealed-1, and whether it was found."""
    from station.cli.demo import told
    from station.device.sealed import fingerprint, sealed_text, simulated_rig
    from station.diagnose.result import Diagnosis

    need_outputs(out, json, overwrite=overwrite, inputs=[diagnosis])
    text = sealed_text(name.removeprefix("sim://"))
    name = name.removeprefix("sim://")
    found = None
    if diagnosis is not None:
        try:
            found = Diagnosis.model_validate_json(diagnosis.read_bytes())
        except OSError as error:
            raise WorkError(f"{diagnosis}: {error.strerror or error}") from None
        except ValueError:
            raise UsageError(f"{diagnosis}: not a diagnosis; `station diagnose --json` writes one") from None
    hidden = simulated_rig(name).effects[0]
    with spoken(json):
        for line in told(hidden, found):
            say(line.strip())
        if out is not None:
            write_text(out, text, overwrite)
            say(f"{out}: the hidden rig, SHA-256 {fingerprint(name)}")
    place = hidden.name, hidden.at
    as_json(json, {"name": name, "sha256": fingerprint(name),
                   "hidden": {"effect": hidden.name, "at": hidden.at, "parameters": hidden.values()},
                   "named": None if found is None else place in [(c.effect, c.at) for c in found.causes],
                   "first": None if found is None else bool(found.causes)
                   and place == (found.causes[0].effect, found.causes[0].at)}, overwrite)

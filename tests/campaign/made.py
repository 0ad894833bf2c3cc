"""Outcomes made up by hand, with answers that can be worked out by hand."""

from __future__ import annotations

from typing import Any

from station.campaign.outcome import Outcome

DEAD_ZONE, COULOMB, BASE = ("dead_zone", "amplifier"), ("coulomb_friction", "motor"), ("coulomb_friction", "base")


def cause(key: tuple[str, str], probability: float, rivals: dict[tuple[str, str], float] | None = None,
          **values: tuple[float, float]) -> dict[str, Any]:
    """As a diagnosis file holds it; `values` are the ends of intervals."""
    return {"effect": key[0], "at": key[1], "probability": probability,
            "parameters": {name: {"value": (low + high) / 2, "low": low, "high": high, "unit": "1"}
                           for name, (low, high) in values.items()},
            "rivals": [{"effect": effect, "at": at, "probability": p} for (effect, at), p in (rivals or {}).items()]}


def hidden(key: tuple[str, str], **values: float) -> dict[str, Any]:
    return {"effect": key[0], "at": key[1], **values}


def outcome(label: str, there: list[dict[str, Any]] | None, causes: list[dict[str, Any]], verdict: str = "explained",
            before: float = 0.4, after: float = 0.1, explained: float | None = 0.9, **more: Any) -> Outcome:
    gain = {"held_out": [], "encoder": {"nrmse_before": before, "nrmse_after": after}, "accel": None,
            "explained_fraction": explained}
    group = "logs" if there is None else "clean" if not there else "single" if len(there) == 1 else "pair"
    return Outcome(label, more.pop("group", group), hidden=there, verdict=verdict, causes=causes, gain=gain, **more)

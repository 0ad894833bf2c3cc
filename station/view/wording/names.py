"""What verdicts, channels and causes are called."""

from __future__ import annotations

import re
from collections.abc import Sequence

from station.estimation.cause import constant_path, is_constant
from station.model.effects import catalogue

VERDICTS = {"explained": "explained", "partly_explained": "partly explained", "unexplained": "unexplained",
            "nothing_missing": "nothing missing", "ambiguous": "ambiguous", "not_enough_data": "not enough data"}
CHANNELS = {"encoder": "angle", "accel": "acceleration"}
STATES = {"determined": "determined by these runs", "at_bound": "at a bound",
          "traded_off": "known only together with another",
          "not_excited": "not told by these runs; known only as it was beforehand"}
LATENCY = "loop_latency"
"""How a delay is called that stands at the encoder or at the input, and nothing tells at which."""
_INSIDE = {"drive", "clamp", "accelerometer", "encoder", "clock", "amplifier"}
_TITLES = {LATENCY: "latency in the loop (encoder or input)", "none": "none of these", "nothing": "nothing missing",
           "": "nothing missing"}


def constant_title(path: str) -> str:
    """``beam.mass_per_length`` -> ``beam mass per length``."""
    return path.replace(".", " ").replace("_", " ")


def cause_title(effect: str, at: str) -> str:
    """``Coulomb friction at the motor``, ``wrong tip mass``."""
    if is_constant(effect):
        return f"wrong {constant_title(constant_path(effect))}"
    if effect in _TITLES:
        return _TITLES[effect]
    known = catalogue().get(effect)
    title = known.title if known is not None and known.title else effect.replace("_", " ")
    return title if not at or at in title else f"{title} {place(at)}"


def place(at: str) -> str:
    """``at the motor``, ``in the drive``."""
    return f"{'in' if at in _INSIDE else 'at'} the {at}"


def joined(words: Sequence[str], last: str = "and") -> str:
    """Words joined: ``a``, ``a and b``, ``a, b and c``."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def plain(text: str) -> str:
    """A diagnosis' own note with causes by their titles: ``dead_zone@amplifier`` is a dead zone in the amplifier."""
    known = "|".join(sorted(map(re.escape, catalogue()), key=len, reverse=True))
    text = re.sub(rf"\b({known})(?:@| at )(\w+)", lambda m: cause_title(m[1], m[2]), text)
    text = re.sub(r"\bparameter:(\w+\.\w+)(?:@(?!\w))?", lambda m: cause_title(m[0].rstrip("@"), ""), text)
    return text.replace("chi^2", "χ²")


def sentence(text: str) -> str:
    """A clause with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."

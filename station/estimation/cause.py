"""What a cause is called: an effect at a place, or a constant of the rig that is off."""

from __future__ import annotations

Key = tuple[str, str]
"""A cause: (effect, at), or ("parameter:TABLE.KEY", "")."""
Causes = frozenset[Key]
Sizes = dict[Key, dict[str, float]]
"""By cause, the parameters' values."""

_PREFIX = "parameter:"


def constant(path: str) -> Key:
    """The cause that the constant ``path``, TABLE.KEY, is off."""
    return _PREFIX + path, ""


def in_words(cause: Key) -> str:
    """``input_delay at amplifier``, ``parameter:tip.mass``."""
    return " at ".join(filter(None, cause))


def is_constant(effect: str) -> bool:
    """Whether the cause's first word names a constant of the rig, not an effect."""
    return effect.startswith(_PREFIX)


def constant_path(effect: str) -> str:
    """``parameter:tip.mass`` -> ``tip.mass``."""
    return effect.removeprefix(_PREFIX)

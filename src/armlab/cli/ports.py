"""UDP ports on which robots are listened to: as they were typed, or as the settings know them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["known_ports", "ports_in"]

_ONE, _FIRST = 6510, 6511  # of one arm, of the first of several


def ports_in(text: str) -> list[int]:
    """Return the ports in a text such as ``6511,6512``.

    Parameters
    ----------
    text : as typed.

    Raises
    ------
    ConfigError : something else, or a port that cannot be.
    """
    words = [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and 0 < int(word) < 65536 for word in words):
        raise ConfigError(f"Expected ports from 1 to 65535, such as --port 6511,6512, got {text!r}.")
    return [int(word) for word in words]


def known_ports(arms: Sequence[Robot]) -> list[int]:
    """Return a port per arm: the one of the settings, else 6510 of one arm, 6511, 6512, ... of several.

    Parameters
    ----------
    arms : that are listened to.

    Raises
    ------
    ConfigError : settings that cannot be read.
    """
    from armlab.cli.settings import load_settings

    known = load_settings().settings.ports
    return [known.get(arm.name, _ONE if len(arms) == 1 else _FIRST + k) for k, arm in enumerate(arms)]

"""Codecs by name: our own, and those that installed packages bring as entry points."""

from __future__ import annotations

from armlab.errors import ConfigError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm import Codec, EgmCodec

__all__ = ["GROUP", "codec_named"]

GROUP = "armlab.bridge.codecs"
"""Group of entry points; each is a function from a Robot to its `wire.egm.Codec`."""

_METHODS = ("capabilities", "reset", "decode", "encode")


def codec_named(name: str, robot: Robot, extension: bool = False) -> Codec:
    """Return a new codec for a robot.

    Parameters
    ----------
    name : "egm", or the name of an entry point. robot : the arm. extension : of "egm", see `EgmCodec`.

    Raises
    ------
    UnknownName : no such codec; lists those that exist. ConfigError : an entry point that gives none.
    """
    if name == "egm":
        return EgmCodec(robot, extension)
    from importlib.metadata import entry_points

    brought = entry_points(group=GROUP)
    if name not in brought.names:
        raise UnknownName.among("codec", name, ["egm", *sorted(brought.names)])
    point = brought[name]
    try:
        codec = point.load()(robot)
    except Exception as error:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to make a codec for {robot.name}, but it raised "
            f"{type(error).__name__}: {error}."
        ) from error
    missing = [method for method in _METHODS if not hasattr(codec, method)]
    if missing:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to make a codec, got {type(codec).__name__} without "
            f"{', '.join(missing)}. See wire.egm.Codec."
        )
    return codec

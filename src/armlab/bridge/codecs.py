"""Codecs by name: our own, and those that installed packages bring as entry points."""

from __future__ import annotations

from collections.abc import Sequence

from armlab.errors import ConfigError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm import Codec, EgmCodec

__all__ = ["GROUP", "codec_named", "codecs_of"]

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


def codecs_of(
    codec: str | Codec | Sequence[Codec], robots: Sequence[Robot], extension: bool, spares: int
) -> list[tuple[Codec, tuple[Codec, ...]]]:
    """Return the codec of each arm and those of its rehearsals, which an object of the user's does not have.

    Parameters
    ----------
    codec : name of a codec, made once for an arm and once for each rehearsal; or an object for each arm.
    robots : the arms. extension : of "egm". spares : rehearsals of each arm.

    Raises
    ------
    UnknownName, ConfigError : as of `codec_named`; objects that are no codecs, or not one for each arm.
    """
    if isinstance(codec, str):
        made = [[codec_named(codec, robot, extension) for _ in range(1 + spares)] for robot in robots]
        return [(own, tuple(others)) for own, *others in made]
    given = list(codec) if isinstance(codec, Sequence) else [codec]
    for one in given:
        if not all(hasattr(one, method) for method in _METHODS):
            raise ConfigError(f"Expected the name of a codec, or one like wire.egm.Codec, got {one!r}.")
    if len(given) != len(robots):
        raise ConfigError(f"Expected one codec per arm, since each follows one session, got {len(given)}.")
    return [(one, ()) for one in given]

"""Values of options: checks of numbers, URLs of links, UDP ports."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import quote

from cyclopts import Parameter

import armlab
from armlab.errors import ConfigError, ShapeError

if TYPE_CHECKING:
    from armlab.robots import Robot

Json = Annotated[bool, Parameter(help="Print JSON for scripts.")]
Force = Annotated[bool, Parameter(help="Replace existing files.")]
Seconds = Annotated[float | None, Parameter(help="Time after which to end [s].")]
# contact.Method, which takes too long to import for a help text
ForceMethod = Literal["map", "bounded", "interval", "observer", "kf", "clip", "ls", "lund"]
Cell = Annotated[str, Parameter(help="Name of the cell; needed when several run.")]


@contextmanager
def as_given() -> Iterator[None]:
    """Take what the library refuses as wrong use: the block, or function, works on the words of a command alone."""
    try:
        yield
    except ShapeError as error:
        raise ConfigError(str(error)) from error


def require_positive(option: str, value: float | None, unit: str = "") -> None:
    """Refuse a number that is not above zero and finite; None was not given."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"Expected --{option} above 0{f' {unit}' if unit else ''} and finite, got {value:g}.")


def require_seconds(value: float | None) -> None:
    """Refuse a time to wait that is negative or none; None was not given."""
    if value is not None and not value >= 0.0:
        raise ConfigError(f"Expected seconds of at least 0 s, got {value}.")


def simulated(word: str) -> Robot:
    """Return the robot that ``armlab sim`` simulates under a word."""
    if word == "scara":
        from armlab.sim.arm.arm import scara

        return scara()
    return armlab.robots.load(word)


def links_to(robot: str, arms: Sequence[Robot], link: str | None) -> list[str]:
    """Return the url of each link to arms, of words with commas between; None simulates what was typed."""
    from armlab.bridge.urls import addresses

    same = f"sim://{'+'.join(quote(word) for word in robot.split('+'))}"
    urls = [same] if link is None else link.split(",")
    for arm, address in zip(arms, addresses(urls, len(arms)), strict=True):
        if link is not None and address.scheme == "sim" and simulated(address.robot) != arm:
            raise ConfigError(
                f"Expected a link to {robot}, got {link}, another arm. Name the arm as ROBOT, or give the link {same}."
            )
    return urls


def joints_in(words: str, n: int) -> list[int]:
    """Return numbers of joints from 0."""
    numbers = [int(word) if word.strip().isdecimal() else 0 for word in words.split(",")]
    if not all(1 <= number <= n for number in numbers):
        raise ConfigError(f"Expected joints as numbers from 1 to {n} with commas between, got {words!r}.")
    return [number - 1 for number in numbers]


_ONE, _FIRST = 6510, 6511  # of one arm, of the first of several


def ports_in(text: str) -> list[int]:
    """Return the ports in a text such as ``6511,6512``."""
    words = [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and 0 < int(word) < 65536 for word in words):
        raise ConfigError(f"Expected ports from 1 to 65535, such as --port 6511,6512, got {text!r}.")
    return [int(word) for word in words]


def known_ports(arms: Sequence[Robot]) -> list[int]:
    """Return a port per arm: the one of the settings, else 6510 of one arm, 6511, 6512, ... of several."""
    from armlab.cli.support.settings import load_settings

    known = load_settings().settings.ports
    return [known.get(arm.name, _ONE if len(arms) == 1 else _FIRST + k) for k, arm in enumerate(arms)]

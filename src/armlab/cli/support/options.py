"""Option values: numbers, robots, link URLs and UDP ports."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import quote, urlencode

from cyclopts import Parameter

from armlab.errors import ConfigError, ShapeError

if TYPE_CHECKING:
    from armlab.robots import Robot

Json = Annotated[bool, Parameter(help="Print JSON for scripts.")]
Force = Annotated[bool, Parameter(help="Replace existing files.")]
Output = Annotated[Path, Parameter(alias="-o")]
OptionalOutput = Annotated[Path | None, Parameter(alias="-o")]
Seconds = Annotated[float | None, Parameter(help="Stop after this time [s].")]
Columns = Annotated[
    str | None,
    Parameter(
        help="Columns of a file from another program, with unit and factor where needed: "
        "q=joint_{1..6}_pos [deg],tau=current_{1..6}*12.5. For a file without a header, give column numbers: "
        "t=1,q={2..7}. Presets: ur, franka, ros, abb, abb7."
    ),
]
# a copy of contact.Method, which is too slow to import for --help
ForceMethod = Literal["map", "bounded", "interval", "observer", "kf", "clip", "ls", "lund", "ols"]
Cell = Annotated[str, Parameter(help="Name of the cell; required if several cells are running.")]


@contextmanager
def as_given() -> Iterator[None]:
    """Convert ShapeError to a usage error in a block that only processes options; also used as a decorator."""
    try:
        yield
    except ShapeError as error:
        raise ConfigError(str(error)) from error


def require_positive(option: str, value: float | None, unit: str = "") -> None:
    """Reject a number that is not positive and finite; None is accepted."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"Expected a finite --{option} above 0{f' {unit}' if unit else ''}, got {value:g}.")


def require_seconds(value: float | None) -> None:
    """Reject a negative or NaN waiting time; None is accepted."""
    if value is not None and not value >= 0.0:
        raise ConfigError(f"Expected a time of at least 0 s, got {value}.")


_URDF_OPTIONS = ("base", "tip", "lock")
_chosen: dict[str, str] = {}  # options that select the arm of a URDF, for all robots of the command


def take_robot_options(words: Sequence[str]) -> list[str]:
    """Return the command-line arguments without --base, --tip and --lock, which `load_robot` then applies."""
    _chosen.clear()
    left, waiting = [], list(words)
    while waiting:
        word = waiting.pop(0)
        name, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or name not in _URDF_OPTIONS:
            left.append(word)
            continue
        if not equals:
            if not waiting or waiting[0].startswith("--"):
                raise ConfigError(
                    f"Expected {'JOINT=VALUE' if name == 'lock' else 'a link'} after --{name}, got nothing."
                )
            value = waiting.pop(0)
        _chosen[name] = f"{_chosen[name]},{value}" if name == "lock" and name in _chosen else value
    return left


def load_robot(word: str) -> Robot:
    """Return the robot named on the command line; for a URDF, the arm selected by --base, --tip and --lock."""
    from armlab.robots.files import load_chosen

    return load_chosen(word, _chosen)


def is_arm_chosen() -> bool:
    """Return whether --base, --tip or --lock selects an arm of a URDF."""
    return bool(_chosen)


def as_typed(word: str) -> list[str]:
    """Return the robot and the options that select its arm, as arguments of another command."""
    return [word, *(part for name, value in _chosen.items() for part in (f"--{name}", value))]


def mesh_option(word: str) -> list[str]:
    """Return the option --robot for a description that may have meshes; otherwise an empty list."""
    from armlab.robots.files import names

    return [] if word in names() or word.endswith(".toml") else ["--robot", *as_typed(word)]


def simulated(word: str) -> Robot:
    """Return the robot of ``armlab sim`` for a library name, a file or scara."""
    if word == "scara":
        from armlab.sim.arm.arm import scara

        return scara()
    return load_robot(word)


def sim_url(robots: str, **options: object) -> str:
    """Return the URL of simulated robots, with names joined by + and, for a URDF, the selected arm."""
    query = urlencode({**_chosen, **options})
    return f"sim://{'+'.join(quote(word) for word in robots.split('+'))}{query and '?'}{query}"


def links_to(robot: str, arms: Sequence[Robot], link: str | None) -> list[str]:
    """Return the URL of each link in a comma-separated list; None means simulation."""
    from armlab.bridge.urls import addresses, choosing_arm

    same = sim_url(robot)
    urls = [same] if link is None else [choosing_arm(url, _chosen) for url in link.split(",")]
    for arm, address in zip(arms, addresses(urls, len(arms)), strict=True):
        if link is not None and address.scheme == "sim" and simulated(address.robot) != arm:
            raise ConfigError(
                f"Expected a link to {robot}, got {link}, a different arm. Pass this arm as ROBOT, or use the link "
                f"{same}."
            )
    return urls


def joints_in(words: str, n: int) -> list[int]:
    """Return joint indices from 0 for comma-separated joint numbers from 1."""
    numbers = [int(word) if word.strip().isdecimal() else 0 for word in words.split(",")]
    if not all(1 <= number <= n for number in numbers):
        raise ConfigError(f"Expected joint numbers from 1 to {n}, separated by commas, got {words!r}.")
    return [number - 1 for number in numbers]


_ONE, _FIRST = 6510, 6511  # port of a single arm, first port of several arms


def ports_in(text: str) -> list[int]:
    """Parse ports such as ``6511,6512``."""
    words = [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and 0 < int(word) < 65536 for word in words):
        raise ConfigError(f"Expected ports from 1 to 65535, such as --port 6511,6512, got {text!r}.")
    return [int(word) for word in words]


def known_ports(arms: Sequence[Robot]) -> list[int]:
    """Return one port per arm: from the settings, else 6510 for a single arm and 6511, 6512, ... for several arms."""
    from armlab.cli.support.settings import load_settings

    known = load_settings().settings.ports
    return [known.get(arm.name, _ONE if len(arms) == 1 else _FIRST + k) for k, arm in enumerate(arms)]


def seconds_in(text: str, option: str) -> float:
    """Return a duration such as ``20ms``, ``0.02s`` or ``0.02`` in seconds."""
    found = re.fullmatch(r"([\d.eE+-]+)\s*(us|ms|s)?", text.strip())
    with suppress(ValueError):
        seconds = float(found[1]) * {"us": 1e-6, "ms": 1e-3}.get(found[2] or "s", 1.0) if found else math.nan
        if seconds > 0.0 and math.isfinite(seconds):
            return seconds
    raise ConfigError(f"Expected --{option} to be a time above 0, such as 20ms or 0.02s, got {text!r}.")

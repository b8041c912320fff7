"""Links of commands that move an arm: as given, or to the simulated robot of the same description."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING
from urllib.parse import quote

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["links_to", "simulated"]


def simulated(word: str) -> Robot:
    """Return the robot that ``armlab sim`` simulates under a word.

    Parameters
    ----------
    word : name in the library, a robot file, or scara.

    Raises
    ------
    UnknownName, RobotError : as `robots.load`.
    """
    from armlab import robots

    if word == "scara":
        from armlab.sim.scara import scara

        return scara()
    return robots.load(word)


def links_to(robot: str, arms: Sequence[Robot], link: str | None) -> list[str]:
    """Return the url of each link to arms.

    Parameters
    ----------
    robot : ROBOT as typed: names or files with plus signs between. arms : what they describe.
    link : urls with commas between; None simulates what was typed.

    Raises
    ------
    ConfigError : links that cannot be, or that simulate other arms: the log would say that it is of these.
    """
    from armlab.bridge.urls import addresses

    same = f"sim://{'+'.join(quote(word) for word in robot.split('+'))}"
    urls = [same] if link is None else link.split(",")
    for arm, address in zip(arms, addresses(urls, len(arms)), strict=True):
        if link is not None and address.scheme == "sim" and simulated(address.robot) != arm:
            raise ConfigError(
                f"Expected a link to {robot}, got {link}, another arm. Name the arm as ROBOT, or give the link {same}."
            )
    return urls

"""`examine`: whether computer, network and robot are ready for a run. Sends nothing to a robot."""

from __future__ import annotations

from collections.abc import Sequence

from armlab.bridge.doctor.machine import Finding, machine
from armlab.bridge.doctor.network import addresses, firewall, listen, local_addresses
from armlab.errors import ConfigError
from armlab.robots import Robot

__all__ = ["DEFAULT_PORTS", "LONGEST", "examine"]

DEFAULT_PORTS = (6510, 6511, 6512)
"""Of one arm, of the left and of the right arm."""

LONGEST = 3600.0
"""To listen [s]."""


def examine(
    ports: Sequence[int] | None = None,
    seconds: float = 5.0,
    robots: Sequence[Robot] | None = None,
    wake_up: float = 2.0,
) -> list[Finding]:
    """Return what every check found: the computer first, then the network and what comes to the ports.

    Parameters
    ----------
    ports : UDP ports to listen on; `DEFAULT_PORTS` when None.
    seconds : how long.
    robots : the arm at each port, to compare the number of axes and the posture with; none: any arm.
    wake_up : seconds for the histogram of wake-ups.

    Raises
    ------
    ConfigError : ports, seconds or robots that cannot be.
    """
    numbers = list(DEFAULT_PORTS if ports is None else ports)
    if not numbers or any(not 0 <= number < 65536 for number in numbers) or len(set(numbers)) < len(numbers):
        raise ConfigError(f"Expected different UDP ports from 0 to 65535, got {numbers}.")
    if not 0.0 < seconds <= LONGEST:
        raise ConfigError(f"Expected seconds in (0, {LONGEST:g}], got {seconds}.")
    if robots and len(robots) != len(numbers):
        raise ConfigError(f"Expected one robot per port, got {len(robots)} robots and {len(numbers)} ports.")
    arms: list[Robot | None] = list(robots) if robots else [None] * len(numbers)
    return [*machine(wake_up), addresses(local_addresses()), firewall(), *listen(numbers, seconds, arms, bool(ports))]

"""`examine`: whether computer, network and robot are ready for a run; what comes to the EGM ports of this computer.

Sends nothing to a robot.
"""

from __future__ import annotations

import secrets
import select
import socket
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from armlab.bridge.doctor.egm_listener import EgmListener
from armlab.bridge.doctor.machine import Finding, machine
from armlab.bridge.net.sockets import Port, local_addresses
from armlab.errors import ConfigError, LinkError
from armlab.robots import Robot

__all__ = ["DEFAULT_PORTS", "LONGEST", "addresses", "examine", "firewall", "listen", "route_to"]

_FIREWALL = Path("/etc/ufw/ufw.conf")
_SELF_TEST = 0.2  # s at least for the self-test to come back


def addresses(found: Mapping[str, str]) -> Finding:
    """Check that other computers can reach this one at all."""
    value = ", ".join(f"{interface} {address}" for interface, address in found.items()) or "none"
    outside = [address for address in found.values() if not address.startswith("127.")]
    advice = "Only a simulated robot can reach this computer: plug in the cable to the controller, set an address."
    return Finding.judged("addresses", "warning", not outside, value, advice)


def route_to(host: str) -> str:
    """Return the address from which this computer would send to a host, "" when there is no route. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))  # of UDP: only chooses the route
        except OSError:
            return ""
        return probe.getsockname()[0]


def firewall(file: Path = _FIREWALL) -> Finding:
    """Tell whether the firewall ufw is switched on; its rules can be read by root only."""
    is_on = False
    with suppress(OSError), file.open(encoding="utf-8") as opened:
        is_on = any(line.strip().lower() == "enabled=yes" for line in opened)
    value = "ufw is on" if is_on else "no ufw that is on"
    return Finding.judged("firewall", "warning", is_on, value, "Let packets of robots in: sudo ufw allow 6510:6512/udp")


class _PortListener:
    """One bound port, a token that it sends to itself, and what others send."""

    def __init__(self, port: Port, robot: Robot | None) -> None:
        self.port, self.heard = port, EgmListener(port.port, robot)
        self.token, self.came = secrets.token_bytes(16), set[str]()
        self.addresses = ["127.0.0.1", *(a for a in local_addresses().values() if a != "127.0.0.1")]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            for address in self.addresses:
                with suppress(OSError):
                    own.sendto(self.token + address.encode(), (address, port.port))

    def take(self) -> None:
        while (arrival := self.port.receive()) is not None:
            if arrival.data.startswith(self.token):
                self.came.add(arrival.data[len(self.token) :].decode())
            else:
                self.heard.add(arrival)

    def self_test(self) -> Finding:
        """Return whether what this computer sends to its own addresses arrives."""
        lost = [address for address in self.addresses if address not in self.came]
        value = f"{len(self.came)} of {len(self.addresses)} own addresses reach it"
        advice = f"A rule of this computer drops packets to {', '.join(lost)}: look at nft list ruleset, or ufw status."
        return Finding.judged(f"port {self.port.port}, self-test", "failure", bool(lost), value, advice)


def listen(numbers: Sequence[int], seconds: float, robots: Sequence[Robot | None], asked: bool) -> list[Finding]:
    """Bind ports, listen, and say what came. Nothing is sent but a token to this computer's own addresses."""
    found: list[Finding] = []
    listeners: list[_PortListener] = []
    for number, robot in zip(numbers, robots, strict=True):
        try:
            port = Port("0.0.0.0", number)
        except LinkError as error:
            found.append(Finding(f"port {number}", "failure", "cannot be listened on", str(error)))
            continue
        found.append(Finding(f"port {port.port}", "ok", "free"))
        listeners.append(_PortListener(port, robot))
    try:
        _wait(listeners, max(seconds, _SELF_TEST))
    finally:
        for listener in listeners:
            listener.port.close()
    found += [listener.self_test() for listener in listeners]
    silent = not any(listener.heard.senders for listener in listeners)
    for listener in listeners:
        if listener.heard.senders or asked or (silent and listener is listeners[0]):
            found += listener.heard.findings(max(seconds, _SELF_TEST))
            found += _routes(listener)
    return found


def _wait(listeners: Sequence[_PortListener], seconds: float) -> None:
    poller = select.poll()
    for listener in listeners:
        poller.register(listener.port.fileno(), select.POLLIN)
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        poller.poll(1e3 * min(left, 0.1))
        for listener in listeners:
            listener.take()


def _routes(listener: _PortListener) -> list[Finding]:
    name = f"port {listener.port.port}, route"
    hosts = sorted({host for host, _ in listener.heard.senders})
    routes = {host: route_to(host) for host in hosts}
    lost = [host for host, own in routes.items() if not own]
    value = ", ".join(f"replies to {host} leave from {own or 'nowhere'}" for host, own in routes.items())
    advice = f"Give this computer an address in the network of {', '.join(lost)}."
    return [Finding.judged(name, "failure", bool(lost), value, advice)] if hosts else []


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

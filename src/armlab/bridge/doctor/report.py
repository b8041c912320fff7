"""Pre-run check of the computer, the network and the robot, which sends nothing to the robot."""

from __future__ import annotations

import secrets
import select
import socket
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from armlab.bridge.control.feedback import not_ready_reason, outside_range
from armlab.bridge.control.session import Sample, Session
from armlab.bridge.doctor.machine import Finding, machine
from armlab.bridge.net.sockets import Arrival, Port, local_addresses
from armlab.errors import ConfigError, LinkError
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec

_SPREAD = 2e-3  # s: largest acceptable difference between the median and the 99th percentile of packet intervals
_REMEDY = {
    "the motors are off": "Switch the motors on; in manual mode, hold down the enabling device.",
    "RAPID is stopped": "Start RAPID from main on the pendant.",
    "guidance has not begun (EGMRunJoint)": (
        "This state is normal for streaming and lead-through. For motion, RAPID must reach EGMRunJoint "
        "(ArmlabJoint.mod)."
    ),
}
_OLD = {
    "6.06": (
        "This RobotWare version sends angles in radians; armlab accounts for this. Compare q with the joint values on "
        "the pendant once."
    ),
    "6.07": (
        "RobotWare 6.07.00 reports wrong joint values (fixed in 6.07.01). Compare q with the joint values on the "
        "pendant."
    ),
}
_AXES = 6
_ANY_ARM: Any = SimpleNamespace(  # accepts packets from any robot; the seventh axis of a YuMi counts as external
    n=_AXES, prismatic=np.zeros(_AXES, dtype=bool), abb_axes=(1, 2, 3, 4, 5, 6), coupling=np.eye(_AXES)
)


class EgmListener:
    """Collects and checks the datagrams that arrive at one port."""

    number: int

    def __init__(self, number: int, robot: Robot | None = None) -> None:
        self.number, self._robot = number, robot
        self.senders: Counter[tuple[str, int]] = Counter()
        self.session: Session = Session(EgmCodec(_ANY_ARM if robot is None else robot))
        self._sizes: Counter[int] = Counter()
        self._first: Sample | None = None
        self._last: Sample | None = None
        self._steps: list[float] = []
        self._offset = 0.0

    def add(self, arrival: Arrival) -> None:
        self.senders[arrival.source] += 1
        self._sizes[len(arrival.data)] += 1
        sample = self.session.accept(arrival)
        if sample is None:
            return
        if self._last is not None and not sample.fresh:
            self._steps.append(1e-9 * (sample.arrival_ns - self._last.arrival_ns) / (sample.missed + 1))
        if sample.packet.robot_ns:
            now_ns = time.time_ns() - (time.monotonic_ns() - arrival.ns)
            self._offset = 1e-9 * (sample.packet.robot_ns - now_ns)
        self._first, self._last = self._first or sample, sample

    def findings(self, seconds: float) -> list[Finding]:
        """Return one finding per check."""
        name = f"port {self.number}"
        total = sum(self.senders.values())
        if not total:
            advice = (
                "Check that the UDPUC device of the controller has this computer's address and this port, that RAPID "
                "runs EGMStreamStart or EGMRunJoint, and that no firewall drops packets: "
                f"sudo ufw allow {self.number}/udp"
            )
            return [Finding(f"{name}, packets", "warning", f"none in {seconds:g} s", advice)]
        rates = (f"{count / seconds:.1f}/s from {host}:{port}" for (host, port), count in self.senders.items())
        sizes = ", ".join(map(str, sorted(self._sizes)[:4]))
        advice = "Give each motion task a separate UDPUC device and port: only the first sender gets replies."
        many, count = len(self.senders) > 1, f"{len(self.senders)}"
        found = [
            Finding(f"{name}, packets", "ok", f"{', '.join(rates)}, {sizes} bytes"),
            Finding.judged(f"{name}, senders", "failure", many, count, advice),
        ]
        if self._first is None or self._last is None:
            return [*found, self._foreign(name)]
        first, last = self._first, self._last
        clock = (
            f"robot minus computer {self._offset:+.3f} s" if last.packet.robot_ns else "the robot sends no timestamps"
        )
        extension = (
            "research extension present: velocity and torque are measured"
            if last.packet.qd is not None
            else "absent: velocities are position differences, and torque is not measured"
        )
        return [
            *found,
            self._timing(name),
            self._robotware(name, first),
            self._posture(name, first),
            self._guidance(name, last),
            self._sessions(name),
            Finding(f"{name}, clock", "ok", clock),
            Finding(f"{name}, extension", "ok", extension),
        ]

    def _foreign(self, name: str) -> Finding:
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.session.drops.items())
        if "joint count" in self.session.drops and self._robot is not None:
            advice = (
                f"The connected robot is not a {self._robot.name}, which "
                f"has {self._robot.n} axes. Specify the connected robot."
            )
            return Finding(f"{name}, first packet", "failure", f"wrong axes: {reasons}", advice)
        advice = "A program other than an EGM controller sends to this port. Stop that program or choose another port."
        return Finding(f"{name}, first packet", "failure", f"not a robot packet: {reasons}", advice)

    def _timing(self, name: str) -> Finding:
        session, steps = self.session, self._steps or [0.0]
        p50, p99 = np.percentile(steps, [50, 99])
        lost, repeated = session.missed, session.drops["duplicate"] + session.drops["old"]
        value = (
            f"period {1e3 * session.period.seconds:.3f} ms, between arrivals {1e3 * p50:.2f} ms (p50) "
            f"{1e3 * p99:.2f} ms (p99); {lost} lost, {repeated} repeated or out of order"
        )
        bad = bool(lost or repeated or p99 - p50 > _SPREAD)
        advice = (
            "The computer (see wake-up) or the network is busy. Connect the robot to the computer with a separate "
            "cable, without Wi-Fi, VPN or a shared switch."
        )
        return Finding.judged(f"{name}, timing", "warning", bad, value, advice)

    def _robotware(self, name: str, first: Sample) -> Finding:
        packet = first.packet
        external = f" and {len(packet.q_ext)} external" if len(packet.q_ext) else ""
        hint = ", a YuMi's seventh axis or a track" if external and len(packet.q) == _AXES else ""
        value = f"RobotWare {packet.robotware}, {len(packet.q)} axes{external}{hint}"
        old = _OLD.get(packet.robotware, "")
        return Finding.judged(f"{name}, first packet", "warning", bool(old), value, old)

    def _posture(self, name: str, first: Sample) -> Finding:
        q = first.packet.q
        value = f"q = {np.round(q, 3).tolist()} rad"
        if self._robot is None:
            return Finding(f"{name}, posture", "ok", value)
        problem = outside_range(q, self._robot)
        return Finding.judged(f"{name}, posture", "failure", bool(problem), value, problem)

    def _guidance(self, name: str, last: Sample) -> Finding:
        why = not_ready_reason(last.packet.motors, last.packet.rapid, last.packet.mci)
        value = f"not ready: {why}" if why else "ready for references"
        return Finding.judged(f"{name}, guidance", "warning", bool(why), value, _REMEDY.get(why, ""))

    def _sessions(self, name: str) -> Finding:
        session = self.session
        if session.silent(time.monotonic_ns()):
            session.end()
        why = session.reason and f", last end: {session.reason}"
        advice = (
            "Guidance without replies ends after CommTimeout. A convergence window other than [0, 0] also ends "
            "guidance when the arm is at rest. See the event log on the pendant."
        )
        value = f"{session.number}{why}"
        return Finding.judged(f"{name}, sessions", "warning", bool(why), value, advice)


__all__ = ["DEFAULT_PORTS", "LONGEST", "addresses", "examine", "firewall", "listen", "route_to"]

_FIREWALL = Path("/etc/ufw/ufw.conf")
_SELF_TEST = 0.2  # s, shortest duration of the self-test


def addresses(found: Mapping[str, str]) -> Finding:
    """Check whether this computer has an address that other computers can reach."""
    value = ", ".join(f"{interface} {address}" for interface, address in found.items()) or "none"
    outside = [address for address in found.values() if not address.startswith("127.")]
    advice = "Only a simulated robot can reach this computer. Connect the controller's cable and set an address."
    return Finding.judged("addresses", "warning", not outside, value, advice)


def route_to(host: str) -> str:
    """Return the source address of packets to a host, or "" if no route exists; send nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))  # UDP: only selects the route
        except OSError:
            return ""
        return probe.getsockname()[0]


def firewall(file: Path = _FIREWALL) -> Finding:
    """Report whether the ufw firewall is enabled; only root can read its rules."""
    is_on = False
    with suppress(OSError), file.open(encoding="utf-8") as opened:
        is_on = any(line.strip().lower() == "enabled=yes" for line in opened)
    value = "ufw is on" if is_on else "ufw is off or missing"
    return Finding.judged(
        "firewall", "warning", is_on, value, "Allow packets from robots: sudo ufw allow 6510:6512/udp"
    )


class _PortListener:
    """Bound port with its received datagrams and its self-test token."""

    def __init__(self, port: Port, robot: Robot | None) -> None:
        self.port, self.listener = port, EgmListener(port.port, robot)
        self.token, self.received = secrets.token_bytes(16), set[str]()
        self.addresses = ["127.0.0.1", *(a for a in local_addresses().values() if a != "127.0.0.1")]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            for address in self.addresses:
                with suppress(OSError):
                    own.sendto(self.token + address.encode(), (address, port.port))

    def take(self) -> None:
        while (arrival := self.port.receive()) is not None:
            if arrival.data.startswith(self.token):
                self.received.add(arrival.data[len(self.token) :].decode())
            else:
                self.listener.add(arrival)

    def self_test(self) -> Finding:
        """Check whether this computer receives packets sent to its own addresses."""
        lost = [address for address in self.addresses if address not in self.received]
        value = f"received packets from {len(self.received)} of {len(self.addresses)} own addresses"
        advice = (
            f"A firewall rule on this computer drops packets to {', '.join(lost)}. "
            "Check the output of nft list ruleset or ufw status."
        )
        return Finding.judged(f"port {self.port.port}, self-test", "failure", bool(lost), value, advice)


def listen(numbers: Sequence[int], seconds: float, robots: Sequence[Robot | None], requested: bool) -> list[Finding]:
    """Bind the ports, listen, and return the findings; the only data sent are self-test tokens to this computer."""
    found: list[Finding] = []
    listeners: list[_PortListener] = []
    for number, robot in zip(numbers, robots, strict=True):
        try:
            port = Port("0.0.0.0", number)
        except LinkError as error:
            found.append(Finding(f"port {number}", "failure", "cannot be opened for listening", str(error)))
            continue
        found.append(Finding(f"port {port.port}", "ok", "free"))
        listeners.append(_PortListener(port, robot))
    try:
        _wait(listeners, max(seconds, _SELF_TEST))
    finally:
        for listener in listeners:
            listener.port.close()
    found += [listener.self_test() for listener in listeners]
    silent = not any(one.listener.senders for one in listeners)
    for listener in listeners:
        if listener.listener.senders or requested or (silent and listener is listeners[0]):
            found += listener.listener.findings(max(seconds, _SELF_TEST))
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
    hosts = sorted({host for host, _ in listener.listener.senders})
    routes = {host: route_to(host) for host in hosts}
    lost = [host for host, own in routes.items() if not own]
    value = ", ".join(f"replies to {host} leave from {own or 'no address'}" for host, own in routes.items())
    advice = f"Give this computer an address in the network of {', '.join(lost)}."
    return [Finding.judged(name, "failure", bool(lost), value, advice)] if hosts else []


DEFAULT_PORTS = (6510, 6511, 6512)
"""UDP ports of a single arm, a left arm and a right arm."""

LONGEST = 3600.0
"""Maximum listening time [s]."""


def examine(
    ports: Sequence[int] | None = None,
    seconds: float = 5.0,
    robots: Sequence[Robot] | None = None,
    wake_up: float = 2.0,
) -> list[Finding]:
    """Return the findings of all checks: first the computer, then the network and the ports.

    The check listens on `ports` (default: `DEFAULT_PORTS`) for `seconds` [s] and measures wake-up latencies for
    `wake_up` [s]. With `robots`, one per port, the function also checks the number of axes and the posture.
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

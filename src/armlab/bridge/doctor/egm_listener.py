"""`EgmListener`: what came to one port while only listening, judged for `armlab doctor`."""

from __future__ import annotations

import time
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from armlab.bridge.control.feedback import not_ready_reason, outside_range
from armlab.bridge.control.session import Sample, Session
from armlab.bridge.doctor.machine import Finding
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec

_SPREAD = 2e-3  # s between the median and the 99th percentile of the time between packets
_REMEDY = {
    "the motors are off": "Switch the motors on; in manual mode hold the enabling device.",
    "RAPID is stopped": "Start RAPID from main on the pendant.",
    "guidance has not begun (EGMRunJoint)": (
        "Right for a stream or for leading by hand. To move the arm let RAPID reach EGMRunJoint (ArmlabJoint.mod)."
    ),
}
_OLD = {
    "6.06": "Joints come in radians from this RobotWare; they are converted. Check q against the pendant once.",
    "6.07": "6.07.00 reports wrong joint values, mended in 6.07.01: check q against the pendant.",
}


_AXES = 6
_ANY_ARM: Any = SimpleNamespace(  # every robot's packet fits, the seventh axis of a YuMi counts as external
    n=_AXES, prismatic=np.zeros(_AXES, dtype=bool), abb_axes=(1, 2, 3, 4, 5, 6), coupling=np.eye(_AXES)
)


class EgmListener:
    """Collects the datagrams of one port."""

    def __init__(self, number: int, robot: Robot | None = None) -> None:
        self.number, self._robot = number, robot
        self.senders: Counter[tuple[str, int]] = Counter()
        self.session = Session(EgmCodec(_ANY_ARM if robot is None else robot))
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
        """Return what can be said, one finding per question."""
        name = f"port {self.number}"
        total = sum(self.senders.values())
        if not total:
            advice = (
                "Check that the controller's UDPUC device has the address of this computer and this port, that RAPID "
                f"runs EGMStreamStart or EGMRunJoint, and that no firewall drops it: sudo ufw allow {self.number}/udp"
            )
            return [Finding(f"{name}, packets", "warning", f"none in {seconds:g} s", advice)]
        found = [self._packets(name, seconds), self._one_sender(name)]
        if self._first is None or self._last is None:
            return [*found, self._foreign(name)]
        first, last = self._first, self._last
        clock = f"robot minus computer {self._offset:+.3f} s" if last.packet.robot_ns else "the robot sends no time"
        extension = (
            "research extension present: velocity and torque are measured"
            if last.packet.qd is not None
            else "absent: velocities are differences, torque is not measured"
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

    def _packets(self, name: str, seconds: float) -> Finding:
        each = ", ".join(f"{count / seconds:.1f}/s from {host}:{port}" for (host, port), count in self.senders.items())
        sizes = ", ".join(map(str, sorted(self._sizes)[:4]))
        return Finding(f"{name}, packets", "ok", f"{each}, {sizes} bytes")

    def _one_sender(self, name: str) -> Finding:
        advice = "Give each motion task a UDPUC device and a port of its own: only the first sender is answered."
        value = f"{len(self.senders)}"
        return Finding.judged(f"{name}, senders", "failure", len(self.senders) > 1, value, advice)

    def _foreign(self, name: str) -> Finding:
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.session.drops.items())
        if "joint count" in self.session.drops and self._robot is not None:
            advice = f"This is not a {self._robot.name}, which has {self._robot.n} axes: name the robot that is there."
            return Finding(f"{name}, first packet", "failure", f"wrong axes: {reasons}", advice)
        advice = "Something else than an EGM controller sends here: end it or choose another port."
        return Finding(f"{name}, first packet", "failure", f"no packet of a robot: {reasons}", advice)

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
            "Either this computer is busy (see wake-up), or the network: connect robot and computer by a cable of "
            "their own, without WLAN, VPN or a shared switch."
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
            "Guidance without answers ends after CommTimeout, and a convergence window other than [0, 0] ends it while "
            "the arm stands still: see the pendant's event log."
        )
        value = f"{session.number}{why}"
        return Finding.judged(f"{name}, sessions", "warning", bool(why), value, advice)

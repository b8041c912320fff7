"""Inputs and outputs of the EGM codec: `Packet`, `Drop`, `Reference`, `Beside`, `Codec`.

All values are SI and radians in kinematic joint order. Named tuples are immutable and five times cheaper to create
than frozen dataclasses, which matters in every control cycle.

`StandingQueue`: the controller processes one message per cycle, first in, first out. Each message remaining in the
queue delays every later reference by one cycle.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

DROP_REASONS = (
    "unparsable",
    "no header",
    "wrong type",
    "no joints",
    "joint count",
    "not finite",
    "foreign source",
    "duplicate",
    "old",
    "after the end",
    "damaged",
)
"""Reasons for dropping a datagram: the codec uses the first six, Zenoh rows the last, and the session the others."""


class RobotAxes(Protocol):
    """Robot properties needed by the codec; `robots.Robot` implements it."""

    @property
    def n(self) -> int:
        """Number of joints."""
        ...

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) True for linear joints."""
        ...

    @property
    def abb_axes(self) -> tuple[int, ...]:
        """ABB's axis number of each joint in kinematic order; YuMi (1, 2, 7, 3, 4, 5, 6)."""
        ...

    @property
    def coupling(self) -> np.ndarray:
        """(n, n) motor-to-joint coupling; non-diagonal if ABB's axes differ from the joints."""
        ...


class Packet(NamedTuple):
    """Decoded EgmRobot, filled by position in `native/wire/egm.cpp`.

    Attributes
    ----------
    seqno, tm_ms : header; `tm_ms` is None if missing.
    robot_ns : feedBack.time in nanoseconds since 1970, 0 if absent.
    q : (n,) measured joints.
    q_planned : (n,) the controller's reference, NaN if absent.
    q_ext : external axes.
    qd : (n,) measured velocities, None without the extension.
    tau : (n,) torques or None.
    tau_source : "measured" (extension), "reference" (torqueRef) or "none".
    T_frame_tool : (4, 4), NaN if absent.
    wrench_raw : (6,) measuredForce, NaN if absent.
    motors, mci, rapid : states as numbered by ABB, 0 if absent.
    converged : whether the convergence condition of EGMAct is met.
    utilization : percent, NaN if absent.
    robotware : "6.06", "6.07", "6.10" or "7".
    rapid_data, rapid_digital : RAPIDfromRobot.
    robot_mono_ns : monotonic clock of the extension, 0 if absent.
    queue_depth : messages left in the robot's queue, -1 without the extension.
    """

    seqno: int
    tm_ms: int | None
    robot_ns: int
    q: np.ndarray
    q_planned: np.ndarray
    q_ext: np.ndarray
    qd: np.ndarray | None
    tau: np.ndarray | None
    tau_source: str
    T_frame_tool: np.ndarray
    wrench_raw: np.ndarray
    motors: int
    mci: int
    rapid: int
    converged: bool
    utilization: float
    robotware: str
    rapid_data: np.ndarray
    rapid_digital: bool
    robot_mono_ns: int
    queue_depth: int


class Drop(NamedTuple):
    """Datagram that gets no reply: the reason (one of `DROP_REASONS`) and a detail."""

    reason: str
    detail: str


class Beside(NamedTuple):
    """Content of a reply in addition to the robot's joints; None means not sent.

    Attributes
    ----------
    q_ext, qd_ext : (k,) position and speed of external axes beyond the robot's own [rad, rad/s or m, m/s].
    rapid_data : numbers for RAPID.
    rapid_digital : the digital value for RAPID.
    """

    q_ext: np.ndarray | None = None
    qd_ext: np.ndarray | None = None
    rapid_data: np.ndarray | None = None
    rapid_digital: bool | None = None


class Reference(NamedTuple):
    """Reply to the robot.

    Attributes
    ----------
    q, qd, tau : (n,) references; without `qd`, no speed reference is sent; `tau` needs the extension.
    seq : our own sequence number.
    tm_ms : the `tm` of the answered packet (0 if missing).
    robot_seq, robot_mono_ns : echoes of the answered packet, sent with the extension only.
    free : torque control without the position loop: its gains are zero.
    beside : content for external axes and RAPID, or None.
    """

    q: np.ndarray
    qd: np.ndarray | None
    tau: np.ndarray | None
    seq: int
    tm_ms: int
    robot_seq: int = 0
    robot_mono_ns: int = 0
    free: bool = False
    beside: Beside | None = None


class Codec(Protocol):
    """Plug-in interface of the bridge that converts bytes to SI values and back, for sites with another protocol.

    `capabilities` is a subset of {"position", "velocity", "torque", "measured_torque", "external_axes", "rapid_data"}.
    `encode` may omit fields outside its capabilities, because the bridge refuses such commands.
    """

    capabilities: frozenset[str]

    def reset(self) -> None:
        """Reset the learnt state of the robot for a new session."""
        ...

    def decode(self, data: bytes) -> Packet | Drop:
        """Decode a packet, or return the reason for dropping it. Never raises."""
        ...

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of one reply."""
        ...


_SECONDS = 1.0  # queues that last less are replies in flight


class StandingQueue:
    """Detector of a receive queue that stays non-empty for 1 s."""

    def __init__(self) -> None:
        self._seconds, self._least = 0.0, 0

    def after(self, depth: int, period: float) -> str:
        """Return a sentence in the cycle in which the queue has been non-empty for 1 s, otherwise "".

        `period`: cycle time of the robot [s].
        """
        if depth <= 0:
            self._seconds = 0.0
            return ""
        self._least = min(self._least, depth) if self._seconds else depth
        before, self._seconds = self._seconds, self._seconds + period
        if not before < _SECONDS <= self._seconds:
            return ""
        wait = "messages have waited" if self._least > 1 else "message has waited"
        late = f"so each reference acts {1e3 * self._least * period:.0f} ms late"
        return f"{self._least} {wait} in the controller's receive queue for 1 s, {late}."

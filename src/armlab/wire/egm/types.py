"""Inputs and outputs of the EGM codec in SI units and kinematic joint order.

Named tuples are used, because they are five times faster to create than frozen dataclasses.
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
    "damaged",
)
"""Reasons for dropping a datagram: the codec uses the first six, Zenoh the last one, and the session the others."""


class RobotAxes(Protocol):
    """Robot properties that the codec needs; `robots.Robot` provides them."""

    @property
    def n(self) -> int:
        """Number of joints."""
        ...

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) True for prismatic joints."""
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
    seqno, tm_ms : sequence number and clock [ms] of the header; `tm_ms` is None if absent.
    robot_ns : feedBack.time in nanoseconds since 1970, 0 if absent.
    q : (n,) measured positions [rad or m].
    q_planned : (n,) the controller's reference [rad or m], NaN if absent.
    q_ext : (k,) positions of the external axes [rad or m].
    qd : (n,) measured velocities [rad/s or m/s], None without the extension.
    tau : (n,) torques [N m], or None.
    tau_source : "measured" (extension), "reference" (torqueRef) or "none".
    T_frame_tool : (4, 4) tool pose [m], NaN if absent.
    wrench_raw : (6,) measuredForce [N, N m], NaN if absent.
    motors, mci, rapid : states as numbered by ABB, 0 if absent.
    converged : whether the convergence condition of EGMAct is met.
    utilization : utilizationRate [%], NaN if absent.
    robotware : "6.06", "6.07", "6.10" or "7".
    rapid_data, rapid_digital : numbers and digital value of RAPIDfromRobot.
    robot_mono_ns : monotonic clock of the extension, 0 if absent.
    queue_depth : number of messages left in the robot's queue, -1 without the extension.
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
    """Datagram dropped without a reply: the reason (one of `DROP_REASONS`) and details."""

    reason: str
    detail: str


class Beside(NamedTuple):
    """Content of a reply in addition to the joint references; None omits a field.

    Attributes
    ----------
    q_ext, qd_ext : (k,) position and speed of external axes beyond the robot's own [rad, rad/s or m, m/s].
    rapid_data : numbers sent to RAPID.
    rapid_digital : digital value sent to RAPID.
    """

    q_ext: np.ndarray | None = None
    qd_ext: np.ndarray | None = None
    rapid_data: np.ndarray | None = None
    rapid_digital: bool | None = None


class Reference(NamedTuple):
    """Reply to the robot.

    Attributes
    ----------
    q, qd, tau : (n,) references [rad or m, rad/s or m/s, N m]; `qd` is optional, and `tau` needs the extension.
    seq : sequence number of the reply.
    tm_ms : `tm` of the answered packet [ms], 0 if absent.
    robot_seq, robot_mono_ns : sequence number and clock of the answered packet, returned only with the extension.
    free : whether the position-loop gains are zero, for pure torque control.
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
    """Plug-in interface of the bridge for protocols other than EGM: converts bytes to SI values and back.

    `capabilities` is a subset of {"position", "velocity", "torque", "measured_torque", "external_axes", "rapid_data"}.
    `encode` may omit fields outside its capabilities, because the bridge rejects such commands.
    """

    capabilities: frozenset[str]

    def reset(self) -> None:
        """Discard the detected robot properties for a new session."""
        ...

    def decode(self, data: bytes) -> Packet | Drop:
        """Decode a packet, or return the reason for dropping it. Never raises."""
        ...

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of one reply."""
        ...


_SECONDS = 1.0  # s: messages queued for less time are replies in transit


class StandingQueue:
    """Detects a receive queue that stays non-empty for 1 s; each queued message delays references by one cycle."""

    def __init__(self) -> None:
        self._seconds, self._least = 0.0, 0

    def after(self, depth: int, period: float) -> str:
        """Return a warning in the cycle (of length `period` [s]) in which the queue has been non-empty for 1 s,
        otherwise ""."""
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

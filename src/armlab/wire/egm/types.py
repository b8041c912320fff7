"""Inputs and outputs of the EGM codec: `Packet`, `Drop`, `Reference`, `Beside`, `Codec`.

All values are SI and radians in kinematic joint order. They are named tuples: immutable, and five times cheaper to make
than frozen dataclasses, which counts at one of each per control cycle.

`StandingQueue`: the controller takes one message per cycle, first in, first out. Each message that stays in the queue
delays every later reference by one cycle.
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
"""Why a datagram is dropped. The codec finds the first six, that of Zenoh's rows the last, the session the others."""


class RobotAxes(Protocol):
    """What the codec needs to know of a robot: a `robots.Robot` has it."""

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
        """(n, n) gears between motors and joints; diagonal, or ABB's axes are not the joints."""
        ...


class Packet(NamedTuple):
    """One decoded EgmRobot, filled by position in `native/wire/egm.cpp`.

    Attributes
    ----------
    seqno, tm_ms : header; `tm_ms` is None when the robot sent none.
    robot_ns : feedBack.time in nanoseconds since 1970, 0 when absent.
    q : (n,) measured joints. q_planned : (n,) the controller's reference, NaN when absent. q_ext : external axes.
    qd : (n,) measured velocities, None without the extension.
    tau : (n,) torques or None; tau_source : "measured" (extension), "reference" (torqueRef) or "none".
    T_frame_tool : (4, 4), NaN when absent. wrench_raw : (6,) measuredForce, NaN when absent.
    motors, mci, rapid : states as ABB numbers them, 0 when absent. converged : the window of EGMAct is met.
    utilization : percent, NaN when absent. robotware : "6.06", "6.07", "6.10" or "7".
    rapid_data, rapid_digital : RAPIDfromRobot.
    robot_mono_ns : monotonic clock of the extension, 0 when absent.
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
    """A datagram that is not answered: the kind, one of `DROP_REASONS`, and a detail in words."""

    reason: str
    detail: str


class Beside(NamedTuple):
    """What a reply says beside the joints of the robot; None for what it does not.

    Attributes
    ----------
    q_ext, qd_ext : (k,) position and speed of external axes beyond the robot's own [rad, rad/s or m, m/s].
    rapid_data : numbers for RAPID. rapid_digital : the digital value for RAPID.
    """

    q_ext: np.ndarray | None = None
    qd_ext: np.ndarray | None = None
    rapid_data: np.ndarray | None = None
    rapid_digital: bool | None = None


class Reference(NamedTuple):
    """One reply to the robot.

    Attributes
    ----------
    q, qd, tau : (n,) references; `qd` None sends no speed reference, `tau` goes out with the extension only.
    seq : our own sequence number. tm_ms : the `tm` of the packet answered (0 when it had none).
    robot_seq, robot_mono_ns : echoes of the packet answered, sent with the extension only.
    free : the torque takes the place of the position loop: its gains are zero.
    beside : what goes to external axes and RAPID, None for nothing.
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
    """The plug-in point of the bridge: bytes to SI and back. A site with another interface writes one of these.

    `capabilities` is a subset of {"position", "velocity", "torque", "measured_torque", "external_axes", "rapid_data"}.
    `encode` may leave out what the codec is not capable of: the bridge refuses such commands.
    """

    capabilities: frozenset[str]

    def reset(self) -> None:
        """Forget what was learnt about the robot: a new session begins."""
        ...

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet, or why it is dropped. Never raises."""
        ...

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of one reply."""
        ...


_SECONDS = 1.0  # shorter queues are replies on their way


class StandingQueue:
    """Detector of messages that wait in every cycle for 1 s."""

    def __init__(self) -> None:
        self._seconds, self._least = 0.0, 0

    def after(self, depth: int, period: float) -> str:
        """Return a sentence in the cycle in which the queue has not been empty for 1 s, else "".

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

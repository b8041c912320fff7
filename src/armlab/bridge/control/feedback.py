"""Feedback plausibility: joint limits, speed between packets, and following error."""

from __future__ import annotations

import numpy as np

from armlab import kernels
from armlab.bridge.control.limits import Limits, Reply, axes_of, joint_name
from armlab.robots import Robot
from armlab.wire.egm import Packet
from armlab.wire.egm.axes import Linkage

READY_AFTER = 3
"""Number of consecutive plausible packets after which the robot counts as ready."""
STOP_AFTER = 3.0
"""Count of implausible packets that stops the run; each plausible packet subtracts 1/8 from the count."""

_DECAY = 0.125

_OUTSIDE = 0.1  # rad or m beyond the joint limits
_LAG, _CATCHES_UP = 0.05, 0.2  # s: following error divided by speed, and time constant of its decay
_RAMP, _RAMP_LAG = 1.0, 0.3  # s: duration of EGM's ramp-in (RampInTime), and the larger lag allowed during it
_FROZEN = 0.1  # s without any change of the feedback
_STEP, _FASTER = 0.02, 2.0  # largest plausible step: rad or m, plus a multiple of the speed limit


class FeedbackCheck:
    """Checks the feedback against the limits, the last plausible position and the last reference sent.

    Frozen feedback is detected when the reference moves away from the feedback. With coupled axes, all checks are done
    in axis space.
    """

    plausible: int
    implausible: float
    confirmed: bool

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self._robot, self._linkage = robot, Linkage.of(robot)
        self._bounds = np.stack((robot.q_min, robot.q_max, robot.qd_max))
        self._allowed = limits.jump if limits.following_error is None else limits.following_error
        self.begin()

    def begin(self) -> None:
        self.plausible, self.implausible = 0, 0.0
        self.q: np.ndarray | None = None
        self.confirmed = False
        self._since = self._frozen = 0.0
        self._newest: np.ndarray | None = None
        self._guided, self._ramps, self._fastest = 0.0, True, np.zeros(self._robot.n)

    def check(self, q: np.ndarray, dt: float, sent: Reply | None) -> str:
        """Return the reason why the feedback is implausible, or "" if it is plausible."""
        self._since += dt
        same = self._newest is not None and q.tobytes() == self._newest.tobytes()
        self._frozen = self._frozen + dt if same else 0.0
        self._newest = q
        if sent is None:
            self._guided, self._ramps, self._fastest = 0.0, True, np.zeros(self._robot.n)
        self._guided += dt
        problem, axes, before = "", q, self.q
        if self._linkage is not None:
            axes, before = self._linkage.axes(q), None if before is None else self._linkage.axes(before)
        found = kernels.implausible(axes, before, self._bounds, _OUTSIDE, _STEP, _FASTER * self._since)
        if found > 0:
            problem = outside_range(q, self._robot)
        elif found < 0 and before is not None:
            i = -found - 1
            problem = (
                f"Expected the feedback of {joint_name(self._robot, i)} "
                "to change no faster than the arm can move, got a jump "
                f"from {before[i]:.4f} to {axes[i]:.4f} in {1e3 * self._since:.1f} ms. Check the robot controller."
            )
        if sent is not None and not problem:
            problem = self._apart(axes, dt, sent)
        if problem:
            self.plausible, self.implausible = 0, self.implausible + 1.0
            if not self.confirmed and found <= 0:
                self.q, self._since = q, 0.0  # the first two positions contradict each other, so neither is trusted
        else:
            self.plausible, self.implausible = self.plausible + 1, max(0.0, self.implausible - _DECAY)
            self.q, self._since = q, 0.0
            self.confirmed = self.confirmed or self.plausible >= READY_AFTER
        return problem

    def _apart(self, q: np.ndarray, dt: float, sent: Reply) -> str:
        reference, speed = sent.q, sent.qd
        if self._linkage is not None:
            reference, speed = self._linkage.axes(reference), self._linkage.axes(speed)
        kept, lag = 1.0 if self._ramps else max(0.0, 1.0 - dt / _CATCHES_UP), _LAG
        self._fastest, i, is_near = kernels.following_error(
            q, reference, speed, self._fastest, self._allowed, kept, lag
        )
        if self._ramps and self._guided > _RAMP and is_near:
            self._ramps = False
        if self._ramps:
            lag = _RAMP_LAG
            _, i, is_near = kernels.following_error(q, reference, speed, self._fastest, self._allowed, 1.0, lag)
        if is_near:
            return ""
        if self._frozen > _FROZEN:
            cause = f"The feedback has not changed for {self._frozen:.2f} s: it is frozen."
        else:
            cause = (
                "Usual causes are a collision, engaged brakes, or an EGM gain or MaxSpeedDeviation that is too small. "
                "Limits.of(robot, following_error=...) sets the limit."
            )
        allowed, error = self._allowed[i] + lag * self._fastest[i], abs(reference[i] - q[i])
        return (
            f"Expected {joint_name(self._robot, i)} within {allowed:.3f} of its reference {reference[i]:.4f}, got "
            f"{q[i]:.4f}: a following error of {error:.3f}. {cause}"
        )


def outside_range(q: np.ndarray, robot: Robot) -> str:
    """Return an error message if the feedback (n,) is far outside the range of a joint, otherwise ""."""
    q = axes_of(robot)(q)
    outside = np.maximum(robot.q_min - q, q - robot.q_max)
    i = int(outside.argmax())
    if outside[i] <= _OUTSIDE:
        return ""
    return (
        f"Expected {joint_name(robot, i)} of {robot.name} between {robot.q_min[i]:.3f} and {robot.q_max[i]:.3f}, got "
        f"feedback of {q[i]:.3f}. Usual causes are a different robot, joint order or unit: check the robot "
        "description and the RobotWare version."
    )


MCI_RUNNING = 3
"""MCI state of a robot under EGM guidance."""

_MOTORS_ON = 1
_RAPID_MOVES = (0, 2)  # the state stays undefined (0) after a controller restart, although RAPID is running
_ABSENT = 3  # consecutive packets without a state after which the state counts as unknown


def not_ready_reason(motors: int, rapid: int, mci: int) -> str:
    """Return the reason why the robot would not follow a reference, or "" if it would; the arguments are the states in
    a `Packet`."""
    if motors != _MOTORS_ON:
        return "the motors are off" if motors else "the packets contain no motor state"
    if rapid not in _RAPID_MOVES:
        return "RAPID is stopped"
    return "" if mci == MCI_RUNNING else "guidance has not begun (EGMRunJoint)"


class Readiness:
    """Tracks the robot states in the packets; one or two packets without states do not interrupt a motion."""

    is_unknown: bool

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        self._motors = self._mci = self._absent = 0
        self.is_unknown = False

    def not_ready_reason(self, packet: Packet) -> str:
        """Return the reason why the robot would not follow a reference, or "" if it would."""
        absent = not (packet.motors and packet.mci)
        self._absent = self._absent + 1 if absent else 0
        if self._absent in range(1, _ABSENT):
            return not_ready_reason(packet.motors or self._motors, packet.rapid, packet.mci or self._mci)
        self.is_unknown = absent and (
            self.is_unknown or not not_ready_reason(self._motors, packet.rapid, self._mci)  # it was ready before
        )
        self._motors, self._mci = packet.motors, packet.mci
        return not_ready_reason(packet.motors, packet.rapid, packet.mci)

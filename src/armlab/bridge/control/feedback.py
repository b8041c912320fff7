"""Plausibility of the feedback: joint limits, speed between two packets, following error."""

from __future__ import annotations

import numpy as np

from armlab.bridge.control.limits import Limits, Reply, axes_of, joint_name
from armlab.robots import Robot
from armlab.wire.egm import Packet
from armlab.wire.egm.axes import Linkage

READY_AFTER = 3
"""Plausible packets in a row before the robot counts as ready."""
STOP_AFTER = 3.0
"""Implausible packets that stop the run; each plausible one takes off an eighth."""

_TAKES_OFF = 0.125

_OUTSIDE = 0.1  # rad or m beyond the limits of a joint
_LAG, _CATCHES_UP = 0.05, 0.2  # s: following error for each rad/s, and the time in which the arm catches up
_RAMP, _RAMP_LAG = 1.0, 0.3  # s: EGM follows gradually at first (RampInTime), at full speed it cannot catch up soon
_FROZEN = 0.1  # s without any change
_STEP, _FASTER = 0.02, 2.0  # rad or m, and times the speed limit: a feedback that moved further is a false one


class FeedbackCheck:
    """Checks each feedback position against the limits, the last plausible one, and the reference that was sent.

    A frozen feedback is found by the reference that moves away from it. On a robot whose axes are not its joints all
    of this is about the axes.
    """

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self._robot, self._linkage = robot, Linkage.of(robot)
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
        """Return why a feedback is not plausible, "" when it is."""
        self._since += dt
        same = self._newest is not None and q.tobytes() == self._newest.tobytes()
        self._frozen = self._frozen + dt if same else 0.0
        self._newest = q
        if sent is None:
            self._guided, self._ramps, self._fastest = 0.0, True, np.zeros(self._robot.n)
        self._guided += dt
        problem, robot, axes, before = "", self._robot, q, self.q
        if self._linkage is not None:
            axes, before = self._linkage.axes(q), None if before is None else self._linkage.axes(before)
        beyond = np.maximum(robot.q_min - axes, axes - robot.q_max)
        is_outside = not beyond[beyond.argmax()] <= _OUTSIDE
        if is_outside:
            problem = outside_range(q, robot)
        elif before is not None:
            excess = np.abs(axes - before) - (_STEP + _FASTER * robot.qd_max * self._since)
            i = int(excess.argmax())
            if not excess[i] <= 0.0:
                problem = (
                    f"Expected the feedback of {joint_name(robot, i)} to move no faster than the arm can, but it went "
                    f"from {before[i]:.4f} to {axes[i]:.4f} in {1e3 * self._since:.1f} ms. "
                    "Check the robot's controller."
                )
        if sent is not None and not problem:
            problem = self._apart(axes, dt, sent)
        if problem:
            self.plausible, self.implausible = 0, self.implausible + 1.0
            if not self.confirmed and not is_outside:
                self.q, self._since = q, 0.0  # of two first ones that contradict each other neither is believed
        else:
            self.plausible, self.implausible = self.plausible + 1, max(0.0, self.implausible - _TAKES_OFF)
            self.q, self._since = q, 0.0
            self.confirmed = self.confirmed or self.plausible >= READY_AFTER
        return problem

    def _apart(self, q: np.ndarray, dt: float, sent: Reply) -> str:
        reference, speed = sent.q, sent.qd
        if self._linkage is not None:
            reference, speed = self._linkage.axes(reference), self._linkage.axes(speed)
        error = np.abs(reference - q)
        kept = 1.0 if self._ramps else max(0.0, 1.0 - dt / _CATCHES_UP)
        self._fastest = np.maximum(kept * self._fastest, np.abs(speed))
        allowed = self._allowed + _LAG * self._fastest
        if self._guided > _RAMP and (error <= allowed).all():
            self._ramps = False
        if self._ramps:
            allowed = self._allowed + _RAMP_LAG * self._fastest
        i = int((error - allowed).argmax())
        if error[i] <= allowed[i]:
            return ""
        if self._frozen > _FROZEN:
            cause = f"The feedback has not changed for {self._frozen:.2f} s: it is frozen."
        else:
            cause = (
                "Usual causes are a collision, brakes that are on, and a MaxSpeedDeviation or gain of EGM that is too "
                "small; Limits.of(robot, following_error=...) sets the limit."
            )
        return (
            f"Expected {joint_name(self._robot, i)} within {allowed[i]:.3f} of its reference {reference[i]:.4f}, but "
            f"it is at {q[i]:.4f}: a following error of {error[i]:.3f}. {cause}"
        )


def outside_range(q: np.ndarray, robot: Robot) -> str:
    """Return the sentence for feedback (n,) far outside the range of a joint, "" when there is none."""
    q = axes_of(robot)(q)
    outside = np.maximum(robot.q_min - q, q - robot.q_max)
    i = int(outside.argmax())
    if outside[i] <= _OUTSIDE:
        return ""
    return (
        f"Expected {joint_name(robot, i)} of {robot.name} between {robot.q_min[i]:.3f} and {robot.q_max[i]:.3f}, but "
        f"the robot reports {q[i]:.3f}. Usual causes are another robot, another joint order and other units: check the "
        "robot's description and its RobotWare."
    )


MCI_RUNNING = 3
"""State of EGM while it guides."""

_MOTORS_ON = 1
_RAPID_MOVES = (0, 2)  # undefined (0) stays after a restart of the controller although RAPID runs
_ABSENT = 3  # packets in a row without a state count


def not_ready_reason(motors: int, rapid: int, mci: int) -> str:
    """Return why the robot would not follow a reference, "" when it would; states as in a `Packet`."""
    if motors != _MOTORS_ON:
        return "the motors are off" if motors else "its packets have no state of the motors"
    if rapid not in _RAPID_MOVES:
        return "RAPID is stopped"
    return "" if mci == MCI_RUNNING else "guidance has not begun (EGMRunJoint)"


class Readiness:
    """The states of the newest packets; one or two packets without a state do not end a motion."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        self._motors = self._mci = self._absent = 0
        self.is_unknown = False

    def not_ready_reason(self, packet: Packet) -> str:
        """Return why the robot would not follow a reference, "" when it would."""
        absent = not (packet.motors and packet.mci)
        self._absent = self._absent + 1 if absent else 0
        if self._absent in range(1, _ABSENT):
            return not_ready_reason(packet.motors or self._motors, packet.rapid, packet.mci or self._mci)
        self.is_unknown = absent and (
            self.is_unknown or not not_ready_reason(self._motors, packet.rapid, self._mci)  # it was ready before
        )
        self._motors, self._mci = packet.motors, packet.mci
        return not_ready_reason(packet.motors, packet.rapid, packet.mci)

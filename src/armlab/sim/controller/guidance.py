"""Reference generation from messages: `ReferenceDecoder`, `Guidance` (joint mode), `ExternalAxes`.

The reference generator follows ABB (3HAC073318-001, section 2.3); its filter is our own model
(docs/theory/simulated_arm.md). Pose and path modes are intended for codec tests: the goal is the inverse-kinematics
solution nearest to the planned joint positions. A path correction shifts the initial tool position along y and z of the
tool.
"""

from __future__ import annotations

import math

import numpy as np

from armlab.errors import ConfigError
from armlab.robots import Robot
from armlab.sim.arm.arm import JointDrives
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm.axes import Linkage
from armlab.wire.egm.robot_side import SensorMessage

_OVERSHOOT = 0.02  # rad: largest filter overshoot beyond a limit


class Guidance:
    """Reference generator: `q` and `qd` (n,) for the drives, and the `utilization` of the speed limits [%]."""

    q: np.ndarray
    qd: np.ndarray
    utilization: float

    def __init__(self, robot: Robot, settings: ControllerSettings, q: np.ndarray) -> None:
        self._robot, self._settings, self._linkage = robot, settings, Linkage.of(robot)
        self._pole = 1.0 - math.exp(-2.0 * math.pi * settings.filter * settings.period)
        self._stages = 1 if settings.level == 0 else 2
        self._brake = robot.qdd_max * settings.period
        self._fastest = min(settings.max_speed, float(robot.qd_max.max()))
        self.q, self.qd = np.array(q), np.zeros(robot.n)
        self.utilization = 0.0
        self.begin()

    def begin(self) -> None:
        """Start guidance at the current position: reset the ramp, the filters and the deviation."""
        self._start, self._time = self.q, 0.0
        self._filters = [self.qd] * self._stages

    def follow(self, q_ref: np.ndarray | None, qd_ref: np.ndarray | None) -> None:
        """Advance by one period towards a reference; None holds the position or sets zero velocity."""
        settings = self._settings
        self._time += settings.period
        wanted = np.zeros_like(self.q) if qd_ref is None else qd_ref
        if q_ref is not None:
            wanted = settings.gain * settings.position_gain * (q_ref - self.q) + wanted
        if self._time < settings.ramp_in:
            wanted = wanted * (self._time / settings.ramp_in)
        self.utilization = 100.0 * float((np.abs(wanted) / self._robot.qd_max).max())
        fastest = float(np.abs(wanted).max())
        if fastest > self._fastest:
            wanted = wanted * (self._fastest / fastest)
        for i, state in enumerate(self._filters):
            wanted = self._filters[i] = state + self._pole * (wanted - state)
        self.qd = wanted
        self.q = self.q + wanted * settings.period

    def lead(self, q: np.ndarray, qd: np.ndarray) -> None:
        """Set the reference to the position and velocity imposed by a hand."""
        self.q, self.qd, self.utilization = q, qd, 0.0

    def let_go(self, q: np.ndarray, free: np.ndarray) -> None:
        """Set the reference of the joints in `free` to the measured position, so control resumes smoothly."""
        self.q = np.where(free, q, self.q)

    def brake(self) -> None:
        """Advance by one period, decelerating to zero at the robot's acceleration limits."""
        self.qd = np.sign(self.qd) * np.maximum(np.abs(self.qd) - self._brake, 0.0)
        self.q = self.q + self.qd * self._settings.period
        self.utilization = 0.0

    def violation(self) -> str:
        """Return a phrase that names the limit violated by the reference, or an empty string."""
        outside = self._outside(self.q, _OVERSHOOT)
        far = np.abs(self.q - self._start) > self._settings.max_deviation
        if outside.any():
            return f"reference of {self._joint(outside)} left the range of the joint"
        if far.any():
            return f"reference of {self._joint(far)} exceeded the allowed position deviation"
        return ""

    def refusal(self, q_ref: np.ndarray) -> str:
        """Return a phrase that names the joint whose received reference is out of bounds, or an empty string."""
        outside = self._outside(q_ref, 0.0)
        return f"reference of {self._joint(outside)} out of bounds" if outside.any() else ""

    def _outside(self, q: np.ndarray, margin: float) -> np.ndarray:
        """Return the mask of ABB's axes that are out of range; without a parallel rod, ABB's axes equal the joints."""
        axes = q if self._linkage is None else self._linkage.axes(q)
        return (axes < self._robot.q_min - margin) | (axes > self._robot.q_max + margin)

    def _joint(self, which: np.ndarray) -> str:
        i = int(np.argmax(which))
        return f"joint {i + 1} ({self._robot.joint_names[i]})"

    def near(self, q_ref: np.ndarray | None) -> bool:
        """Return whether the reference is within the convergence window around `q_ref`."""
        window = self._settings.window
        return window > 0 and q_ref is not None and bool((np.abs(q_ref - self.q) <= window).all())


_MOST = 6
_FASTEST = 1.0  # rad/s


class ExternalAxes:
    """Up to six external axes, starting at 0 rad, limited to 1 rad/s: ``q += T k (q_ref - q)``, where k is the gain."""

    def __init__(self, count: int, settings: ControllerSettings) -> None:
        if not 0 <= count <= _MOST:
            raise ConfigError(f"Expected 0 to {_MOST} external axes, got {count}.")
        self.q, self._gain, self._period = np.zeros(count), settings.gain, settings.period

    def follow(self, q_ref: np.ndarray | None) -> None:
        """Advance by one period; hold if the references are None or too few."""
        if q_ref is None or len(q_ref) < len(self.q):
            return
        qd = np.clip(self._gain * (q_ref[: len(self.q)] - self.q), -_FASTEST, _FASTEST)
        self.q: np.ndarray = self.q + self._period * qd


_ABSURD = 1e9  # rad, rad/s, m
_LARGEST_GAIN = 2.0


class ReferenceDecoder:
    """References of one motion task; RAPID variables persist across sessions.

    `tau` is the added torque [N m]; `gain_q` and `gain_qd` are factors on the drive's gains, from 0 to 2.
    """

    rapid_data: np.ndarray
    q: np.ndarray | None
    qd: np.ndarray | None
    q_ext: np.ndarray | None

    def __init__(self, robot: Robot, settings: ControllerSettings) -> None:
        self._robot, self._mode, self._has_position_loop = robot, settings.mode, settings.position_gain > 0
        self.rapid_data = np.zeros(0)
        self.rapid_digital: bool | None = None
        self.begin(robot.q_home)

    def begin(self, q: np.ndarray) -> None:
        """Clear all references for a new session that begins at joint positions `q`."""
        self.q = self.qd = self.q_ext = None
        self._start = q
        self.release()

    @property
    def drive_mode(self) -> int:
        """Drive mode of the research extension: 1 position, 2 velocity, 3 torque."""
        if not self.gain_q.any():
            return 3
        return 1 if self._has_position_loop else 2

    def read(self, message: SensorMessage, planned: np.ndarray) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the references (q, qd) in a message, which may contain NaN; None if the pose is out of reach."""
        if self._mode == "joint":
            q = message.q if message.q_reference is None else message.q_reference
            qd = message.qd if message.qd_reference is None else message.qd_reference
            return (planned if q is None else q), qd
        chain = self._robot.chain
        if self._mode == "pose":
            T_base_tool, twist = message.T_frame_tool, message.twist
        else:
            T_base_tool, twist = chain.forward(self._start).copy(), None
            y, z = np.zeros(2) if message.path_yz is None else message.path_yz
            T_base_tool[:3, 3] += T_base_tool[:3, :3] @ (0.0, y, z)
        if T_base_tool is None or not is_number(T_base_tool):
            return np.full(self._robot.n, np.nan), None
        from armlab.kinematics import inverse

        found = inverse(self._robot, T_base_tool, planned, starts=1)
        if not found.success:
            return None
        if twist is None or not is_number(twist):
            return found.q, twist
        return found.q, np.linalg.pinv(chain.jacobian(planned), rcond=1e-3) @ twist

    def accept(self, message: SensorMessage, q: np.ndarray, qd: np.ndarray | None) -> None:
        """Store the references and drive parameters of a message; missing drive parameters return to their defaults."""
        n = self._robot.n
        self.q, self.qd = q, qd
        if message.q_ext is not None:
            self.q_ext = message.q_ext
        if message.rapid_data is not None:
            self.rapid_data = message.rapid_data
        if message.rapid_digital is not None:
            self.rapid_digital = message.rapid_digital
        self.tau = np.zeros(n) if message.tau is None else message.tau
        self.gain_q = np.ones(n) if message.gain_q is None else message.gain_q.clip(0.0, _LARGEST_GAIN)
        self.gain_qd = np.ones(n) if message.gain_qd is None else message.gain_qd.clip(0.0, _LARGEST_GAIN)

    def apply(self, drive: JointDrives | None) -> None:
        """Apply the added torque and the gains to the drives; an arm without masses has no drives."""
        if drive is not None:
            drive.assist(self.tau, self.gain_q, self.gain_qd)

    def release(self) -> None:
        """Restore the default drive gains and remove the added torque."""
        n = self._robot.n
        self.tau, self.gain_q, self.gain_qd = np.zeros(n), np.ones(n), np.ones(n)


def is_number(values: np.ndarray) -> bool:
    """Return whether all values are finite and small enough that sums cannot overflow."""
    return bool((np.abs(values) < _ABSURD).all())


def has_numbers(message: SensorMessage, q: np.ndarray, qd: np.ndarray | None) -> bool:
    """Return whether all references of a message are valid numbers."""
    values = (q, qd, message.tau, message.gain_q, message.gain_qd, message.q_ext)
    return all(value is None or is_number(value) for value in values)

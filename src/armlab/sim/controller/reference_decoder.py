"""`ReferenceDecoder`: joint references from a received message, which holds joints, a pose or a path correction.

Pose and path correction exist for tests of codecs: the goal is the posture that inverse kinematics finds from the
planned one. A path correction shifts the posture at the beginning of guidance by y and z of the tool frame.
"""

from __future__ import annotations

import numpy as np

from armlab.robots import Robot
from armlab.sim.arm.drive import JointDrives
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm.robot_side import SensorMessage

_ABSURD = 1e9  # rad, rad/s, m
_LARGEST_GAIN = 2.0


class ReferenceDecoder:
    """References of one motion task; q, qd and q_ext are None before the first.

    `tau` is the torque to add [N m]; `gain_q` and `gain_qd` scale the drive's gains in [0, 2]. RAPID's variables
    outlive a session.
    """

    def __init__(self, robot: Robot, settings: ControllerSettings) -> None:
        self._robot, self._mode, self._has_position_loop = robot, settings.mode, settings.position_gain > 0
        self.rapid_data = np.zeros(0)
        self.rapid_digital: bool | None = None
        self.begin(robot.q_home)

    def begin(self, q: np.ndarray) -> None:
        """Forget all references: a new session begins at posture q."""
        n = self._robot.n
        self.q: np.ndarray | None = None
        self.qd: np.ndarray | None = None
        self.q_ext: np.ndarray | None = None
        self.tau, self.gain_q, self.gain_qd = np.zeros(n), np.ones(n), np.ones(n)
        self._start = q

    @property
    def drive_mode(self) -> int:
        """Mode of the drives as the research extension tells it: 1 position, 2 velocity, 3 torque."""
        if not self.gain_q.any():
            return 3
        return 1 if self._has_position_loop else 2

    @property
    def is_plain(self) -> bool:
        """Whether the drive works with its own gains and no torque is added."""
        return bool((self.gain_q == 1).all() and (self.gain_qd == 1).all() and not self.tau.any())

    def read(self, message: SensorMessage, planned: np.ndarray) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the references (q, qd) of a message; None when no posture reaches the pose. NaN is passed on."""
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
        """Store references and the drive's part of a message; absent fields go back to their defaults."""
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
        """Pass torque and gains to the drives; None is an arm without masses, which has none."""
        if drive is None:
            return
        if self.is_plain:
            drive.alone()
        else:
            drive.assist(self.tau, self.gain_q, self.gain_qd)

    def release(self) -> None:
        """Give the drive back its own gains and no torque: guidance is over."""
        n = self._robot.n
        self.tau, self.gain_q, self.gain_qd = np.zeros(n), np.ones(n), np.ones(n)


def is_number(values: np.ndarray) -> bool:
    """Return whether all values are finite, and small enough that sums of them are finite too."""
    return bool((np.abs(values) < _ABSURD).all())


def has_numbers(message: SensorMessage, q: np.ndarray, qd: np.ndarray | None) -> bool:
    """Return whether all references of a message are usable numbers."""
    values = (q, qd, message.tau, message.gain_q, message.gain_qd, message.q_ext)
    return all(value is None or is_number(value) for value in values)

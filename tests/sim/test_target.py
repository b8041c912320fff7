"""What the peer wants becomes joints: references, poses, path corrections, and the drive's part."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.drive import JointDrives
from armlab.sim.controller.reference_decoder import ReferenceDecoder, has_numbers, is_number
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm import SensorMessage

ROBOT = robots.load("yumi_right")
HOME = ROBOT.q_home + 0.05
ONES = np.ones(7)


def test_the_extension_takes_the_place_of_joint_references() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    plain = target.read(SensorMessage(0, 1, 3, q=HOME, qd=ONES), HOME)
    other = target.read(SensorMessage(0, 1, 3, q=HOME, q_reference=HOME + 1, qd_reference=2 * ONES), HOME)
    assert plain is not None
    assert other is not None
    np.testing.assert_array_equal(plain, (HOME, ONES))
    np.testing.assert_array_equal(other, (HOME + 1, 2 * ONES))


def test_a_pose_is_reached_from_the_planned_posture() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings(mode="pose"))
    goal = HOME + 0.02
    twist = ROBOT.chain.jacobian(HOME) @ (0.1 * ONES)
    found = target.read(SensorMessage(0, 1, 3, T_frame_tool=ROBOT.chain.forward(goal), twist=twist), HOME)
    assert found is not None
    q, qd = found
    np.testing.assert_allclose(ROBOT.chain.forward(q), ROBOT.chain.forward(goal), atol=1e-8)
    assert qd is not None
    np.testing.assert_allclose(ROBOT.chain.jacobian(HOME) @ qd, twist, atol=1e-9)
    far = np.eye(4)
    far[0, 3] = 9.0
    assert target.read(SensorMessage(0, 1, 3, T_frame_tool=far), HOME) is None


def test_a_path_correction_shifts_along_y_and_z_of_the_tool() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings(mode="path"))
    target.begin(HOME)
    found = target.read(SensorMessage(0, 1, 4, path_yz=np.array([0.01, -0.02])), HOME + 0.01)
    assert found is not None
    T_tool_shifted = np.linalg.inv(ROBOT.chain.forward(HOME)) @ ROBOT.chain.forward(found[0])
    np.testing.assert_allclose(T_tool_shifted[:3, 3], [0.0, 0.01, -0.02], atol=1e-8)
    np.testing.assert_allclose(T_tool_shifted[:3, :3], np.eye(3), atol=1e-8)


def test_what_is_absent_goes_back_to_its_default() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    assert target.is_plain
    target.accept(SensorMessage(0, 1, 3, tau=ONES, gain_q=9 * ONES, q_ext=np.array([0.5])), HOME, None)
    assert not target.is_plain
    np.testing.assert_array_equal(target.gain_q, 2.0)
    target.accept(SensorMessage(1, 1, 3), HOME, None)
    assert target.is_plain
    assert target.q_ext is not None, "an external reference stays"
    target.accept(SensorMessage(2, 1, 3, tau=ONES), HOME, None)
    target.release()
    assert target.is_plain
    target.begin(HOME)
    assert target.q is None


def test_what_rapid_heard_outlives_a_session() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    assert (target.rapid_data.size, target.rapid_digital) == (0, None)
    target.accept(SensorMessage(0, 1, 3, rapid_data=ONES, rapid_digital=True), HOME, None)
    target.accept(SensorMessage(1, 1, 3), HOME, None)
    target.begin(HOME)
    np.testing.assert_array_equal(target.rapid_data, ONES)
    assert target.rapid_digital is True


def test_modes_of_the_drives() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    assert target.drive_mode == 1
    assert ReferenceDecoder(ROBOT, ControllerSettings(position_gain=0.0)).drive_mode == 2
    target.accept(SensorMessage(0, 1, 3, gain_q=0 * ONES), HOME, None)
    assert target.drive_mode == 3


def test_the_drives_get_their_part() -> None:
    drive, target = JointDrives(ONES, 50.0 * ONES, 0.9 * ONES, 1e-3), ReferenceDecoder(ROBOT, ControllerSettings())
    rest = (np.zeros(7),) * 6
    target.accept(SensorMessage(0, 1, 3, tau=3.0 * ONES), HOME, None)
    target.apply(drive)
    np.testing.assert_array_equal(drive.torque(*rest, np.empty(7)), 3.0)
    target.release()
    target.apply(drive)
    np.testing.assert_array_equal(drive.torque(*rest, np.empty(7)), 0.0)
    target.apply(None)


@pytest.mark.parametrize("field", ["tau", "gain_q", "gain_qd", "q_ext"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_no_usable_number_anywhere(field: str, value: float) -> None:
    message = SensorMessage(0, 1, 3)._replace(**{field: np.array([0.0, value])})
    assert has_numbers(SensorMessage(0, 1, 3), HOME, None)
    assert not has_numbers(message, HOME, None)
    assert not is_number(np.array([0.0, value]))

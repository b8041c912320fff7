"""Logs in wrong units or on the wrong side of the gears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import NotExcited, ShapeError
from armlab.identify import dither, prepare
from armlab.log import Table
from armlab.log.units_check import check_known, check_position, check_torque, has_moved
from armlab.robots.couplings import joint_to_motor, joint_torque_to_motor


def changed(table: Table, **columns: np.ndarray) -> Table:
    return Table(table.t, {name: columns.get(name, table[name]) for name in ("q", "qd", "tau")})


def test_velocity_of_another_sign_unit_or_order(truth, excited) -> None:
    robot, qd = truth.robot, excited["qd"]
    for wrong, words in [
        (-qd, r"axis_1 \(-1 times: sign\)"),
        (np.rad2deg(qd), r"axis_1 \(57\.3 times: degrees per second\)"),
        (-np.rad2deg(qd), r"\(-57\.3 times: degrees per second and sign\)"),
        (joint_to_motor(robot, qd), r"axis_1 \(100 times: motor side, gear ratio 100\).*\(-101 times"),
        (1e-3 * qd, r"0\.001 times: thousandths"),
        (2.0 * qd, r"2 times: unit"),
        (qd[:, [1, 0, *range(2, 7)]], r"axis_1 \(\S+ times: the column of axis_2 matches: wrong joint order\)"),
        (np.roll(qd, 100, axis=0), r"timestamps of a signal other than q"),
    ]:
        with pytest.raises(ShapeError, match="derivative of q.*" + words + ".*Correct the column, or omit qd"):
            prepare(changed(excited, qd=wrong), robot)


def test_a_locked_joint_that_is_not_fitted_has_no_velocity_to_compare(truth, excited) -> None:
    q, qd = excited["q"].copy(), excited["qd"].copy()
    q[:, 6], qd[:, 6] = 0.3, 1e-3 * np.random.default_rng(0).standard_normal(len(q))
    for speed in (qd, np.where(np.arange(7) == 6, 0.0, qd)):
        assert prepare(changed(excited, q=q, qd=speed), truth.robot, joints=range(6)).seconds > 29.0
    with pytest.raises(NotExcited, match="axis_6"):
        prepare(changed(excited, q=q, qd=qd), truth.robot)


def test_positions_in_degrees_or_of_the_motors(truth, excited) -> None:
    robot, q = truth.robot, excited["q"]
    check_position(q, robot)
    with pytest.raises(ShapeError, match=r"joint side.*axis_1 \(\S+, limit 2\.941: degrees or motor side"):
        check_position(np.rad2deg(q), robot)
    with pytest.raises(ShapeError, match=r"gear ratio 100, see robots\.couplings\.motor_to_joint"):
        prepare(changed(excited, q=joint_to_motor(robot, q)), robot)
    slide = replace(robot, prismatic=np.arange(7) == 0)
    with pytest.raises(ShapeError, match="millimetres, divide by 1000"):
        check_position(q * np.array([1e3, 1, 1, 1, 1, 1, 1]), slide)
    moved = np.array([np.zeros(7), [0.006, 0.006, 0.02, 0, 0, 0, 0]])  # by a degree or by 5 mm
    np.testing.assert_array_equal(has_moved(moved, slide), [True, False, True, False, False, False, False])
    with pytest.raises(ShapeError, match="no known unit"):
        check_position(1e6 * q, robot)


def test_a_known_model_can_make_nothing_of_degrees_or_of_a_torque_that_is_not_measured(truth, excited) -> None:
    robot, q, tau = truth.robot, excited["q"], excited["tau"]
    torn = np.where(np.arange(len(q))[:, None] % 7 == 0, np.nan, q)
    check_known(torn, tau, robot)
    with pytest.raises(ShapeError, match=r"axis_1 \(\S+, limit 2\.941: degrees"):
        check_known(np.rad2deg(torn), tau, robot)
    with pytest.raises(
        NotExcited, match=r"got constant values for axis_1 \(constant torque\).*that the robot sends torque"
    ):
        check_known(q, np.zeros_like(tau), robot)


def test_rest_glitches_a_dead_joint_and_joints_without_end_are_no_reason_to_refuse_an_estimate(truth, excited) -> None:
    robot, q, tau = truth.robot, excited["q"], excited["tau"]
    rows = np.arange(len(q))[:, None]
    check_known(np.where(rows % 200 == 0, 1e6, q), tau, robot)
    check_known(q, np.where(np.arange(7) == 2, 0.0, tau), robot)
    check_known(np.tile(q[0], (100, 1)), np.zeros((100, 7)), robot)
    check_known(np.full_like(q, np.nan), tau, robot)
    check_known(q[:0], tau[:0], robot)
    endless = robots.from_links("endless", robot.links)
    check_known(100.0 * q, tau, endless)


def test_torque_of_the_motors_without_masses_in_the_robot_file(truth, excited) -> None:
    """The arm is judged by its reach: by motor torques at a gear ratio of 100, a finger could hold it up."""
    robot = truth.robot
    assert robot.inertias is None
    words = r"motor torques for .*axis_1 \(gear ratio 100\).*reach.*motor_torque_to_joint"
    with pytest.raises(ShapeError, match=words):
        prepare(changed(excited, tau=joint_torque_to_motor(robot, excited["tau"])), robot)
    silent = replace(robot, coupling=np.eye(7))
    with pytest.raises(ShapeError, match="Multiply the torque by the gear ratio, and add the coupling to the robot"):
        prepare(changed(excited, tau=excited["tau"] / 100), silent)
    links = np.tile(np.eye(4), (3, 1, 1))
    links[1:, 0, 3] = 0.3  # vertical axes lift nothing, so torques may be arbitrarily small
    q = np.random.default_rng(1).standard_normal((100, 2))
    check_torque(q, 1e-6 * q, np.ones(2, dtype=bool), robots.from_links("scara", links))


@pytest.mark.parametrize("gear", [30.0, 100.0])
def test_torque_of_the_motors_with_masses_in_the_robot_file(gear: float) -> None:
    """CAD masses that are off by a third, without friction, still distinguish motor from joint torques."""
    robot = replace(robots.load("ur5e"), coupling=np.eye(6) / gear)
    q, qd, qdd = dither(robot.q_home, 10.0, amplitude=0.6, frequency=0.2).sample(np.arange(0, 10, 0.008))
    tau = robot.chain.rnea(q, qd, qdd, robot.gravity, 1.3 * robot.inertias) + 5.0 * np.sign(qd)
    used = np.ones(6, dtype=bool)
    check_torque(q, tau, used, robot)
    check_torque(q, 0.4 * tau, used, robot)
    with pytest.raises(ShapeError, match=rf"gear ratio {gear:g}\).*times the weight of the links"):
        check_torque(q, joint_torque_to_motor(robot, tau), used, robot)


def test_a_torque_that_hardly_ever_changes(truth, excited) -> None:
    """Quantised to a single value in most rows. A joint whose torque is not fitted may be like this."""
    tau = excited["tau"].copy()
    tau[:, 6] = np.round(tau[:, 6] / 1.0)
    tau[np.arange(len(tau)) % 10 != 0, 6] = 0.0
    with pytest.raises(
        NotExcited, match=r"constant values for axis_6 \(the same torque in 9\d % of the rows\)"
    ) as caught:
        prepare(changed(excited, tau=tau), truth.robot)
    assert caught.value.directions == (truth.robot.joint_names[6],)
    check_torque(excited["q"], tau, np.arange(7) < 6, truth.robot)
    prepare(changed(excited, tau=tau), truth.robot, joints=range(6))

"""Columns made piece by piece are the filtered columns of the whole record."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.identify import base_parameters, prepare
from armlab.identify.columns import SMOOTH, Columns, Decimation
from armlab.kernels import presliding


@pytest.fixture(scope="module")
def columns(truth, excited) -> Columns:
    data = prepare(excited, truth.robot)
    motors = np.array([[0, 0, 0, 0, 0, 1.0, 1.0]])
    return Columns(data, Decimation.of(data, np.inf, 7), truth.robot, np.array([1, 4, 6]), motors)


def test_plain_columns_are_torque_velocity_offset_ripple_and_motors(columns) -> None:
    data, rows, joints = columns.data, columns.thinning.rows, columns.joints
    qdd = data.differentiate(data.qd)
    tau, fixed, coupled = columns.plain(qdd)
    np.testing.assert_array_equal(tau, data.tau[rows][:, joints])
    np.testing.assert_array_equal(fixed[:, :, 0], data.qd[rows][:, joints])
    np.testing.assert_array_equal(fixed[:, :, 1], 1.0)
    angle = columns.cycles * data.q[rows][:, joints]
    seen = fixed[:, :, 2] != 0
    np.testing.assert_allclose(fixed[:, :, 2][seen], np.cos(angle)[seen], rtol=1e-12)
    np.testing.assert_allclose(coupled[:, 0, 1], data.qd[rows, 5] + data.qd[rows, 6], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(columns.coupled_sign(), np.tanh(coupled[:, :, 1] / SMOOTH), rtol=1e-12, atol=1e-12)


def test_rigid_columns_are_those_of_the_regressor(columns) -> None:
    data, rows, robot = columns.data, columns.thinning.rows, columns.robot
    base, qdd = base_parameters(robot, joints=columns.joints.tolist()), data.differentiate(data.qd)
    Y = robot.chain.rigid_regressor(data.q[rows], data.qd[rows], qdd[rows], robot.gravity)
    for joint, found in zip(columns.joints, columns.rigid(qdd, base)):
        kept = base.kept[base.seen[joint]]
        links = kept < 70
        np.testing.assert_allclose(found[:, links], Y[:, joint, kept[links]], atol=1e-12)
        np.testing.assert_array_equal(found[:, ~links], qdd[rows][:, kept[~links] - 70])


def test_shaped_columns_have_presliding_or_a_smooth_sign(columns) -> None:
    data, rows, joints = columns.data, columns.thinning.rows, columns.joints
    delta, smooth, speeds = np.full(3, 1e-3), np.array([0.0, 0.02, 0.0]), np.array([[0.1] * 3, [0.3] * 3])
    z = presliding(np.ascontiguousarray(data.q[:, joints]), delta, data.resolution[joints])
    z[:, 1] = np.tanh(data.qd[:, 4] / 0.02)
    z, qd = z[rows], data.qd[rows][:, joints]
    expected = [np.maximum(z, 0), np.minimum(z, 0), z * np.sqrt(np.abs(qd))]
    expected += [z * np.exp(-((qd / speed) ** 2)) for speed in speeds]
    np.testing.assert_allclose(columns.shaped(delta, smooth, speeds), np.stack(expected, axis=2), atol=1e-12)

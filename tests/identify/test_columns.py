"""Columns of the regression: decimation, friction, rigid body and motors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.identify import base_parameters, prepare
from armlab.identify.columns import SMOOTH, Columns, Decimation, FrictionColumns
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


# Filter and decimation in one pass.


@pytest.fixture(scope="module")
def data(truth, excited):
    """A record of two segments."""
    whole = prepare(excited, truth.robot)
    return replace(whole, segments=((0, 5000), (5000, len(whole.t))))


def test_thinning_is_the_zero_phase_filter_at_the_rows_that_are_kept(data) -> None:
    thinning = Decimation.of(data, 25.0, 4)
    got = thinning.run(lambda a, b: data.tau[a:b], data.tau.shape[1])
    expected = data.filter(data.tau, 25.0)[thinning.rows]
    inside = np.concatenate([np.arange(50, 1200), np.arange(1300, len(got) - 50)])
    scale = np.std(expected, axis=0)
    assert np.max(np.abs(got - expected)[inside] / scale) < 1e-5
    assert np.max(np.abs(got - expected) / scale) < 0.1, "ends are continued in another way"


def test_a_constant_and_a_slope_pass_unchanged(data) -> None:
    for every in (1, 3, 7):
        thinning = Decimation.of(data, 10.0, every)
        x = np.column_stack([np.ones(len(data.t)), np.arange(len(data.t))])
        np.testing.assert_allclose(thinning.run(lambda a, b, x=x: x[a:b], 2), x[thinning.rows], rtol=1e-9, atol=1e-6)


def test_without_a_filter_rows_are_picked(data) -> None:
    thinning = Decimation.of(data, np.inf, 50)
    got = thinning.run(lambda a, b: data.tau[a:b], data.tau.shape[1])
    np.testing.assert_array_equal(got, data.tau[thinning.rows])


@pytest.mark.parametrize("rows", [100, 5000])
def test_ends_are_continued_by_point_reflection(data, rows: int) -> None:
    """Also where the filter reaches beyond the other end of the piece."""
    short = replace(data, rate=2500.0, segments=((0, rows),))
    thinning = Decimation.of(short, 25.0, 10)
    reach = len(thinning.taps) // 2
    assert reach > 200
    x = data.tau[:rows]
    wide = np.pad(x, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    expected = [thinning.taps @ wide[k : k + 2 * reach + 1] for k in thinning.rows]
    np.testing.assert_allclose(thinning.run(lambda a, b: x[a:b], x.shape[1]), expected, rtol=1e-9, atol=1e-9)


# Columns of friction: of one joint the same as among all, filtered and thinned.


DELTA, TANH, SPEED = np.array([1e-3, 2e-3, 3e-3]), np.array([0.0, 0.02, 0.0]), np.array([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def motion() -> FrictionColumns:
    """Three joints over two segments, every second row kept, a filter of five taps."""
    rng = np.random.default_rng(0)
    qd = np.cumsum(0.01 * rng.standard_normal((900, 3)), axis=0)
    segments = ((0, 400), (400, 900))
    rows = np.concatenate([np.arange(0, 400, 2), np.arange(400, 900, 2)])
    taps = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    return FrictionColumns(Decimation(segments, 2, taps, rows), np.cumsum(0.004 * qd, axis=0), qd, np.full(3, 1e-5))


def test_the_sign_is_the_presliding_state_of_each_segment_or_smooth(motion: FrictionColumns) -> None:
    s = motion.sign(DELTA, TANH)
    for a, b in motion.thinning.segments:
        z = presliding(motion.q[a:b], DELTA, motion.resolution)
        np.testing.assert_array_equal(s[a:b, [0, 2]], z[:, [0, 2]])
    np.testing.assert_array_equal(s[:, 1], np.tanh(motion.qd[:, 1] / 0.02))

"""Primitives of poses: order, norm, frames, invariances, files, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.lie import quaternion, so3
from armlab.motion import PoseDmp
from armlab.motion.pose_dmp import FRAMES

Taught = Fit[PoseDmp]


def shifted(w: list[float], p: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(w), p
    return T


MOVE = shifted([0.4, 1.1, -0.7], [0.2, -0.5, 0.1])


def test_order_is_four_and_quaternions_keep_their_length(pose_fit: Taught) -> None:
    smooth = pose_fit.value.position.centres * 0 + 1
    dmp = pose_fit.value
    coarse = replace(dmp, rotation=replace(dmp.rotation, weights=np.outer(smooth, [300, -200, 250.0])))
    fine = coarse.rollout(np.linspace(0, 1, 1601))
    errors = []
    for N in (100, 200, 400):
        run = coarse.rollout(np.linspace(0, 1, N + 1))
        errors.append(np.abs(run.q - fine.q[:: 1600 // N]).max())
        np.testing.assert_allclose(np.linalg.norm(run.q, axis=1), 1.0, rtol=0, atol=1e-12)
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders.min() > 3.8


def test_it_starts_and_ends_where_it_was_taught(pose_fit: Taught, pose_demo: tuple[np.ndarray, np.ndarray]) -> None:
    dmp, T = pose_fit.value, pose_demo[1]
    np.testing.assert_allclose(dmp.T_start, T[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(dmp.T_goal, T[-1], rtol=0, atol=1e-12)
    assert dmp.duration == 1.0
    late = dmp.rollout(np.linspace(0, 8, 2001)).T[-1]
    np.testing.assert_allclose(late, T[-1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_another_goal_and_start_are_reached_from_quaternions_of_either_sign(pose_fit: Taught, sign: float) -> None:
    start, goal = (np.r_[T[:3, 3], sign * quaternion.from_matrix(T[:3, :3])] for T in (MOVE, MOVE @ MOVE))
    run = pose_fit.value.rollout(0.004, start=start, goal=goal, duration=3.0)
    long = pose_fit.value.rollout(np.linspace(0, 9, 900), start=MOVE, goal=MOVE @ MOVE)
    np.testing.assert_allclose(run.T[0], MOVE, rtol=0, atol=1e-12)
    np.testing.assert_allclose(long.T[-1], MOVE @ MOVE, rtol=0, atol=1e-7)


def test_start_and_goal_moved_together_move_the_path_in_the_frame_of_the_goal(pose_fit: Taught) -> None:
    dmp = replace(pose_fit.value, frame="goal")
    here = dmp.rollout(0.004)
    there = dmp.rollout(0.004, start=MOVE @ dmp.T_start, goal=MOVE @ dmp.T_goal)
    np.testing.assert_allclose(there.T, MOVE @ here.T, rtol=0, atol=1e-9)
    R = MOVE[:3, :3]
    np.testing.assert_allclose(there.twist.reshape(-1, 2, 3), here.twist.reshape(-1, 2, 3) @ R.T, rtol=0, atol=1e-8)
    base = pose_fit.value.rollout(0.004, start=MOVE @ dmp.T_start, goal=MOVE @ dmp.T_goal)
    assert np.abs(base.T - there.T).max() > 0.01
    np.testing.assert_allclose(pose_fit.value.rollout(0.004).T, here.T, rtol=0, atol=1e-12)


def test_the_forcing_of_the_orientation_is_scaled_before_it_is_turned(pose_fit: Taught) -> None:
    """From another start, which scales each axis by itself, start and goal moved together still move the path."""
    dmp = replace(pose_fit.value, frame="goal")
    start = dmp.T_start @ shifted([0.3, -0.2, 0.1], [0.05, 0.0, -0.02])
    here, there = dmp.rollout(0.01, start=start), dmp.rollout(0.01, start=MOVE @ start, goal=MOVE @ dmp.T_goal)
    np.testing.assert_allclose(there.T, MOVE @ here.T, rtol=0, atol=1e-9)


def test_turns_about_one_axis_grow_with_the_displacement(pose_fit: Taught) -> None:
    """Then orientations are one angle, for which the equation is linear; without scaling the forcing stays."""
    dmp = pose_fit.value
    weights = dmp.rotation.weights * [0, 0, 1]
    dmp = replace(dmp, rotation=replace(dmp.rotation, weights=weights, y0=np.array([0, 0, 0.8]), v0=np.zeros(3)))

    def angles(size: float, own: PoseDmp) -> np.ndarray:
        start = own.T_goal.copy()
        start[:3, :3] = so3.exp([0, 0, 0.8 * size]) @ own.T_goal[:3, :3]
        return so3.log(own.rollout(0.01, start=start).T[:, :3, :3] @ own.T_goal[:3, :3].T)[:, 2]

    np.testing.assert_allclose(angles(1.7, dmp), 1.7 * angles(1.0, dmp), rtol=0, atol=1e-5)
    plain = replace(dmp, rotation=replace(dmp.rotation, scaling="none"))
    assert np.abs(angles(1.7, plain) - 1.7 * angles(1.0, plain)).max() > 0.01


def test_velocities_at_the_start_are_in_base_axes(pose_fit: Taught) -> None:
    dmp, twist = replace(pose_fit.value, frame="goal"), np.array([0.1, 0.2, -0.3, 0.4, -0.5, 0.6])
    run = dmp.rollout(0.004, start=MOVE @ dmp.T_start, goal=MOVE @ dmp.T_goal, twist0=twist)
    np.testing.assert_allclose(run.twist[0], twist, rtol=0, atol=1e-12)


def test_it_takes_the_shorter_way_where_the_quaternions_point_apart(pose_fit: Taught) -> None:
    """Start and goal are 4 rad apart about x one way, and 2.3 rad the other."""
    still = replace(
        pose_fit.value, rotation=replace(pose_fit.value.rotation, weights=np.zeros((50, 3)), v0=np.zeros(3))
    )
    run = still.rollout(
        np.linspace(0, 4, 400), start=shifted([2.0, 0, 0], [0, 0, 0]), goal=shifted([-2.0, 0, 0], [0] * 3)
    )
    turned = np.linalg.norm(so3.log(np.swapaxes(run.T[:-1, :3, :3], 1, 2) @ run.T[1:, :3, :3]), axis=1).sum()
    assert turned == pytest.approx(2 * np.pi - 4, abs=1e-3)
    assert ((run.q[1:] * run.q[:-1]).sum(axis=1) > 0).all()


def test_time_stretches(pose_fit: Taught) -> None:
    t = np.linspace(0, 1, 251)
    once, twice = pose_fit.value.rollout(t), pose_fit.value.rollout(2 * t, duration=2.0)
    np.testing.assert_allclose(twice.T, once.T, rtol=0, atol=1e-10)
    np.testing.assert_allclose(2 * twice.twist, once.twist, rtol=0, atol=1e-9)


def test_bad_input_is_refused_by_a_sentence(pose_fit: Taught) -> None:
    dmp = pose_fit.value
    assert dmp.frame in FRAMES
    half = shifted([0, 0, np.pi], [0, 0, 0])
    for words, call in {
        "half a turn apart": lambda: dmp.rollout(0.004, start=half @ dmp.T_goal),
        "start as a pose": lambda: dmp.rollout(0.004, start=np.eye(3)),
        "finite goal": lambda: dmp.rollout(0.004, goal=np.full((4, 4), np.nan)),
        "times that increase": lambda: dmp.rollout([0.0, 0.0]),
        "dt above zero": lambda: dmp.rollout(-0.1),
        "twist0 with 6": lambda: dmp.rollout(0.004, twist0=np.zeros(3)),
        "one tau_d for position": lambda: replace(dmp, rotation=replace(dmp.rotation, tau_d=1.0)),
        "rotation with goal 0": lambda: replace(dmp, rotation=replace(dmp.rotation, g=np.ones(3))),
        "position as a Dmp": lambda: replace(dmp, position=None),
        "length 1": lambda: replace(dmp, goal=np.ones(4)),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
    with pytest.raises(ConfigError, match="duration or tau_d"):
        dmp.rollout(0.004, duration=1.0, tau_d=1.0)
    with pytest.raises(UnknownName, match="frame"):
        replace(dmp, frame="tool")

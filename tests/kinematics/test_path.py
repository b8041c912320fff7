"""Paths: accuracy, branches, singular passages, closed paths, and reports where a path breaks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest

from armlab import kernels, lie, robots
from armlab.errors import NotConverged, ShapeError
from armlab.kinematics import forward, inverse, inverse_path, singular_values
from armlab.kinematics.path import IkPath
from armlab.robots import Robot

ROWS = 500
YUMI, IRB = robots.load("yumi_left"), robots.load("irb2400")


def wave(robot: Robot, count: int, seed: int, reach: float = 0.3) -> np.ndarray:
    """A smooth joint path inside the limits."""
    rng = np.random.default_rng(seed)
    middle, ranges = (robot.q_min + robot.q_max) / 2, np.minimum(robot.q_max - robot.q_min, np.pi)
    s = np.linspace(0, 1, count)[:, None]
    return middle + ranges * reach * np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, robot.n) * s + rng.random(robot.n)))


def circle(robot: Robot, q: np.ndarray, radius: float, count: int) -> np.ndarray:
    """Poses twice around a circle through a posture's pose, with a swaying rotation; the last equals the first."""
    angle = np.linspace(0, 4 * np.pi, count)
    T = np.tile(forward(robot, q), (count, 1, 1))
    T[:, 1, 3] += radius * np.sin(angle)
    T[:, 2, 3] += radius * (np.cos(angle) - 1)
    T[:, :3, :3] = T[:, :3, :3] @ lie.so3.exp(0.3 * np.sin(angle)[:, None] * [1.0, 0.5, 0.0])
    T[-1] = T[0]
    return T


def errors(robot: Robot, q: np.ndarray, T: np.ndarray) -> tuple[float, float]:
    """Largest errors of position and rotation, computed without the code under test."""
    there = forward(robot, q)
    turn = lie.so3.log(np.swapaxes(there[:, :3, :3], 1, 2) @ T[:, :3, :3])
    return np.linalg.norm(there[:, :3, 3] - T[:, :3, 3], axis=1).max(), np.linalg.norm(turn, axis=1).max()


@pytest.mark.parametrize(("objective", "seed"), [(None, 3), ("posture", 4), ("mid_range", 5)])
def test_poses_are_reached_inside_the_limits(objective: Any, seed: int) -> None:
    q = wave(YUMI, ROWS, seed)
    T = forward(YUMI, q)
    path = inverse_path(YUMI, T, q[0], objective=objective)
    assert path.success.all()
    assert (path.reason == "solved").all()
    assert path.branch_changes.shape == (0,)
    assert max(errors(YUMI, path.q, T)) <= 1e-9
    assert max(path.position_error.max(), path.rotation_error.max()) <= 1e-9
    assert (YUMI.q_min <= path.q).all()
    assert (path.q <= YUMI.q_max).all()
    assert np.abs(np.diff(path.q, axis=0)).max() < 50 / ROWS
    assert path.report() == f"All {ROWS} poses reached on one branch."


def test_detours_lead_on_where_the_least_motion_ends() -> None:
    """Least motion breaks one in five large motions of seven joints; detours repair most of these."""
    broken, mended = 0, 0
    for seed in range(25):
        q = wave(YUMI, 500, seed)
        T = forward(YUMI, q)
        counts = kernels.follow_path(YUMI.inverse_solver, T, q[0])[2]
        if not counts[:, 1].any():
            continue
        broken += 1
        path = inverse_path(YUMI, T, q[0])
        mended += bool(path.success.all())
        assert (~path.success).sum() <= np.count_nonzero(counts[:, 1])
        assert np.abs(np.diff(path.q[path.success], axis=0)).max() < 0.2 or not path.success.all()
        assert max(errors(YUMI, path.q[path.success], T[path.success])) <= 1e-9
        assert ((YUMI.q_min <= path.q) & (path.q <= YUMI.q_max)).all()
    assert broken >= 5
    assert mended >= broken / 2


ELBOWS = {  # seed of a motion: singular posture (stretched arm) on it, from Newton steps to J^T u = 0
    2: [-0.93122445307, -0.90183311819, -0.08261445186, -1.1902285784, 0.28462911968, 0.61356286254, -1.49687788119],
    3: [-1.47830751858, -1.06355786578, 0.91571908093, -1.23373591845, -2.2472460777, 0.013305745, -0.10047342614],
    4: [1.5638315892, -0.57021512563, 1.67886154333, -1.42534095549, 0.63916739911, -0.02572055412, 1.44796793734],
    5: [1.06509702266, 0.0, 0.05732155181, -1.11568027178, -2.71062754879, 0.02868927447, -0.438977589],
    6: [0.15445713901, -0.86103170813, -0.17502963377, -1.09780358291, 2.79443944813, 0.56698011771, 0.83608629658],
    7: [0.43397542038, 0.0, 0.68883896055, -1.1688460887, -1.26676860238, 1.14558488066, -2.3728291239],
}  # fmt: skip


def test_through_singular_elbows_without_a_jump() -> None:
    """4 ms steps of a joint motion at about 1 rad/s that passes exactly through a singular posture."""
    for seed, singular in ELBOWS.items():
        assert singular_values(YUMI, singular)[-1] < 1e-10
        q = singular + np.linspace(-0.6, 0.6, 301)[:, None] * np.random.default_rng(seed + 100).uniform(-1, 1, 7)
        T = forward(YUMI, q)
        path = inverse_path(YUMI, T, q[0], max_step=0.05)
        assert path.success.all(), f"seed {seed}: {path.report()}"
        assert np.abs(np.diff(path.q, axis=0)).max() <= 0.05 + 1e-12
        assert max(errors(YUMI, path.q, T)) <= 1e-9


def test_through_a_singular_wrist() -> None:
    """Joint 5 of the IRB 2400 passes zero, where axes 4 and 6 coincide; all joints move on as before."""
    s = np.linspace(-0.4, 0.4, 201)[:, None]
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.0, 0.5]) + s * [0.3, -0.2, 0.4, 0.5, 1.0, -0.6]
    path = inverse_path(IRB, forward(IRB, q), q[0], max_step=0.05)
    assert path.success.all()
    np.testing.assert_allclose(path.q, q, rtol=0, atol=1e-3)  # at the singular row itself only q4 + q6 is determined
    np.testing.assert_allclose(np.delete(path.q, 100, axis=0), np.delete(q, 100, axis=0), rtol=0, atol=1e-6)


def test_a_closed_path_closes_in_the_joints() -> None:
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.8, 0.2])
    path = inverse_path(IRB, circle(IRB, q, 0.2, 201), q)
    assert path.success.all()
    np.testing.assert_allclose(path.q[-1], path.q[0], rtol=0, atol=1e-8)
    q = np.array([-0.8, -1.2, 0.9, 0.3, 0.4, 0.6, 0.2])
    T = circle(YUMI, q, 0.06, 201)
    wishes: list[dict[str, Any]] = [
        {"objective": "posture"},
        {"objective": "mid_range"},
        {"objective": "posture", "posture": q + 0.2},
    ]
    for wish in wishes:
        path = inverse_path(YUMI, T, q, **wish)
        assert path.success.all()
        np.testing.assert_allclose(path.q[-1], path.q[0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(path.q[100], path.q[0], rtol=0, atol=1e-6)
    drift = inverse_path(YUMI, T, q)
    assert np.abs(drift.q[-1] - drift.q[0]).max() > 1e-3  # why objectives exist


def test_out_of_reach_is_said_and_left_behind() -> None:
    q = wave(IRB, 100, seed=1)
    T = forward(IRB, q)
    T[40:50, 0, 3] += 5.0
    path = inverse_path(IRB, T, q[0], max_step=1.0)
    assert (path.reason[40:50] == "out of reach").all()
    assert (path.success[:40]).all()
    assert path.position_error[40] > 1.0
    assert path.reason[50] == "jump"  # from the posture with the least error
    assert path.success[51:].all()
    assert (
        "89 of 100 poses reached; the path breaks at index 40 (out of reach; in total: 1 jump, 10 out of reach"
        in path.report()
    )


def test_limits_end_a_branch_and_another_goes_on() -> None:
    """Joint 1 would have to continue beyond its limit; after the break it has turned back by almost a revolution."""
    robot = replace(
        IRB, q_min=np.where(np.arange(6) == 0, -2.0, IRB.q_min), q_max=np.where(np.arange(6) == 0, 2.0, IRB.q_max)
    )
    q = np.array([1.5, 0.2, -0.3, 0.4, 0.8, 0.2]) + np.linspace(0, 0.8, 81)[:, None] * [1.0, 0, 0, 0, 0, 0]
    path = inverse_path(robot, forward(robot, q), q[0])
    first = int(np.argmax(~path.success))
    assert first == 51
    assert path.reason[first] == "limits"
    assert (path.q <= robot.q_max).all()
    for change in path.branch_changes:
        assert not path.success[change]
        assert max(path.position_error[change], path.rotation_error[change]) <= 1e-9


def test_a_jump_is_said() -> None:
    q = wave(IRB, 100, seed=1)
    gap = np.concatenate([q[:50], q[60:]])
    path = inverse_path(IRB, forward(IRB, gap), q[0], max_step=0.05)
    assert path.reason[50] == "jump"
    assert path.success.sum() == 89
    assert len(path.branch_changes) == 0
    np.testing.assert_allclose(path.q, gap, rtol=0, atol=1e-6)
    per_joint = inverse_path(IRB, forward(IRB, gap), q[0], max_step=np.full(6, 1.0))
    assert per_joint.success.all()


@pytest.mark.parametrize("task", ["position", "axis", "direction"])
def test_smaller_tasks(task: Any) -> None:
    q = wave(YUMI, 100, seed=3)
    T, axis = forward(YUMI, q), np.array([0.0, 1.0, 1.0])
    path = inverse_path(YUMI, T, q[0], task=task, axis=axis)
    assert path.success.all()
    there = forward(YUMI, path.q)
    if task != "direction":
        assert np.abs(there[:, :3, 3] - T[:, :3, 3]).max() <= 1e-9
    if task != "position":
        assert np.abs((there - T)[:, :3, :3] @ axis).max() <= 1e-8


def test_strict_raises_with_the_path() -> None:
    q = wave(IRB, 20, seed=1)
    T = forward(IRB, q)
    assert inverse_path(IRB, T, q[0], strict=True).success.all()
    T[7, 0, 3] += 9.0
    with pytest.raises(NotConverged, match="breaks at index 7") as caught:
        inverse_path(IRB, T, q[0], strict=True)
    assert isinstance(caught.value.best, IkPath)


def test_empty_path_and_one_pose() -> None:
    path = inverse_path(YUMI, np.zeros((0, 4, 4)))
    assert path.q.shape == (0, 7)
    assert path.report() == "All 0 poses reached on one branch."
    T = forward(YUMI, YUMI.q_home)
    one = inverse_path(YUMI, T[None], YUMI.q_home)
    np.testing.assert_allclose(one.q[0], inverse(YUMI, T, YUMI.q_home).q, rtol=0, atol=1e-9)


def test_refusals() -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    for step in ([1.0, 2.0], -1.0, np.nan):
        with pytest.raises(ShapeError, match=r"Expected max_step to be one number or 6 numbers"):
            inverse_path(IRB, T, max_step=step)
    for poses in (np.eye(4), np.tile(np.eye(4), (2, 3, 1, 1)), np.zeros((2, 3, 3))):
        with pytest.raises(ShapeError, match="Expected T_base_tool of shape"):
            inverse_path(IRB, poses)
    for wrong, words in (
        ({"objective": "posture", "posture": np.zeros(7)}, "posture of"),
        ({"q0": np.zeros(7)}, "q0 of"),
    ):
        with pytest.raises(ShapeError, match=words + r" shape \(6,\)"):
            inverse_path(IRB, T, **wrong)


@pytest.fixture
def patient_threads() -> Iterator[None]:
    """No thread asks another for the interpreter: it runs on until it lets go by itself."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100.0)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("patient_threads")
def test_long_paths_let_other_threads_run() -> None:
    T, done = np.tile(forward(IRB, IRB.q_home), (50_000, 1, 1)), []

    def work() -> None:
        inverse_path(IRB, T, IRB.q_home)
        done.append(True)

    thread = Thread(target=work)
    thread.start()  # returns when the worker lets go of the interpreter
    assert not done
    thread.join()
    assert done

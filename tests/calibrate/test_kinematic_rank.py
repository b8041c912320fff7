"""What measurements of an arm see, and by which name they are refused where they do not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.calibrate import fit_kinematics
from armlab.calibrate.kinematics.fit import LIMITS
from armlab.errors import NotExcited
from armlab.estimation import Fit
from armlab.kinematics import forward
from armlab.lie import se3
from armlab.sim import cell
from armlab.sim._cell_kinematics import (
    ANCHOR,
    NOISE,
    KinematicRun,
    dh_arm,
    sliding_robot,
    spoilt,
)


@pytest.fixture(scope="module")
def case() -> KinematicRun:
    return cell(2000).kinematics(0, 150)


def missing(fit: Fit[Any]) -> list[str]:
    return [name.removeprefix("missing: ") for name in fit.excitation.null_names if name.startswith("missing: ")]


def to_anchor(run: KinematicRun) -> dict[str, Any]:
    return {"distance": np.linalg.norm(run.pose[:, :3, 3] - ANCHOR, axis=1), "anchor": ANCHOR}


def between(run: KinematicRun) -> dict[str, Any]:
    i = np.arange(len(run.q))
    ends = np.concatenate([i, i]), np.concatenate([np.roll(i, 1), np.roll(i, 7)])
    return {"pair_distance": (*ends, np.linalg.norm(run.pose[ends[0], :3, 3] - run.pose[ends[1], :3, 3], axis=1))}


class TestRank:
    """The table of the theory page: what each kind of measurement sees of an arm with six joints."""

    @pytest.mark.parametrize(
        ("rank", "unseen", "options"),
        [
            (30, 0, lambda run: {"pose": run.pose, "noise": NOISE}),
            (27, 3, lambda run: {"position": run.pose[:, :3, 3], "noise": 1e-4}),
            (30, 0, lambda run: {"position": run.points(2), "noise": 1e-4}),
            (33, 0, lambda run: {"position": run.points(3), "noise": 1e-4}),
            (26, 4, lambda run: {"position": run.pose[:, :3, 3], "noise": (1e-4, 1e-4, np.inf)}),
            (24, 6, lambda run: {"position": run.pose[:, :3, 3], "noise": (np.inf, np.inf, 1e-4)}),
            (15, 15, lambda run: {"pose": run.pose, "noise": (np.inf, NOISE[1])}),
            (24, 9, lambda run: {**to_anchor(run), "noise": 1e-4}),
            (25, 9, lambda run: {**to_anchor(run), "noise": 1e-4, "length_offset": True}),
            (21, 9, lambda run: {**between(run), "noise": 1e-4}),
            (42, 0, lambda run: {"pose": run.pose, "noise": NOISE, "harmonics": (1,)}),
            (42, 0, lambda run: {"pose": run.pose, "noise": NOISE, "harmonics": (2,)}),
            (42, 0, lambda run: {"pose": run.pose, "noise": NOISE, "harmonics": (3,)}),
            (54, 0, lambda run: {"pose": run.pose, "noise": NOISE, "harmonics": (1, 2)}),
            (66, 0, lambda run: {"pose": run.pose, "noise": NOISE, "harmonics": (1, 2, 3)}),
            (51, 3, lambda run: {"position": run.pose[:, :3, 3], "noise": 1e-4, "harmonics": (1, 2)}),
            (36, 0, lambda run: {"pose": run.pose, "noise": NOISE, "joint_terms": run.q[:, :, None] * np.eye(6)}),
        ],
        ids=[
            "pose",
            "1 point",
            "2 points",
            "3 points",
            "x y",
            "z",
            "orientation",
            "distance",
            "and offset",
            "pairs",
            "order 1",
            "order 2",
            "order 3",
            "1 2",
            "1 2 3",
            "both",
            "gear",
        ],
    )
    @pytest.mark.parametrize("model", ["local_poe", "poe"])
    def test_six_joints_that_turn(self, case, rank: int, unseen: int, options: Callable, model: str) -> None:
        fit = fit_kinematics(case.robot, case.q, model=model, **options(case))
        assert fit.excitation.rank == fit.excitation.expected == rank
        assert fit.rank == rank
        gauge = [name for name in fit.excitation.null_names if name.startswith("gauge: ")]
        assert len(gauge) == 12
        assert len(missing(fit)) == unseen
        assert fit.excitation.null_space.shape == (len(fit.names), 12 + unseen)
        np.testing.assert_allclose(
            fit.excitation.null_space.T @ fit.excitation.null_space, np.eye(12 + unseen), atol=1e-12
        )

    @pytest.mark.parametrize(("kind", "rank"), [("pose", 28), ("position", 25), ("2 points", 28), ("3 points", 31)])
    def test_one_joint_that_slides(self, kind: str, rank: int) -> None:
        """4 r + 2 p + 6 for poses, 4 r + 2 p + 3 K for points."""
        rng, robot = np.random.default_rng(1), sliding_robot()
        q = rng.uniform(-2, 2, (80, 6))
        T = forward(robot, q)
        points = np.array([[0.05, 0.0, 0.02], [-0.03, 0.06, 0.0], [0.0, -0.04, 0.07]])
        data = {
            "pose": {"pose": T, "noise": (1e-4, 1e-4)},
            "position": {"position": T[:, :3, 3], "noise": 1e-4},
            "2 points": {"position": (T[:, None] @ se3.from_rp(np.eye(3), points[:2]))[..., :3, 3], "noise": 1e-4},
            "3 points": {"position": (T[:, None] @ se3.from_rp(np.eye(3), points))[..., :3, 3], "noise": 1e-4},
        }[kind]
        fit = fit_kinematics(robot, q, **data)
        assert fit.excitation.rank == rank
        assert sum(name.startswith("gauge: ") for name in fit.excitation.null_names) == 14

    def test_nothing_that_is_called_unseen_moves_the_measurement(self, case) -> None:
        """Each direction of the null space, taken as a step of 1 mm or 1 mrad, leaves all positions where they are."""
        fit = fit_kinematics(case.robot, case.q, position=case.pose[:, :3, 3], noise=1e-4)
        J = fit.value.pose_jacobian(case.q_valid)[:, :3]
        assert np.abs(J @ fit.excitation.null_space).max() < 1e-9

    def test_parts_of_the_arm(self, case) -> None:
        """Six joint offsets with base and tool: the first goes with the base, the last with the tool."""
        robot, q = case.robot, case.q
        shift = 0.02 * np.random.default_rng(4).standard_normal(6)
        pose = forward(robot, q + shift)
        fit = fit_kinematics(robot, q, pose=pose, noise=NOISE, free="offsets")
        assert fit.excitation.rank == 16
        np.testing.assert_allclose(fit.value.forward(q), pose, rtol=0, atol=1e-9)
        mask = np.zeros((7, 6), dtype=bool)
        mask[np.arange(1, 5), 5] = True
        mask[[0, -1]] = True
        again = fit_kinematics(robot, q, pose=pose, noise=NOISE, free=mask)
        np.testing.assert_allclose(again.value.forward(q), pose, rtol=0, atol=1e-9)
        frames = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]) @ forward(robot, q) @ se3.exp([0.1, 0, 0, 0.3, 0, 0])
        assert fit_kinematics(robot, q, pose=frames, noise=NOISE, free="base_tool").excitation.rank == 12


class TestRefusals:
    @pytest.mark.parametrize("noisy", [False, True])
    def test_a_joint_that_did_not_move(self, noisy: bool) -> None:
        run = cell(2000).kinematics(0)
        q = run.q.copy()
        q[:, 3] = 0.3
        pose = run.truth.forward(q)
        if noisy:
            pose = spoilt(pose, np.random.default_rng(0), len(q), NOISE[1], NOISE[0])
        with pytest.raises(NotExcited, match=r"joint 4 did not move.*Move joint 4 over its range") as caught:
            fit_kinematics(run.robot, q, pose=pose, noise=NOISE)
        assert caught.value.directions == ("joint 4 did not move",)
        held = fit_kinematics(run.robot, q, pose=pose, noise=NOISE, weak="prior")
        assert held.excitation.held == ("joint 4 did not move",)
        assert (held.excitation.rank, held.excitation.expected) == (26, 30)
        there = run.q_valid.copy()
        there[:, 3] = 0.3
        assert np.abs(held.value.forward(there) - run.truth.forward(there)).max() < 3e-4

    def test_a_joint_that_hardly_moved(self) -> None:
        run = cell(2000).kinematics(0)
        q = run.q.copy()
        q[:, 3] = 0.3 + 6e-4 * np.sin(np.arange(50.0))
        with pytest.raises(NotExcited, match=r"joint 4 moved by only 0.069 deg"):
            fit_kinematics(run.robot, q, pose=run.truth.forward(q), noise=NOISE)

    @pytest.mark.parametrize("sd", [0.0, 1e-4])
    def test_a_tool_point_on_the_last_axis(self, sd: float) -> None:
        run = cell(2000).kinematics(0, 100, tool=False)
        arm = dh_arm()
        p = arm.forward(run.q)[:, :3, 3] + sd * np.random.default_rng(1).standard_normal((100, 3))
        with pytest.raises(NotExcited, match="tool point lies on the axis of joint 6") as caught:
            fit_kinematics(run.robot, run.q, position=p, noise=1e-4)
        assert caught.value.directions == ("tool point lies on the axis of joint 6",)
        fit = fit_kinematics(run.robot, run.q, position=p, noise=1e-4, weak="prior")
        assert fit.excitation.held == ("tool point lies on the axis of joint 6",)
        if not sd:
            assert (fit.excitation.rank, fit.excitation.expected) == (25, 27)
            assert missing(fit).count("tool point lies on the axis of joint 6") == 2

    def test_an_unknown_scale(self, case) -> None:
        data = {**to_anchor(case), "noise": 1e-4, "length_scale": True}
        with pytest.raises(NotExcited, match="overall scale") as caught:
            fit_kinematics(case.robot, case.q, **data)
        assert caught.value.directions == ("overall scale",)
        fit = fit_kinematics(case.robot, case.q, **data, length_offset=True, weak="prior")
        assert (fit.excitation.rank, fit.excitation.expected) == (25, 26)

    def test_too_few(self, case) -> None:
        with pytest.raises(NotExcited, match=r"at least 30 numbers .* got 24. Measure at least 5 samples"):
            fit_kinematics(case.robot, case.q[:4], pose=case.pose[:4], noise=NOISE)
        with pytest.raises(NotExcited, match=r"at least 27 numbers .* got 24. Measure at least 9 samples"):
            fit_kinematics(case.robot, case.q[:8], position=case.pose[:8, :3, 3], noise=1e-4)
        with pytest.raises(NotExcited, match="got none"):
            fit_kinematics(case.robot, case.q[:0], pose=case.pose[:0])

    def test_limits_are_arguments(self, case) -> None:
        with pytest.raises(NotExcited, match="worse than the limit"):
            fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE, limits=(1e-6, 1e-6))
        assert LIMITS == (0.05, 0.05)

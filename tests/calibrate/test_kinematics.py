"""Kinematic calibration: the truth from exact data, one answer for every chart and frame, its value and its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import models, robots
from armlab.calibrate import fit_kinematics
from armlab.calibrate.kinematics.model import Arm, pose_residual
from armlab.estimation import Fit
from armlab.kinematics import forward, inverse, jacobian
from armlab.lie import se3, so3
from armlab.models import KinematicCorrection
from armlab.sim import cell
from armlab.sim._cell_kinematics import (
    ANCHOR,
    DEGREE,
    NOISE,
    KinematicRun,
    dh_arm,
    sliding_robot,
)


@pytest.fixture(scope="module")
def case() -> KinematicRun:
    return cell(2000).kinematics(0, 150)


@pytest.fixture(scope="module")
def exact() -> KinematicRun:
    run = cell(2000).kinematics(3, 60)
    return replace(run, pose=run.truth.forward(run.q))


class TestExactData:
    @pytest.mark.parametrize("model", ["local_poe", "poe"])
    @pytest.mark.parametrize("kind", ["pose", "position", "distance", "pairs"])
    def test_the_truth_is_found(self, exact, model: str, kind: str) -> None:
        data = measurements(exact, kind)
        fit = fit_kinematics(exact.robot, exact.q, model=model, noise=(1e-4, 1e-4) if kind == "pose" else 1e-4, **data)
        T = fit.value.forward(exact.q_valid)
        if kind in ("pose", "position"):
            np.testing.assert_allclose(T[:, :3, 3], exact.pose_valid[:, :3, 3], rtol=0, atol=1e-9)
        if kind == "pose":
            np.testing.assert_allclose(T, exact.pose_valid, rtol=0, atol=1e-9)
        lengths = [np.linalg.norm(np.diff(A[:, :3, 3], axis=0), axis=1) for A in (T, exact.pose_valid)]
        if kind != "distance":
            np.testing.assert_allclose(*lengths, rtol=0, atol=1e-9)
        else:
            found = np.linalg.norm(T[:, :3, 3] - fit.value.anchor, axis=1)
            np.testing.assert_allclose(found, np.linalg.norm(exact.pose_valid[:, :3, 3] - ANCHOR, axis=1), atol=1e-9)

    def test_harmonics_gears_and_a_prismatic_joint(self) -> None:
        rng, robot = np.random.default_rng(5), sliding_robot()
        q = rng.uniform(-1.5, 1.5, (80, 6))
        twists = 1e-3 * rng.standard_normal((7, 6))
        truth = Arm.of(robot, q, (2,), np.zeros((80, 6, 0)), "local_poe").corrected(robot.frames @ se3.exp(twists))
        gears = 1.0 + 1e-3 * rng.standard_normal(6)
        amplitudes = 1e-4 * rng.standard_normal((6, 2))
        amplitudes[2] = 0.0
        turned = q * gears + amplitudes[:, 0] * np.cos(2 * q) + amplitudes[:, 1] * np.sin(2 * q)
        terms = q[:, :, None] * np.eye(6)
        pose = forward(truth, turned)
        fit = fit_kinematics(robot, q, pose=pose, noise=(1e-5, 1e-5), harmonics=(2,), joint_terms=terms)
        assert fit.excitation.rank == fit.excitation.expected == 28 + 10 + 6
        np.testing.assert_allclose(fit.value.forward(q, terms), pose, rtol=0, atol=1e-6)  # the prior pulls a little
        np.testing.assert_allclose(fit.value.coefficients, gears - 1.0, rtol=0, atol=1e-5)
        np.testing.assert_allclose(fit.value.amplitudes, amplitudes, rtol=0, atol=1e-6)

    def test_joints_that_give_way_under_gravity(self) -> None:
        """Compliance of joints 2 and 3 [rad/N m]: phi is the gravity torque of each, with masses that are known."""
        run = cell(2000).kinematics(0, 60)
        links = np.zeros((6, 10))
        links[:, 0], links[:, 1] = (100.0, 120.0, 60.0, 20.0, 10.0, 5.0), (5.0, 40.0, 8.0, 1.0, 0.5, 0.2)
        still, joints = np.zeros((60, 6)), np.array([1, 2])
        tau = run.robot.chain.rnea(run.q, still, still, np.array([0.0, 0.0, -9.80665]), links)
        phi = np.zeros((60, 6, 2))
        phi[:, joints, [0, 1]] = tau[:, joints]
        compliance = np.array([2e-6, -3e-6])
        pose = run.truth.forward(run.q + phi @ compliance)
        fit = fit_kinematics(run.robot, run.q, pose=pose, noise=NOISE, joint_terms=phi)
        assert fit.excitation.rank == fit.excitation.expected == 32
        assert fit.units[-1] == "rad/unit"
        np.testing.assert_allclose(fit.value.coefficients, compliance, rtol=1e-6)
        np.testing.assert_allclose(fit.value.forward(run.q, phi), pose, rtol=0, atol=1e-9)

    def test_parallel_axes_need_no_special_case(self) -> None:
        """Axes 2 and 3 of this arm are parallel; tilted against each other by 0.01 deg a table would need a huge d."""
        run = cell(2000).kinematics(1, tool=False)
        tilt = np.zeros((7, 3))
        tilt[2, 1] = 0.01 * DEGREE
        arm = replace(run.truth, frames=dh_arm().frames @ se3.from_rp(so3.exp(tilt)))
        fit = fit_kinematics(run.robot, run.q, pose=arm.forward(run.q), noise=NOISE)
        np.testing.assert_allclose(fit.value.forward(run.q_valid), arm.forward(run.q_valid), rtol=0, atol=1e-9)
        assert np.abs(fit.parameters).max() < 1e-3


def measurements(run: KinematicRun, kind: str) -> dict[str, Any]:
    p = run.pose[:, :3, 3]
    pairs = np.array([(i, j) for i in range(60) for j in range(i) if (i + 3 * j) % 7 == 0][:200]).T
    return {
        "pose": {"pose": run.pose},
        "position": {"position": p},
        "distance": {"distance": np.linalg.norm(p - ANCHOR, axis=1), "anchor": ANCHOR + 0.01},
        "pairs": {"pair_distance": (*pairs, np.linalg.norm(p[pairs[0]] - p[pairs[1]], axis=1))},
    }[kind]


class TestGaugeAndModels:
    def test_both_models_are_the_same_robot(self, case) -> None:
        """K3: the product of exponentials about screws in the base, which Robotlib.jl has commented out."""
        for data, noise in (({"pose": case.pose}, NOISE), ({"position": case.pose[:, :3, 3]}, 1e-4)):
            local, whole = (
                fit_kinematics(case.robot, case.q, noise=noise, model=m, **data) for m in ("local_poe", "poe")
            )
            np.testing.assert_allclose(
                local.value.forward(case.q_valid), whole.value.forward(case.q_valid), rtol=0, atol=1e-9
            )
            np.testing.assert_allclose(local.parameters, whole.parameters, rtol=0, atol=1e-9)
            np.testing.assert_allclose(local.cov, whole.cov, rtol=0, atol=1e-12)

    def test_axes_remain_axes(self, case) -> None:
        """Unit axes without pitch, however far the screws have turned."""
        fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE, model="poe")
        screws = fit.value.robot.screws
        np.testing.assert_allclose(np.linalg.norm(screws[:, 3:], axis=1), 1.0, rtol=0, atol=1e-14)
        np.testing.assert_allclose(np.sum(screws[:, :3] * screws[:, 3:], axis=1), 0.0, rtol=0, atol=1e-14)

    def test_of_equal_fits_the_smallest(self, case) -> None:
        fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE)
        gauge = fit.excitation.null_space
        assert gauge.shape == (42, 12)
        assert np.abs(gauge.T @ fit.parameters).max() < 1e-5 * np.linalg.norm(fit.parameters)
        assert np.abs(gauge.T @ fit.cov).max() < 1e-20

    def test_a_tool_that_turns_with_a_reversed_guess(self, case) -> None:
        """The measurement frame half a turn away and the tool turned by another: found before the descent."""
        frame = se3.from_rp(so3.exp([0.0, 0.0, np.pi]), [3.0, -1.0, 0.5])
        tool = se3.from_rp(so3.exp([np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0.0]), [0.2, 0.0, 0.3])
        plain = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE)
        far = fit_kinematics(case.robot, case.q, pose=frame @ case.pose @ tool, noise=NOISE)
        np.testing.assert_allclose(
            far.value.forward(case.q_valid)[:, :3, :3],
            (frame @ plain.value.forward(case.q_valid) @ tool)[:, :3, :3],
            rtol=0,
            atol=1e-3,
        )
        assert case.error(moved_back(far.value, frame, tool).forward(case.q_valid))[0] < 0.1

    @pytest.mark.parametrize("K", [1, 2])
    def test_any_measurement_frame_of_positions(self, case, K: int) -> None:
        frame = se3.from_rp(so3.exp([2.0, 1.0, -2.0]), [3.0, -1.0, 0.5])
        p = case.pose[:, :3, 3] if K == 1 else case.points(2)
        there = p @ frame[:3, :3].T + frame[:3, 3]
        plain, far = (fit_kinematics(case.robot, case.q, position=x, noise=1e-4) for x in (p, there))
        a, b = (fit.value.forward(case.q_valid)[:, :3, 3] for fit in (plain, far))
        if K == 2:
            a, b = (
                x + fit.value.forward(case.q_valid)[:, :3, :3] @ fit.value.points[0]
                for x, fit in ((a, plain), (b, far))
            )
        np.testing.assert_allclose(b, a @ frame[:3, :3].T + frame[:3, 3], rtol=0, atol=1e-9)


def moved_back(value: KinematicCorrection, frame: np.ndarray, tool: np.ndarray) -> KinematicCorrection:
    robot = value.robot.with_base(se3.project(se3.inv(frame) @ value.robot.T_base_mount)[0])
    return replace(value, robot=robot.with_tool(se3.project(robot.T_flange_tool @ se3.inv(tool))[0]))


class TestMissingData:
    def test_a_mask_is_the_same_as_leaving_out(self, case) -> None:
        seen = np.random.default_rng(0).random(len(case.q)) < 0.8
        holes = case.pose.copy()
        holes[~seen] = np.nan
        masked = fit_kinematics(case.robot, case.q, pose=holes, visible=seen, noise=NOISE)
        short = fit_kinematics(case.robot, case.q[seen], pose=case.pose[seen], noise=NOISE)
        np.testing.assert_allclose(masked.parameters, short.parameters, rtol=0, atol=1e-12)
        assert np.isnan(masked.residuals[~seen]).all()
        assert masked.residuals.shape == (150, 6)

    def test_some_of_several_points(self, case) -> None:
        p = case.points(3)
        seen = np.random.default_rng(0).random(p.shape[:2]) < 0.7
        fit = fit_kinematics(
            case.robot, case.q, position=np.where(seen[..., None], p, np.nan), visible=seen, noise=1e-4
        )
        assert fit.excitation.rank == 33
        assert np.isfinite(fit.residuals).sum() == 3 * seen.sum()

    def test_kinds_together_know_more(self, case) -> None:
        """Poses of every third sample, positions of all, and one distance between two tool points."""
        third = np.arange(150) % 3 == 0
        p = case.pose[:, :3, 3]
        noise = {"pose": NOISE, "position": 1e-4, "pair_distance": 1e-5}
        pairs = ([0, 5], [9, 70], [np.linalg.norm(p[0] - p[9]), np.linalg.norm(p[5] - p[70])])
        both = fit_kinematics(
            case.robot, case.q, pose=case.pose, position=p, pair_distance=pairs, visible={"pose": third}, noise=noise
        )
        alone = fit_kinematics(case.robot, case.q, pose=case.pose, visible=third, noise=NOISE)
        assert both.excitation.rank == alone.excitation.rank == 30
        assert np.trace(both.value.pose_cov(case.q_valid[0])) < 0.7 * np.trace(alone.value.pose_cov(case.q_valid[0]))
        assert both.residuals.shape == (152, 10)
        assert both.classes[-1] == "pair distance [m]"

    def test_the_orientation_of_the_tool_stays_nominal_for_a_point(self, case) -> None:
        fit = fit_kinematics(case.robot, case.q, position=case.pose[:, :3, 3], noise=1e-4)
        assert fit.excitation.null_names[12:] == tuple(f"missing: tool orientation about {axis}" for axis in "xyz")
        names = list(fit.names)
        held = fit.parameters[[names.index(f"tool w{axis}") for axis in "xyz"]]
        assert np.abs(held).max() < 2e-3  # what the gauge of joint 6 carries, no more


class TestValue:
    def test_the_report_tells_noise_that_was_given_wrong(self, case) -> None:
        """Ten times too small: the stated deviations are too, and only the report can say so."""
        for factor, words in ((1.0, "residuals 1.01 times"), (0.1, "residuals 10.1 times")):
            noise = tuple(factor * size for size in NOISE)
            fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=noise)
            assert f"{words} the noise that was given" in fit.report()
        assert "noise that was given" not in fit_kinematics(case.robot, case.q, pose=case.pose).report()

    def test_it_is_saved_and_loaded(self, case, tmp_path: Path) -> None:
        fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE, harmonics=(1,))
        again = Fit.load(fit.save(tmp_path / "arm.toml"), kind="kinematic_correction")
        assert again.value.robot == fit.value.robot
        assert again.value.forward(case.q).tobytes() == fit.value.forward(case.q).tobytes()
        assert again.value.pose_cov(case.q).tobytes() == fit.value.pose_cov(case.q).tobytes()
        assert models.load(tmp_path / "arm.toml").robot_hash == case.robot.hash

    def test_the_robot_goes_everywhere(self, case, tmp_path: Path) -> None:
        """Kinematics, inverse, files, URDF, and the simulated arm take the corrected robot."""
        from armlab import sim

        fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE)
        robot, q = fit.value.robot, case.q_valid[:5]
        np.testing.assert_allclose(forward(robot, q), fit.value.forward(q), rtol=0, atol=1e-14)
        goals = forward(robot, q)
        np.testing.assert_allclose(forward(robot, inverse(robot, goals).q), goals, rtol=0, atol=1e-8)
        assert jacobian(robot, q).shape == (5, 6, 6)
        robots.save(robot, tmp_path / "arm.toml")
        assert robots.load(tmp_path / "arm.toml") == robot
        robots.save(robot, tmp_path / "arm.urdf")
        np.testing.assert_allclose(forward(robots.load(tmp_path / "arm.urdf"), q), goals, rtol=0, atol=1e-9)
        assert robot.hash != case.robot.hash
        assert sim.Arm(robot, sim.synthetic_truth(robot), seed=1).robot == robot

    def test_gravity_turns_with_the_foot(self, case) -> None:
        frame = se3.from_rp(so3.exp([1.0, 0.0, 0.0]), [3.0, 0.0, 0.0])
        fit = fit_kinematics(case.robot, case.q, pose=frame @ case.pose, noise=NOISE)
        np.testing.assert_allclose(fit.value.robot.gravity, frame[:3, :3] @ case.robot.gravity, rtol=0, atol=0.05)


def test_derivatives_of_a_pose_that_is_far_from_the_measured_one() -> None:
    """Against differences, half a radian away: the logarithm bends."""
    rng = np.random.default_rng(6)
    T = se3.exp(rng.standard_normal((3, 6)))
    measured = T @ se3.exp(0.3 * rng.standard_normal((3, 6)))
    motion = rng.standard_normal((3, 6, 2))  # of the tool point and of its axes, base axes

    def residual(x: np.ndarray) -> np.ndarray:
        step = motion @ x
        moved = se3.from_rp(so3.exp(step[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + step[:, :3])
        return pose_residual(moved, measured, motion)[0]

    found = np.stack([(residual(x) - residual(-x)) / 2e-6 for x in np.eye(2) * 1e-6], axis=2)
    np.testing.assert_allclose(pose_residual(T, measured, motion)[1], found, atol=1e-8)

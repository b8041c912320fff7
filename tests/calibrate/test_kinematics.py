"""Kinematic calibration: exact data, gauge, input, and the corrected robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import Command, bridge, contact, dynamics, identify, kinematics, models, robots, sim
from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.calibrate.kinematics.measurements import measured_kinds
from armlab.calibrate.kinematics.model import Arm, KinematicProblem, State
from armlab.errors import ModelMismatchError, NotConverged, RobotError
from armlab.estimation import Fit
from armlab.kinematics import forward
from armlab.lie import se3, so3
from armlab.models import KinematicCorrection
from armlab.robots import Robot
from armlab.sim import cell
from armlab.sim.experiments.kinematics import (
    ANCHOR,
    DEGREE,
    NOISE,
    KinematicRun,
    as_robot,
    dh_arm,
    sliding_robot,
    spoilt,
)


@pytest.fixture(scope="module")
def case() -> KinematicRun:
    return cell(2000).kinematics(0, 150)


@pytest.fixture(scope="module")
def exact() -> KinematicRun:
    run = cell(2000).kinematics(3, 60)
    return replace(run, pose=run.truth.forward(run.q))


class TestExactData:
    @pytest.mark.parametrize(
        ("kind", "model"), [("pose", "poe"), ("position", "local_poe"), ("distance", "poe"), ("pairs", "local_poe")]
    )
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
        np.testing.assert_allclose(fit.value.forward(q, terms), pose, rtol=0, atol=1e-6)  # small bias from the prior
        np.testing.assert_allclose(fit.value.coefficients, gears - 1.0, rtol=0, atol=1e-5)
        np.testing.assert_allclose(fit.value.amplitudes, amplitudes, rtol=0, atol=1e-6)

    def test_joints_that_give_way_under_gravity(self) -> None:
        """Compliance of joints 2 and 3 [rad/N m]: phi is the gravity torque of each, with known masses."""
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
        """Axes 2 and 3 of this arm are parallel; with a relative tilt of 0.01 deg, a DH table would need a huge d."""
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
        """K3: the product of exponentials with screws in the base frame, which is commented out in Robotlib.jl."""
        for data, noise in (({"pose": case.pose}, NOISE), ({"position": case.pose[:, :3, 3]}, 1e-4)):
            fits = [fit_kinematics(case.robot, case.q, noise=noise, model=m, **data) for m in ("local_poe", "poe")]
            ends = (fit.value.forward(case.q_valid) for fit in fits)
            np.testing.assert_allclose(*ends, rtol=0, atol=1e-9)
            np.testing.assert_allclose(*(fit.parameters for fit in fits), rtol=0, atol=1e-9)
            np.testing.assert_allclose(*(fit.cov for fit in fits), rtol=0, atol=1e-12)
            screws = fits[1].value.robot.screws  # the screws remain unit axes with zero pitch
            np.testing.assert_allclose(np.linalg.norm(screws[:, 3:], axis=1), 1.0, rtol=0, atol=1e-14)
            np.testing.assert_allclose(np.sum(screws[:, :3] * screws[:, 3:], axis=1), 0.0, rtol=0, atol=1e-14)

    def test_of_equal_fits_the_smallest(self, case) -> None:
        fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE)
        gauge = fit.excitation.null_space
        assert gauge.shape == (42, 12)
        assert np.abs(gauge.T @ fit.parameters).max() < 1e-5 * np.linalg.norm(fit.parameters)
        assert np.abs(gauge.T @ fit.cov).max() < 1e-20

    def test_a_tool_that_turns_with_a_reversed_guess(self, case) -> None:
        frame = se3.from_rp(so3.exp([0.0, 0.0, np.pi]), [3.0, -1.0, 0.5])
        tool = se3.from_rp(so3.exp([np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0.0]), [0.2, 0.0, 0.3])
        plain = fit_kinematics(case.robot, case.q, pose=case.pose, noise=NOISE)
        far = fit_kinematics(case.robot, case.q, pose=frame @ case.pose @ tool, noise=NOISE)
        ends = far.value.forward(case.q_valid), frame @ plain.value.forward(case.q_valid) @ tool
        np.testing.assert_allclose(*(T[:, :3, :3] for T in ends), rtol=0, atol=1e-3)
        assert case.error(moved_back(far.value, frame, tool).forward(case.q_valid))[0] < 0.1

    @pytest.mark.parametrize("K", [1, 2])
    def test_any_measurement_frame_of_positions(self, case, K: int) -> None:
        frame = se3.from_rp(so3.exp([2.0, 1.0, -2.0]), [3.0, -1.0, 0.5])
        p = case.pose[:, :3, 3] if K == 1 else case.points(2)
        there = p @ frame[:3, :3].T + frame[:3, 3]
        plain, far = (fit_kinematics(case.robot, case.q, position=x, noise=1e-4) for x in (p, there))
        ends = [fit.value.forward(case.q_valid) for fit in (plain, far)]
        points = (fit.value.points[0] if K == 2 else np.zeros(3) for fit in (plain, far))
        a, b = (T[:, :3, 3] + T[:, :3, :3] @ point for T, point in zip(ends, points))
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
        p[~seen] = np.nan
        fit = fit_kinematics(case.robot, case.q, position=p, visible=seen, noise=1e-4)
        assert fit.excitation.rank == 33
        assert np.isfinite(fit.residuals).sum() == 3 * seen.sum()

    def test_kinds_together_know_more(self, case) -> None:
        third = np.arange(150) % 3 == 0
        p = case.pose[:, :3, 3]
        noise = {"pose": NOISE, "position": 1e-4, "pair_distance": 1.5e-4}
        pairs = ([0, 5], [9, 70], [np.linalg.norm(p[0] - p[9]), np.linalg.norm(p[5] - p[70])])
        data = {"pose": case.pose, "position": p, "pair_distance": pairs, "visible": {"pose": third}}
        both = fit_kinematics(case.robot, case.q, **data, noise=noise)
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
        assert np.abs(held).max() < 2e-3  # only the part carried by the gauge of joint 6


class TestValue:
    def test_the_report_tells_noise_that_was_given_wrong(self, case) -> None:
        for factor, words in ((1.0, "residuals 1.01 times"), (0.1, "residuals 10.1 times")):
            noise = tuple(factor * size for size in NOISE)
            fit = fit_kinematics(case.robot, case.q, pose=case.pose, noise=noise)
            assert f"{words} the given noise" in fit.report()
        assert "given noise" not in fit_kinematics(case.robot, case.q, pose=case.pose).report()

    def test_gravity_turns_with_the_foot(self, case) -> None:
        frame = se3.from_rp(so3.exp([1.0, 0.0, 0.0]), [3.0, 0.0, 0.0])
        fit = fit_kinematics(case.robot, case.q, pose=frame @ case.pose, noise=NOISE)
        np.testing.assert_allclose(fit.value.robot.gravity, frame[:3, :3] @ case.robot.gravity, rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("robot", "model"), [(as_robot(dh_arm(tool=True)), "poe"), (sliding_robot(), "poe"), (sliding_robot(), "local_poe")]
)
def test_derivatives_are_those_of_the_residuals(robot: robots.Robot, model: str) -> None:
    rng = np.random.default_rng(2)
    q, N = rng.uniform(-2, 2, (7, 6)), 7
    pose = forward(robot, q) @ se3.exp(0.3 * rng.standard_normal((N, 6)))
    given = {"pose": pose, "position": rng.standard_normal((N, 2, 3)), "distance": rng.uniform(1, 2, N)}
    given["pair_distance"] = np.arange(6), np.arange(1, 7), np.ones(6)
    kinds, _ = measured_kinds(N, given, None, None)
    arm = Arm.of(robot, q, (1, 3), rng.standard_normal((N, 6, 2)), model)
    problem = KinematicProblem(arm, tuple(kinds), np.zeros(0, dtype=bool), 2, (0.1, 0.2))
    problem = replace(problem, active=np.ones(problem.size, dtype=bool))
    first = State(arm.first(), rng.standard_normal((2, 3)), np.array([0.3, 2.0, 1.0]), np.array([0.1, 1.1]))
    state = problem.retract(first, 0.1 * rng.standard_normal(problem.size))
    found = problem.evaluate(state)
    for k in range(problem.size):
        step = 1e-6 * np.eye(problem.size)[k]
        ends = [problem.evaluate(problem.retract(state, sign * step)) for sign in (1.0, -1.0)]
        for here, up, down in zip(found, *ends, strict=True):
            np.testing.assert_allclose(here.J[:, :, k], (up.r - down.r) / 2e-6, rtol=0, atol=1e-6)


def test_most_samples_must_agree(case) -> None:
    pose = spoilt(case.pose, np.random.default_rng(0), 75, 0.3, 0.2)
    fit = fit_kinematics(case.robot, case.q, pose=pose, noise=NOISE, robust=True)
    assert np.flatnonzero(fit.outliers).tolist() == list(range(75))
    words = r"most samples to fit one arm, got 1[0-9][0-9] outliers among 150.*whether the given noise is too small"
    with pytest.raises(NotConverged, match=words):
        fit_kinematics(case.robot, case.q, pose=case.pose, noise=(1e-6, 1e-6), robust=True)


def calibrated(name: str, harmonics: tuple[int, ...] = ()) -> tuple[Robot, KinematicCorrection, Fit]:
    """Return a robot, its true correction with frame errors of 1 mm and 1 mrad, and the fit from exact poses."""
    robot, rng = robots.load(name), np.random.default_rng(1)
    n = robot.n
    q = rng.uniform(robot.q_min, robot.q_max, (80, n))
    frames = robot.frames @ se3.exp(1e-3 * rng.standard_normal((n + 1, 6)))
    amplitudes = 5e-4 * rng.standard_normal((n, 2 * len(harmonics)))
    arm = robots.from_local_poe("true", frames, np.tile([0.0, 0, 0, 0, 0, 1], (n, 1)))
    d = 6 * (n + 1) + amplitudes.size
    truth = KinematicCorrection(arm, "true", arm.hash, harmonics, amplitudes, np.zeros(0), np.zeros((d, d)))
    fit = fit_kinematics(robot, q, pose=truth.forward(q), noise=(1e-6, 1e-6), harmonics=harmonics)
    return robot, truth, fit


@pytest.fixture(scope="module")
def yumi() -> tuple[Robot, KinematicCorrection, Fit]:
    return calibrated("yumi_left")


@pytest.fixture(scope="module")
def waved() -> tuple[Robot, KinematicCorrection, Fit]:
    return calibrated("irb2400", (1, 2))


def postures(robot: Robot, count: int = 20) -> np.ndarray:
    return np.random.default_rng(5).uniform(0.8 * robot.q_min, 0.8 * robot.q_max, (count, robot.n))


class TestGeometry:
    def test_it_keeps_what_is_not_kinematics(self, yumi) -> None:
        robot, _, fit = yumi
        found = fit.value.robot
        for name in ("q_min", "q_max", "qd_max", "coupling", "q_home"):
            np.testing.assert_array_equal(getattr(found, name), getattr(robot, name))
        assert (found.name, found.n) == (robot.name, robot.n)
        assert found.hash != robot.hash
        np.testing.assert_allclose(found.gravity, robot.gravity, rtol=0, atol=0.1)

    def test_kinematics(self, yumi) -> None:
        robot, truth, fit = yumi
        found, q = fit.value.robot, postures(robot)
        goals = truth.forward(q)
        np.testing.assert_allclose(kinematics.forward(found, q), goals, rtol=0, atol=1e-8)
        reached = kinematics.inverse(found, goals, q)
        assert reached.success.all()
        np.testing.assert_allclose(truth.forward(reached.q), goals, rtol=0, atol=1e-7)

    def test_files(self, yumi, tmp_path: Path) -> None:
        found, path = yumi[2].value.robot, yumi[2].save(tmp_path / "kinematics.toml")
        robots.save(found, tmp_path / "arm.toml")
        assert robots.load(tmp_path / "arm.toml") == found
        assert models.load(path).robot == found
        with pytest.raises(RobotError, match=r"kinematic_correction.*models.load\(path\).robot"):
            robots.load(path)

    def test_a_torque_model_is_of_one_of_them(self, yumi, model) -> None:
        robot, _, fit = yumi
        with pytest.raises(ModelMismatchError, match="yumi_left"):
            contact.Estimator(model, fit.value.robot)
        assert contact.Estimator(model, robot) is not None
        bases = [dynamics.base_parameters(one) for one in (robot, fit.value.robot)]
        assert [len(base.B) for base in bases] == [50, 50]  # axes 0.06 deg off perpendicular add no parameters

    def test_calibration_goes_on_from_it(self, yumi) -> None:
        _, truth, fit = yumi
        found, q = fit.value.robot, postures(fit.value.robot, 60)
        again = fit_kinematics(found, q, pose=truth.forward(q), noise=(1e-6, 1e-6))
        assert np.abs(again.parameters).max() < 1e-6
        right = robots.load("yumi_right")
        q_b = np.random.default_rng(6).uniform(right.q_min, right.q_max, (60, 7))
        Z = se3.inv(truth.forward(q)) @ kinematics.forward(right, q_b)
        both = fit_dual_arm(found, right, q, q_b, pose=Z, noise=(1e-6, 1e-6))
        np.testing.assert_allclose(both.value.forward(q, q_b), Z, rtol=0, atol=1e-8)

    def test_simulation_and_bridge(self, yumi) -> None:
        robot, _, fit = yumi
        found = fit.value.robot
        arm = sim.SimulatedArm(found, sim.synthetic_truth(found), seed=1)
        assert arm.robot == found
        arm.place(found.q_home)
        seen = []

        def controller(state: Any) -> Command:
            seen.append(np.array(state.q))
            return Command(q=robot.q_home)

        with bridge.connect("sim://yumi_left?lockstep=true&seed=1", found) as link:
            link.run(controller, seconds=0.1)
        assert np.abs(seen[-1] - robot.q_home).max() < 0.01


class TestJointErrors:
    def test_it_is_reached_by_the_positions_that_are_asked_for(self, waved) -> None:
        """Inverse kinematics, then `command`: the true arm reaches the goals; without `command`, it is 0.3 mm off."""
        robot, truth, fit = waved
        goals = truth.forward(postures(robot))
        there = kinematics.inverse(fit.value.robot, goals, postures(robot)).q
        np.testing.assert_allclose(truth.forward(fit.value.command(there)), goals, rtol=0, atol=1e-5)
        assert np.abs(truth.forward(there) - goals)[:, :3, 3].max() > 3e-4

    def test_the_whole_correction_is_no_robot(self, waved, model) -> None:
        value, q = waved[2].value, postures(waved[2].value.robot)
        for part in (
            lambda: kinematics.forward(value, q),
            lambda: kinematics.inverse(value, np.eye(4)),
            lambda: kinematics.jacobian(value, q),
            lambda: kinematics.inverse_path(value, np.eye(4)[None], q[0]),
            lambda: kinematics.self_motion(value, q[0]),
            lambda: kinematics.parameter_jacobian(value, q),
            lambda: robots.save(value, "arm.toml"),
            lambda: sim.synthetic_truth(value),
            lambda: sim.SimulatedArm(value, sim.synthetic_truth(robots.load("irb2400"))),
            lambda: bridge.connect("sim://irb2400", value),
            lambda: dynamics.base_parameters(value),
            lambda: identify.design_excitation(value),
            lambda: fit_kinematics(value, q, pose=np.tile(np.eye(4), (20, 1, 1))),
            lambda: contact.Estimator(model, value),
        ):
            with pytest.raises(RobotError, match=r"its attribute `robot`; .* joints\(\) .* command\(\)"):
                part()

"""A calibrated arm goes into every other part: kinematics, files, identification, contact force, simulation, bridge.

Where its joints have errors of their own, `joints` and `command` lead from what the robot tells to where it is and
back; what takes a `Robot` says so when it gets the whole correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import Command, bridge, contact, identify, kinematics, models, robots, sim
from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.errors import ModelMismatchError, RobotError
from armlab.estimation import Fit
from armlab.lie import se3
from armlab.models import KinematicCorrection
from armlab.robots import Robot


def calibrated(name: str, harmonics: tuple[int, ...] = ()) -> tuple[Robot, KinematicCorrection, Fit]:
    """Return an arm every frame of which is 1 mm and 1 mrad off, in truth and as it was found from exact poses."""
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
    """An arm whose joints are where they say."""

    def test_it_keeps_what_is_not_kinematics(self, yumi) -> None:
        """Limits, gears, names and home stay; the hash is another, so that models of the old one do not fit."""
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
        np.testing.assert_allclose(truth.forward(reached.q), goals, rtol=0, atol=1e-8)
        J, step = kinematics.jacobian(found, q), 1e-6
        for j in range(found.n):
            ends = [kinematics.forward(found, q + sign * step * np.eye(found.n)[j])[:, :3, 3] for sign in (1, -1)]
            np.testing.assert_allclose(J[:, :3, j], (ends[0] - ends[1]) / (2 * step), rtol=0, atol=1e-8)
        line = kinematics.forward(found, found.q_home[None] + np.linspace(0, 0.2, 30)[:, None])
        path = kinematics.inverse_path(found, line, found.q_home)
        np.testing.assert_allclose(truth.forward(path.q), line, rtol=0, atol=1e-7)
        assert (kinematics.manipulability(found, q) > 0).all()

    def test_files(self, yumi, tmp_path: Path) -> None:
        _, _, fit = yumi
        found, q = fit.value.robot, postures(fit.value.robot)
        robots.save(found, tmp_path / "arm.toml")
        assert robots.load(tmp_path / "arm.toml") == found
        robots.save(found, tmp_path / "arm.urdf")
        there = kinematics.forward(robots.load(tmp_path / "arm.urdf"), q)
        np.testing.assert_allclose(there, kinematics.forward(found, q), rtol=0, atol=1e-9)
        fit.save(tmp_path / "kinematics.toml")
        assert models.load(tmp_path / "kinematics.toml").robot == found
        with pytest.raises(RobotError, match=r"kinematic_correction.*models.load\(path\).robot"):
            robots.load(tmp_path / "kinematics.toml")

    def test_a_torque_model_is_of_one_of_them(self, yumi, model) -> None:
        """A model that was identified with the description is refused by the corrected arm: identify again."""
        robot, _, fit = yumi
        with pytest.raises(ModelMismatchError, match="yumi_left"):
            contact.Estimator(model, fit.value.robot)
        assert contact.Estimator(model, robot) is not None
        bases = [identify.base_parameters(one) for one in (robot, fit.value.robot)]
        assert [len(base.B) for base in bases] == [50, 50]  # what axes 0.06 deg off perpendicular add is no parameter

    @pytest.mark.slow  # 6 s
    def test_identification_and_contact_force(self, yumi, truth) -> None:
        """A torque model of the corrected arm runs it, and refuses the arm before."""
        robot, _, fit = yumi
        found = fit.value.robot
        log = replace(truth, robot=found).log(identify.design_excitation(found, seconds=30, seed=1), seed=1)
        model = identify.fit_dynamics(log, found).value
        free = contact.Estimator(model, found).run(log)
        assert np.median(np.linalg.norm(free["wrench_hat"][100:, :3], axis=1)) < 5.0
        with pytest.raises(ModelMismatchError, match="yumi_left"):
            contact.Estimator(model, robot)

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
        """The simulated controller is the library's arm; the loop knows the corrected one, and drives its joints."""
        robot, _, fit = yumi
        found = fit.value.robot
        arm = sim.Arm(found, sim.synthetic_truth(found), seed=1)
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
    """An arm whose joints are not quite where they say: errors of orders 1 and 2."""

    def test_it_is_reached_by_the_positions_that_are_asked_for(self, waved) -> None:
        """Inverse kinematics of the frames, then `command`: the true arm is where it should be, else 0.3 mm off."""
        robot, truth, fit = waved
        goals = truth.forward(postures(robot))
        there = kinematics.inverse(fit.value.robot, goals, postures(robot)).q
        np.testing.assert_allclose(truth.forward(fit.value.command(there)), goals, rtol=0, atol=1e-5)
        assert np.abs(truth.forward(there) - goals)[:, :3, 3].max() > 3e-4

    def test_what_the_robot_tells_is_where_it_is_after_joints(self, waved) -> None:
        robot, truth, fit = waved
        q = postures(robot)
        np.testing.assert_allclose(
            kinematics.forward(fit.value.robot, fit.value.joints(q)), truth.forward(q), rtol=0, atol=1e-5
        )
        np.testing.assert_array_equal(fit.value.forward(q), kinematics.forward(fit.value.robot, fit.value.joints(q)))

    @pytest.mark.parametrize(
        "part",
        [
            lambda value, q: kinematics.forward(value, q),
            lambda value, q: kinematics.inverse(value, np.eye(4)),
            lambda value, q: kinematics.jacobian(value, q),
            lambda value, q: kinematics.inverse_path(value, np.eye(4)[None], q[0]),
            lambda value, q: kinematics.null_motion(value, q[0]),
            lambda value, q: kinematics.frame_jacobian(value, q),
            lambda value, q: robots.save(value, "arm.toml"),
            lambda value, q: sim.synthetic_truth(value),
            lambda value, q: sim.Arm(value, sim.synthetic_truth(robots.load("irb2400"))),
            lambda value, q: bridge.connect("sim://irb2400", value),
            lambda value, q: identify.base_parameters(value),
            lambda value, q: identify.design_excitation(value),
            lambda value, q: fit_kinematics(value, q, pose=np.tile(np.eye(4), (20, 1, 1))),
        ],
    )
    def test_the_whole_correction_is_no_robot(self, waved, part: Callable[[Any, np.ndarray], Any]) -> None:
        _, _, fit = waved
        with pytest.raises(RobotError, match=r"its attribute robot; .* its joints\(\), .* its command\(\)"):
            part(fit.value, postures(fit.value.robot))

    def test_contact_force_wants_the_robot_too(self, waved, model) -> None:
        with pytest.raises(RobotError, match="its attribute robot"):
            contact.Estimator(model, waved[2].value)

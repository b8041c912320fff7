"""Derivatives of the residuals; wrong input of a kinematic calibration gets a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.calibrate import fit_kinematics
from armlab.calibrate.kinematics.measurements import measured_kinds
from armlab.calibrate.kinematics.model import Arm, KinematicProblem, State
from armlab.errors import ConfigError, NotConverged, NotExcited, RobotError, ShapeError, UnknownName
from armlab.kinematics import forward
from armlab.lie import se3
from armlab.sim import cell
from armlab.sim._cell_kinematics import (
    ANCHOR,
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


@pytest.mark.parametrize("model", ["local_poe", "poe"])
@pytest.mark.parametrize("robot", [as_robot(dh_arm(tool=True)), sliding_robot()], ids=["6R", "5R1P"])
def test_derivatives_are_those_of_the_residuals(robot: robots.Robot, model: str) -> None:
    """Central differences, far from the solution: every kind, harmonics, joint terms, instrument, priors."""
    rng = np.random.default_rng(2)
    q, N = rng.uniform(-2, 2, (7, 6)), 7
    pose = forward(robot, q) @ se3.exp(0.3 * rng.standard_normal((N, 6)))
    given = {
        "pose": pose,
        "position": rng.standard_normal((N, 2, 3)),
        "distance": rng.uniform(1, 2, N),
        "pair_distance": (np.arange(6), np.arange(1, 7), np.ones(6)),
    }
    kinds, _ = measured_kinds(N, given, None, None)
    arm = Arm.of(robot, q, (1, 3), rng.standard_normal((N, 6, 2)), model)
    problem = KinematicProblem(arm, tuple(kinds), np.zeros(0, dtype=bool), 2, (0.1, 0.2))
    problem = replace(problem, active=np.ones(problem.size, dtype=bool))
    first = State(arm.first(), rng.standard_normal((2, 3)), np.array([0.3, 2.0, 1.0]), np.array([0.1, 1.1]))
    state = problem.retract(first, 0.1 * rng.standard_normal(problem.size))
    for local in (False, True):
        if local and model == "poe":
            continue
        found = problem.evaluate(state)
        for k in range(problem.size):
            step = 1e-6 * np.eye(problem.size)[k]
            ends = [problem.evaluate(problem.retract(state, sign * step)) for sign in (1.0, -1.0)]
            for here, up, down in zip(found, *ends, strict=True):
                np.testing.assert_allclose(here.J[:, :, k], (up.r - down.r) / 2e-6, rtol=0, atol=1e-6)


def test_local_derivatives_are_those_of_the_frames_in_both_models() -> None:
    robot, q = as_robot(dh_arm(tool=True)), np.random.default_rng(3).uniform(-2, 2, (4, 6))
    kinds, _ = measured_kinds(4, {"pose": forward(robot, q)}, None, None)
    both = []
    for model in ("local_poe", "poe"):
        arm = Arm.of(robot, q, (), np.zeros((4, 6, 0)), model)
        problem = KinematicProblem(arm, tuple(kinds), np.zeros(0, dtype=bool), 0, None)
        state = State(arm.first(), np.zeros((0, 3)), np.zeros(3), np.array([0.0, 1.0]))
        both.append(problem.measurements(state, local=True)[0].J)
    np.testing.assert_array_equal(*both)


class TestBadInput:
    @pytest.mark.parametrize(
        ("error", "words", "change"),
        [
            (ShapeError, r"q of shape \(N, 6\)", lambda d: {**d, "q": d["q"][:, :5]}),
            (ShapeError, r"pose of shape \(150, 4, 4\)", lambda d: {**d, "pose": d["pose"][:-1]}),
            (ShapeError, r"NaN or Inf in 1 rows: 7", lambda d: {**d, "q": holed(d["q"], 7)}),
            (ShapeError, r"finite pose, .* 7.*visible", lambda d: {**d, "pose": holed(d["pose"], 7)}),
            (ShapeError, "rotations in pose, got others in rows 3", lambda d: {**d, "pose": mirrored(d["pose"], 3)}),
            (ShapeError, "transposed", lambda d: {**d, "pose": d["pose"].swapaxes(1, 2)}),
            (ShapeError, "millimetres", lambda d: {**d, "pose": in_millimetres(d["pose"])}),
            (ShapeError, "degrees", lambda d: {**d, "q": np.degrees(d["q"])}),
            (NotConverged, "belong together|better start", lambda d: {**d, "pose": np.roll(d["pose"], 1, axis=0)}),
            (ShapeError, "noise of pose", lambda d: {**d, "noise": 1e-4}),
            (ShapeError, "noise of pose", lambda d: {**d, "noise": (0.0, 1.0)}),
            (ShapeError, "noise of pose", lambda d: {**d, "noise": (np.inf, np.inf)}),
            (ShapeError, "noise of pose", lambda d: {**d, "noise": -np.eye(6)}),
            (ShapeError, "visible", lambda d: {**d, "visible": np.ones(3, dtype=bool)}),
            (ConfigError, "at least one of pose, position", lambda d: {"q": d["q"]}),
            (ConfigError, "first guess of the fixed point", lambda d: {"q": d["q"], "distance": np.ones(150)}),
            (ConfigError, "noise of each kind", lambda d: {**d, "position": d["pose"][:, :3, 3]}),
            (ConfigError, "harmonics", lambda d: {**d, "harmonics": (1, 1)}),
            (ConfigError, "prior", lambda d: {**d, "weak": "prior", "prior": 0.0}),
            (ConfigError, "free='all' with model='poe'", lambda d: {**d, "model": "poe", "free": "offsets"}),
            (UnknownName, "Known: local_poe, poe", lambda d: {**d, "model": "dh"}),
            (UnknownName, "Known: prior, refuse", lambda d: {**d, "weak": "ignore"}),
            (UnknownName, "Known: all, base_tool, offsets", lambda d: {**d, "free": "tool"}),
            (ShapeError, r"free as True and False of shape \(7, 6\)", lambda d: {**d, "free": np.ones((6, 6)) > 0}),
            (ShapeError, r"joint_terms of shape \(150, 6, L\)", lambda d: {**d, "joint_terms": np.ones((150, 6))}),
            (ShapeError, "two different samples", lambda d: {"q": d["q"], "pair_distance": ([1], [1], [0.2])}),
            (UnknownName, "position", lambda d: {**d, "visible": {"position": np.ones(150) > 0}}),
        ],
    )  # fmt: skip
    def test_a_sentence(self, case, error: type[Exception], words: str, change: Callable) -> None:
        data = {"q": case.q, "pose": case.pose, "noise": NOISE}
        with pytest.raises(error, match=words):
            fit_kinematics(case.robot, **change(data))

    @pytest.mark.parametrize("noise", [NOISE, None], ids=["noise given", "noise estimated"])
    def test_samples_that_do_not_belong_together_are_not_called_outliers(self, case, noise) -> None:
        """Five poses always fit exactly: a robust fit that keeps these and leaves out all others has found nothing."""
        rng = np.random.default_rng(0)
        mixed = case.pose[rng.permutation(150)]
        for q, pose in ((case.q, mixed), (case.q[:, ::-1], case.pose)):
            with pytest.raises((NotConverged, NotExcited), match=r"belong together|better start|more different"):
                fit_kinematics(case.robot, q, pose=pose, noise=noise, robust=True)
        distance = rng.uniform(1.0, 2.0, 150)
        given = None if noise is None else {"pose": noise, "distance": 1e-4}
        with pytest.raises((NotConverged, NotExcited)):
            fit_kinematics(case.robot, case.q, pose=mixed, distance=distance, anchor=ANCHOR, noise=given, robust=True)

    def test_most_samples_must_agree(self, case) -> None:
        """Half of them wrong are found; one more than half is refused by their number."""
        pose = spoilt(case.pose, np.random.default_rng(0), 75, 0.3, 0.2)
        fit = fit_kinematics(case.robot, case.q, pose=pose, noise=NOISE, robust=True)
        assert np.flatnonzero(fit.outliers).tolist() == list(range(75))
        with pytest.raises(NotConverged, match=r"most samples to fit one arm, got 1[0-9][0-9] of 150 that do not"):
            fit_kinematics(
                case.robot, case.q, pose=case.pose[np.random.default_rng(0).permutation(150)], noise=NOISE, robust=True
            )
        with pytest.raises(NotConverged, match="noise that was given is not too small"):
            fit_kinematics(case.robot, case.q, pose=case.pose, noise=(1e-6, 1e-6), robust=True)

    def test_another_order_of_the_joints(self, case) -> None:
        with pytest.raises((NotConverged, NotExcited), match=r"order of the joints|better start|more different"):
            fit_kinematics(case.robot, case.q[:, ::-1], pose=case.pose, noise=NOISE)

    def test_no_robot(self, case) -> None:
        with pytest.raises(RobotError, match="Load it first"):
            fit_kinematics("irb2400", case.q, pose=case.pose)  # type: ignore[arg-type]

    def test_rotations_that_are_nearly_right_are_projected_and_told(self, case) -> None:
        rough = case.pose.copy()
        rough[4, :3, :3] *= 1.0 + 3e-6
        fit = fit_kinematics(case.robot, case.q, pose=rough, noise=NOISE)
        assert "1 rotations were projected, off by up to 6e-06" in fit.report()


def holed(values: np.ndarray, row: int) -> np.ndarray:
    found = values.copy()
    found[row] = np.nan
    return found


def in_millimetres(pose: np.ndarray) -> np.ndarray:
    found = pose.copy()
    found[:, :3, 3] *= 1000.0
    return found


def mirrored(pose: np.ndarray, row: int) -> np.ndarray:
    found = pose.copy()
    found[row, :3, 0] *= -1.0
    return found

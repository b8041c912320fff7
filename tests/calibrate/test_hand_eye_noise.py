"""Noise of hand-eye calibration: of the robot beside the camera's, shared by points, unequal from sample to sample."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab.calibrate import fit_hand_eye, fit_hand_eye_points
from armlab.calibrate.hand_eye import HandEyeEquation, Pair
from armlab.calibrate.hand_eye_points import PointModel, Points
from armlab.estimation import Fit
from armlab.lie import se3, so3

SIGMA = 0.5e-3
ROBOT = (0.5e-3, np.radians(0.05))


def pose_error(T: Any, truth: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[:3, :3].T @ T[:3, :3])])


def error(fit: Fit[Any], truth: tuple[Any, Any, Any]) -> np.ndarray:
    """Error of X and Y, or of the points and Y."""
    X, Y, points = truth
    first = (fit.value.points - points).ravel() if fit.value.X is None else pose_error(fit.value.X, X)
    return np.concatenate([first, pose_error(fit.value.Y, Y)])


def sight_of(data: Any, seen: np.ndarray) -> PointModel:
    sample, point = np.nonzero(seen)
    return PointModel(data.A[:, :3, :3], data.A[:, :3, 3], data.p[seen], sample, point, seen.shape[1], None)


def test_noise_of_the_robot_reaches_all_points_of_a_sample(leds) -> None:
    """The covariance of a sample's residuals, against differences of the poses; one sample misses a point."""
    data, seen = leds.draw(11, 3), np.ones((3, 3), dtype=bool)
    seen[1, 0] = False
    S = np.diag(np.arange(1.0, 7.0))
    points = leds.marker @ data.X[:3, :3].T + data.X[:3, 3]
    at = Points(points, data.Y[:3, :3], data.Y[:3, 3])
    sight = replace(sight_of(data, seen), noise_A=S)
    columns = []
    for step in np.eye(6) * 1e-6:
        moved = sight_of(
            replace(data, A=se3.from_rp(data.A[:, :3, :3] @ so3.exp(step[3:]), data.A[:, :3, 3] + step[:3])), seen
        )
        columns.append((moved.free().evaluate(at)[0].r - sight_of(data, seen).free().evaluate(at)[0].r) / 1e-6)
    G = np.stack(columns, axis=2)
    two, three = sight.free().evaluate(at)
    for one, parts in ((two, [[3, 4]]), (three, [[0, 1, 2], [5, 6, 7]])):
        assert one.added is not None
        for cov, rows in zip(one.added, parts, strict=True):
            M = G[rows].reshape(-1, 6)
            np.testing.assert_allclose(cov, M @ S @ M.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(two.sample, [1])
    np.testing.assert_array_equal(three.sample, [0, 2])


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_a_robot_without_noise_is_the_same_as_none_told(leds, known) -> None:
    data, more = leds.draw(12), {"marker": leds.marker} if known else {}
    given = {**data.given, "visible": data.visible, "noise": SIGMA, **more}
    plain, zero = (fit_hand_eye_points(**given, noise_robot=told) for told in (None, 0.0))
    for name in ("parameters", "cov", "sigma"):
        assert getattr(plain, name).tobytes() == getattr(zero, name).tobytes()
    little = fit_hand_eye_points(**given, noise_robot=(1e-9, 1e-9))  # the other way of whitening
    np.testing.assert_allclose(little.parameters, plain.parameters, atol=1e-9)
    np.testing.assert_allclose(little.cov, plain.cov, rtol=1e-6, atol=1e-6 * np.abs(plain.cov).max())


@pytest.mark.parametrize("setup", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_noise_of_the_robot_makes_the_covariance_honest(hand_eye, leds, setup, known) -> None:
    nees: dict[bool, list[float]] = {True: [], False: []}
    for run in range(15):
        data = leds.draw([1100, run], 40, robot=ROBOT)
        A = data.A
        if setup == "eye_in_hand":  # the robot reads the inverse of A, with noise of its own
            A = hand_eye.noisy(np.random.default_rng([1100, run, 1]), se3.inv(data.A_exact), ROBOT)
        points = leds.marker @ data.X[:3, :3].T + data.X[:3, 3]
        for told, values in nees.items():
            fit = fit_hand_eye_points(
                A, data.p, visible=data.visible, marker=leds.marker if known else None, setup=setup, noise=SIGMA,
                noise_robot=ROBOT if told else None,
            )  # fmt: skip
            e = error(fit, (data.X, data.Y, points))
            values.append(float(e @ np.linalg.solve(fit.cov, e)) / len(e))
    assert 0.75 < np.mean(nees[True]) < 1.3
    assert np.mean(nees[False]) > 1.5


def test_noise_of_the_camera_is_found_beside_that_of_the_robot(leds) -> None:
    found = []
    for run in range(5):
        data = leds.draw([1101, run], robot=ROBOT)
        p = data.p.copy()
        p[:5] += 0.02
        fit = fit_hand_eye_points(data.A, p, visible=data.visible, marker=leds.marker, noise_robot=ROBOT, robust=True)
        assert fit.outliers[:5][data.visible[:5].any(axis=1)].all()
        found.append(fit.sigma[0])
    assert np.mean(found) == pytest.approx(SIGMA, rel=0.05)


def test_unequal_noise_of_points_counts_by_its_size(leds) -> None:
    """A tracker that sees depth badly, the worse the farther away."""
    told, equal = [], []
    for run in range(20):
        data, rng = leds.draw([1600, run], 40), np.random.default_rng([1600, run])
        sd = np.linspace(0.2, 3.0, 40)[:, None, None] * np.array([0.1e-3, 0.1e-3, 1e-3]) * np.ones((40, 3, 3))
        p = data.p_exact + sd * rng.standard_normal((40, 3, 3))
        given = {"T_base_tool": data.A, "p_cam": p, "marker": leds.marker, "visible": data.visible}
        fit = fit_hand_eye_points(**given, noise=sd[..., None] ** 2 * np.eye(3))
        for one, values in ((fit, told), (fit_hand_eye_points(**given), equal)):
            e = error(one, (data.X, data.Y, fit.value.points))
            values.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert 0.8 < np.mean(told) < 1.2
    assert np.mean(equal) > 4.0 * np.mean(told)


def test_unequal_noise_of_poses_counts_by_its_size(hand_eye) -> None:
    """A camera that sees depth badly and whose noise grows from sample to sample: honest when told, worse when not."""
    told, equal = [], []
    for run in range(40):
        rng = np.random.default_rng([1200, run])
        data = hand_eye.draw([1200, run])
        size = np.linspace(0.2, 4.0, 30)[:, None]
        sd = size * np.array([0.2e-3, 0.2e-3, 2e-3, 2e-3, 2e-3, 0.4e-3])
        mix = np.eye(6) + 0.3 * rng.standard_normal((6, 6))
        step = (sd * rng.standard_normal((30, 6))) @ mix.T
        B = data.B_exact.copy()
        B[:, :3, 3] += step[:, :3]
        B[..., :3, :3] = B[..., :3, :3] @ so3.exp(step[:, 3:])
        cov = mix @ (sd[:, :, None] ** 2 * np.eye(6)) @ mix.T
        fit = fit_hand_eye(data.A, B, noise=cov)
        for one, values in ((fit, told), (fit_hand_eye(data.A, B), equal)):
            e = np.concatenate([pose_error(one.value.X, data.X), pose_error(one.value.Y, data.Y)])
            values.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert 0.85 < np.mean(told) < 1.15
    assert np.mean(equal) > 4.0 * np.mean(told)


def test_noise_of_the_robot_reaches_position_and_rotation_of_a_pair() -> None:
    """Its covariance in the residuals, lever arm of the marker included, against differences of the poses."""
    rng = np.random.default_rng(2)
    X, Y = se3.exp(0.5 * rng.standard_normal(6)), se3.exp(rng.standard_normal(6))
    A = se3.exp(rng.standard_normal((4, 6)))
    B = se3.inv(Y) @ A @ X
    L = rng.standard_normal((6, 6))
    S = L @ L.T
    at = Pair(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3])

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = HandEyeEquation(A[:, :3, :3] @ so3.exp(step[3:]), A[:, :3, 3] + step[:3], B[:, :3, :3], B[:, :3, 3])
        return moved.evaluate(at)[0].r

    G = np.stack([(residuals(step) - residuals(-step)) / 2e-6 for step in np.eye(6) * 1e-6], axis=2)
    added = HandEyeEquation(A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3], None, S).evaluate(at)[0].added
    np.testing.assert_allclose(added, G @ S @ G.transpose(0, 2, 1), rtol=1e-7, atol=1e-7)

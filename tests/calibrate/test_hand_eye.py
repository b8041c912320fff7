"""Hand-eye calibration from pairs of poses: exactness, noise, robustness, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import models
from armlab.calibrate import fit_hand_eye
from armlab.calibrate.hand_eye import LIMITS, HandEyeEquation, Pair
from armlab.errors import NotExcited
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3

CAMERA = (0.5e-3, np.radians(0.05))
ROBOT = (0.5e-3, np.radians(0.05))
ROTATION = slice(0, 3), slice(0, 3)


def pose_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[v; w] with T = truth (+) it."""
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[ROTATION].T @ T[ROTATION])])


def error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.concatenate([pose_error(fit.value.X, truth[0]), pose_error(fit.value.Y, truth[1])])


def pair_of(X: np.ndarray, Y: np.ndarray) -> Pair:
    return Pair(X[ROTATION], X[:3, 3], Y[ROTATION], Y[:3, 3])


def equation_of(data: Any, noise: Any = None, noise_A: Any = None) -> HandEyeEquation:
    return HandEyeEquation(data.A[:, :3, :3], data.A[:, :3, 3], data.B[:, :3, :3], data.B[:, :3, 3], noise, noise_A)


@pytest.mark.parametrize("tilt", [None, 30.0, 5.0])
@pytest.mark.parametrize("N", [3, 30])
def test_exact_data_give_the_exact_answer(hand_eye, tilt, N) -> None:
    for seed in range(5):
        data = hand_eye.draw(seed, N, None if tilt is None else np.radians(tilt), camera=(0.0, 0.0))
        fit = fit_hand_eye(**data.given, noise=(1e-6, 1e-6))
        limit = 1e-12 if N == 30 and tilt is None else 1e-10  # small rotations lose digits
        np.testing.assert_allclose(fit.value.T_tool_marker, data.X, atol=limit)
        np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=limit)


def test_half_turns_are_angles_like_others(hand_eye) -> None:
    """No guess is used, so that none can be 180 degrees off."""
    data = hand_eye.draw(3)
    X, Y = data.X.copy(), data.Y.copy()
    X[ROTATION], Y[ROTATION] = np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])
    fit = fit_hand_eye(data.A, se3.inv(Y) @ data.A @ X, noise=CAMERA)
    np.testing.assert_allclose(fit.value.X, X, atol=1e-12)
    np.testing.assert_allclose(fit.value.Y, Y, atol=1e-12)


def test_jacobian_is_the_derivative_of_the_residual(hand_eye) -> None:
    equation = equation_of(hand_eye.draw(1, 4, camera=(0.1, 0.2)), np.ones(6))
    pair = equation.start()
    (found,), h = equation.evaluate(pair), 1e-6
    for k, step in enumerate(np.eye(12) * h):
        up, down = (equation.evaluate(pair.plus(x))[0].r for x in (step, -step))
        np.testing.assert_allclose(found.J[:, :, k], (up - down) / (2 * h), atol=1e-6)


def test_both_setups_are_one_equation(hand_eye) -> None:
    data = hand_eye.draw(4)
    still = fit_hand_eye(**data.given, noise=CAMERA)
    held = fit_hand_eye(se3.inv(data.A), data.B, setup="eye_in_hand", noise=CAMERA)
    np.testing.assert_allclose(held.value.T_base_marker, still.value.T_tool_marker, atol=1e-13)
    np.testing.assert_allclose(held.value.T_tool_cam, still.value.T_base_cam, atol=1e-13)
    assert held.names[0] == "T_base_marker x"
    assert still.names[-1] == "T_base_cam rz"


def test_a_robot_without_noise_is_the_same_as_none_told(hand_eye) -> None:
    data = hand_eye.draw(5)
    plain, zero = (fit_hand_eye(**data.given, noise=CAMERA, noise_robot=told) for told in (None, 0.0))
    for name in ("parameters", "cov", "sigma"):
        assert getattr(plain, name).tobytes() == getattr(zero, name).tobytes()


def test_noise_in_three_forms_is_the_same_noise(hand_eye) -> None:
    data = hand_eye.draw(6)
    S = np.diag(np.repeat(CAMERA, 3) ** 2)
    first, *others = (fit_hand_eye(**data.given, noise=n, noise_robot=n) for n in (CAMERA, S, np.tile(S, (30, 1, 1))))
    for other in others:
        np.testing.assert_allclose(other.parameters, first.parameters, atol=1e-12)
        np.testing.assert_allclose(other.cov, first.cov, rtol=1e-9)


@pytest.mark.parametrize("setup", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("told", [True, False], ids=["robot's noise told", "not told"])
def test_noise_of_the_robot_makes_the_covariance_honest(hand_eye, setup, told) -> None:
    """Section 1.3: without it NEES/12 is between 1.24 and 2.06."""
    nees = []
    for run in range(40):
        data = hand_eye.draw([1100, run], robot=ROBOT)
        A = data.A
        if setup == "eye_in_hand":  # the robot reads the inverse of A, with noise of its own
            clean = hand_eye.draw([1100, run]).A
            A = hand_eye.noisy(np.random.default_rng([1100, run, 1]), se3.inv(clean), ROBOT)
        fit = fit_hand_eye(A, data.B, setup=setup, noise=CAMERA, noise_robot=ROBOT if told else None)
        e = error(fit, (data.X, data.Y))
        nees.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert (np.mean(nees) < 1.2) if told else (np.mean(nees) > 1.24)
    assert np.mean(nees) > 0.8


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
@pytest.mark.parametrize("bad", [2, 9], ids=["5 %", "30 %"])
def test_outliers_are_flagged_by_index(hand_eye, bad, known) -> None:
    for run in range(3):
        data = hand_eye.draw([1000, run])
        which = list(range(0, 3 * bad, 3))
        B = hand_eye.spoilt(np.random.default_rng(run), data.B, which)
        fit = fit_hand_eye(data.A, B, noise=CAMERA if known else None, robust=True)
        assert fit.outliers[which].all()
        assert fit.outliers.sum() <= bad + 1
        e = error(fit, (data.X, data.Y))
        assert e @ np.linalg.solve(fit.cov, e) / 12 < 4.0
        assert "outliers left out" in fit.report()
        assert fit.residuals.shape == (30, 6)


def test_two_deviations_of_noise_are_found(hand_eye) -> None:
    found = [fit_hand_eye(**hand_eye.draw([7, run]).given).sigma for run in range(20)]
    np.testing.assert_allclose(np.mean(found, axis=0), CAMERA, rtol=0.05)


def test_noise_of_the_camera_is_found_beside_that_of_the_robot(hand_eye) -> None:
    sigma, nees = [], []
    for run in range(12):
        data = hand_eye.draw([1100, run], robot=ROBOT)
        fit = fit_hand_eye(**data.given, noise_robot=ROBOT)
        e = error(fit, (data.X, data.Y))
        sigma.append(fit.sigma)
        nees.append(e @ np.linalg.solve(fit.cov, e) / 12)
    np.testing.assert_allclose(np.mean(sigma, axis=0), CAMERA, rtol=0.07)
    assert 0.8 < np.mean(nees) < 1.25
    spoilt = hand_eye.spoilt(np.random.default_rng(0), data.B, [1, 7, 20])
    assert np.flatnonzero(fit_hand_eye(data.A, spoilt, noise_robot=ROBOT, robust=True).outliers).tolist() == [1, 7, 20]


def experiment_of(hand_eye, tilt: float | None = None, robot: tuple[float, float] | None = None):
    def experiment(seed: int, n: int) -> Experiment:
        data = hand_eye.draw([1000, seed], n, tilt, robot=robot)
        clean = hand_eye.draw([1000, seed], n, tilt, camera=(0.0, 0.0))
        S = np.repeat(CAMERA, 3) ** 2
        equation = equation_of(clean, S, None if robot is None else np.repeat(robot, 3) ** 2)
        (truth,) = equation.evaluate(pair_of(data.X, data.Y))
        cov = np.diag(truth.cov) if truth.cov.ndim == 1 else truth.cov
        bound = np.linalg.inv(np.sum(np.swapaxes(truth.J, 1, 2) @ np.linalg.solve(cov, truth.J), axis=0))
        given = {**data.given, "noise": CAMERA}
        return Experiment(given if robot is None else {**given, "noise_robot": robot}, (data.X, data.Y), bound)

    return experiment


def gauges(exact_robot: bool) -> list[Gauge]:
    G = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -0.5]))
    inv = se3.inv(G)

    def longer(T: np.ndarray) -> np.ndarray:
        T = T.copy()
        T[..., :3, 3] *= 1000.0
        return T

    def millimetres(data: dict[str, Any]) -> dict[str, Any]:
        data |= {name: longer(data[name]) for name in ("T_base_tool", "T_cam_marker")}
        return data | {name: (1000.0 * data[name][0], data[name][1]) for name in data if name.startswith("noise")}

    moved_tool = Gauge(  # noise of the robot is that of its tool point: at another it is another
        "tool moved",
        lambda data: {**data, "T_base_tool": data["T_base_tool"] @ G},
        lambda fit: (inv @ fit.value.X, fit.value.Y),
    )
    return [
        *([moved_tool] if exact_robot else []),
        Gauge("base moved", lambda d: {**d, "T_base_tool": G @ d["T_base_tool"]}, lambda f: (f.value.X, G @ f.value.Y)),
        Gauge("camera moved", lambda d: {**d, "T_cam_marker": G @ d["T_cam_marker"]},
              lambda f: (f.value.X, f.value.Y @ inv)),
        Gauge("millimetres", millimetres, lambda f: (longer(f.value.X), longer(f.value.Y))),
    ]  # fmt: skip


def about_one_axis(hand_eye, noise: tuple[float, float] | None = None) -> dict[str, Any]:
    """All rotations about base z, the tool pointing up: tool axis z."""
    rng = np.random.default_rng(8)
    data = hand_eye.draw(8)
    A = se3.from_rp(so3.exp(rng.uniform(-2, 2, 30)[:, None] * [0.0, 0.0, 1.0]), data.A[:, :3, 3])
    B = se3.inv(data.Y) @ A @ data.X
    if noise is not None:
        A, B = hand_eye.noisy(rng, A, noise), hand_eye.noisy(rng, B, noise)
    return {"T_base_tool": A, "T_cam_marker": B}


def without_rotation(hand_eye, noise: tuple[float, float] | None = None) -> dict[str, Any]:
    rng = np.random.default_rng(9)
    data = hand_eye.draw(9)
    A = se3.from_rp(np.broadcast_to(data.A[0, :3, :3], (30, 3, 3)), data.A[:, :3, 3])
    B = se3.inv(data.Y) @ A @ data.X
    if noise is not None:
        A, B = hand_eye.noisy(rng, A, noise), hand_eye.noisy(rng, B, noise)
    return {"T_base_tool": A, "T_cam_marker": B}


def contract(hand_eye, runs: int, robot: tuple[float, float] | None = None, tilt: float | None = None):
    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        bad = np.zeros(len(data["T_cam_marker"]), dtype=bool)
        bad[rng.choice(len(bad), max(len(bad) // 20, 1), replace=False)] = True
        B = hand_eye.spoilt(rng, data["T_cam_marker"], np.flatnonzero(bad).tolist())
        return {**data, "T_cam_marker": B, "robust": True}, bad

    data = hand_eye.draw(0)
    refusals = {
        "along tool axis z": {**about_one_axis(hand_eye), "noise": CAMERA},
        "T_tool_marker along tool axis z": {**about_one_axis(hand_eye, CAMERA), "noise": CAMERA, "noise_robot": CAMERA},
        "tool axis z (T_base_cam moves with it)": about_one_axis(hand_eye, CAMERA),
        "translation of T_tool_marker along tool axis x": {**without_rotation(hand_eye), "noise": CAMERA},
        "translation of T_tool_marker along tool axis y": without_rotation(hand_eye, CAMERA),
        "2 poses": {"T_base_tool": data.A[:2], "T_cam_marker": data.B[:2]},
    }
    return check_estimator(
        fit_hand_eye, experiment_of(hand_eye, tilt, robot), runs, n=30, error=error, gauges=gauges(robot is None),
        blocks={"X t": range(3), "X R": range(3, 6), "Y t": range(6, 9), "Y R": range(9, 12)},
        refusals=refusals, spoil=spoil,
    )  # fmt: skip


def test_the_statistical_contract_in_short(hand_eye) -> None:
    found = contract(hand_eye, 10)
    assert found.passed, found.text()


@pytest.mark.slow  # 3 s each
@pytest.mark.parametrize(("robot", "tilt"), [(None, None), (ROBOT, None), (None, np.radians(30.0))],
                         ids=["uniform", "noise of the robot", "tilt 30 degrees"])  # fmt: skip
def test_the_statistical_contract(hand_eye, robot, tilt) -> None:
    found = contract(hand_eye, 100, robot, tilt)
    assert found.passed, found.text()


def test_one_axis_is_named_in_any_direction_and_setup(hand_eye) -> None:
    G = se3.exp(np.array([0.0, 0.0, 0.0, 0.7, 0.4, 0.0]))
    given = about_one_axis(hand_eye)
    with pytest.raises(
        NotExcited, match=r"turns? the tool about two axes, got rotations about one axis only"
    ) as caught:
        fit_hand_eye(given["T_base_tool"] @ G, given["T_cam_marker"])
    u = so3.exp([0.7, 0.4, 0.0]).T[:, 2]
    u *= np.sign(u[np.argmax(np.abs(u))])
    assert f"tool axis ({u[0]:.2f}, {u[1]:.2f}, {u[2]:.2f})" in caught.value.directions[0]
    with pytest.raises(NotExcited, match="translation of T_base_marker along base axis z"):
        fit_hand_eye(se3.inv(given["T_base_tool"]), given["T_cam_marker"], setup="eye_in_hand")


def test_weak_directions_are_refused_by_their_deviation(hand_eye) -> None:
    """Three poses, little turned: of full rank, and of no use."""
    data = hand_eye.draw(3, 3, np.radians(2.0))
    with pytest.raises(NotExcited, match=r"exceeds its limit: .* of T_.* moves with it\), [0-9.]+ (m|rad)"):
        fit_hand_eye(**data.given, noise=CAMERA)
    fit = fit_hand_eye(**data.given, noise=CAMERA, limits=(100.0, 100.0))
    assert LIMITS == (0.2, 0.2)
    assert "weakest: " in fit.report()


def test_report_and_file(hand_eye, tmp_path) -> None:
    fit = fit_hand_eye(**hand_eye.draw(15).given, noise=CAMERA, robust=True)
    text = fit.report()
    for words in ("T_tool_marker x", "+-", "T_base_cam rz", "noise of rotation [rad]", "largest rotation between two",
                  "times the noise that was given", "30 samples"):  # fmt: skip
        assert words in text
    again = models.load(fit.save(tmp_path / "camera.toml"), kind="hand_eye")
    assert again.T_base_cam.tobytes() == fit.value.T_base_cam.tobytes()

"""Hand-eye calibration from pairs of poses and from points of a marker."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.calibrate import fit_hand_eye, fit_hand_eye_points
from armlab.calibrate.hand_eye import LIMITS, HandEyeEquation, Pair
from armlab.calibrate.hand_eye_points import PointModel, Points, marked_start
from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3
from armlab.sim.experiments import sensors

CAMERA = (0.5e-3, np.radians(0.05))
ROBOT = (0.5e-3, np.radians(0.05))
SIGMA = 0.5e-3
ROTATION = slice(0, 3), slice(0, 3)


def pose_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[ROTATION].T @ T[ROTATION])])


def error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.concatenate([pose_error(fit.value.X, truth[0]), pose_error(fit.value.Y, truth[1])])


def pair_of(X: np.ndarray, Y: np.ndarray) -> Pair:
    return Pair(X[ROTATION], X[:3, 3], Y[ROTATION], Y[:3, 3])


def longer(T: np.ndarray) -> np.ndarray:
    return T * np.array([[1.0, 1.0, 1.0, 1e3]] * 3 + [[1.0] * 4])


def equation_of(data: Any, noise: Any = None, noise_A: Any = None) -> HandEyeEquation:
    return HandEyeEquation(data.A[:, :3, :3], data.A[:, :3, 3], data.B[:, :3, :3], data.B[:, :3, 3], noise, noise_A)


@pytest.mark.parametrize("tilt", [None, 30.0, 5.0])
@pytest.mark.parametrize("N", [3, 30])
def test_exact_data_give_the_exact_answer(tilt, N) -> None:
    for seed in range(2):
        data = sensors.seen_poses(seed, N, None if tilt is None else np.radians(tilt), camera=(0.0, 0.0))
        fit = fit_hand_eye(**data.given, noise=(1e-6, 1e-6))
        limit = 1e-12 if N == 30 and tilt is None else 1e-10  # small rotations lose digits
        np.testing.assert_allclose(fit.value.T_tool_marker, data.X, atol=limit)
        np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=limit)


def test_half_turns_are_angles_like_others() -> None:
    data = sensors.seen_poses(3)
    X, Y = data.X.copy(), data.Y.copy()
    X[ROTATION], Y[ROTATION] = np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])
    fit = fit_hand_eye(data.A, se3.inv(Y) @ data.A @ X, noise=CAMERA)
    np.testing.assert_allclose(fit.value.X, X, atol=1e-12)
    np.testing.assert_allclose(fit.value.Y, Y, atol=1e-12)


def test_both_setups_are_one_equation() -> None:
    data = sensors.seen_poses(4)
    still = fit_hand_eye(**data.given, noise=CAMERA)
    held = fit_hand_eye(se3.inv(data.A), data.B, setup="eye_in_hand", noise=CAMERA)
    np.testing.assert_allclose(held.value.T_base_marker, still.value.T_tool_marker, atol=1e-13)
    np.testing.assert_allclose(held.value.T_tool_cam, still.value.T_base_cam, atol=1e-13)
    assert held.names[0] == "T_base_marker x"
    assert still.names[-1] == "T_base_cam rz"
    with pytest.raises(UnknownName, match="eye_in_hand"):
        fit_hand_eye(**data.given, setup="eye_on_hand")  # type: ignore[arg-type]


def test_a_robot_without_noise_is_the_same_as_none_told() -> None:
    data = sensors.seen_poses(5)
    plain, zero = (fit_hand_eye(**data.given, noise=CAMERA, noise_robot=told) for told in (None, 0.0))
    for name in ("parameters", "cov", "sigma"):
        assert getattr(plain, name).tobytes() == getattr(zero, name).tobytes()


def test_noise_in_three_forms_is_the_same_noise() -> None:
    poses, points, S, Sp = sensors.seen_poses(6), sensors.seen_points(10), np.diag(np.repeat(CAMERA, 3) ** 2), np.eye(3)
    forms, marked = (CAMERA, S, np.tile(S, (30, 1, 1))), {"marker": sensors.MARKER, "visible": points.visible}
    found = [[fit_hand_eye(**poses.given, noise=n, noise_robot=n) for n in forms]]
    forms = (SIGMA, SIGMA**2 * Sp, np.broadcast_to(SIGMA**2 * Sp, (100, 3, 3, 3)))
    found.append([fit_hand_eye_points(**points.given, **marked, noise=n) for n in forms])
    for first, *others in found:
        assert "times the given noise" in first.report()
        for other in others:
            np.testing.assert_allclose(other.parameters, first.parameters, atol=1e-12)
            np.testing.assert_allclose(other.cov, first.cov, rtol=1e-9)


@pytest.mark.parametrize("setup", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("told", [True, False], ids=["robot's noise told", "not told"])
def test_noise_of_the_robot_makes_the_covariance_honest(setup, told) -> None:
    """Section 1.3: without the robot's noise, NEES/12 is between 1.24 and 2.06."""
    nees = []
    for run in range(25):
        data = sensors.seen_poses([1100, run], robot=ROBOT)
        A = data.A
        if setup == "eye_in_hand":  # the robot reads the inverse of A, with its own noise
            clean = sensors.seen_poses([1100, run]).A
            A = sensors.noisy(np.random.default_rng([1100, run, 1]), se3.inv(clean), ROBOT)
        fit = fit_hand_eye(A, data.B, setup=setup, noise=CAMERA, noise_robot=ROBOT if told else None)
        e = error(fit, (data.X, data.Y))
        nees.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert (np.mean(nees) < 1.2) if told else (np.mean(nees) > 1.24)
    assert np.mean(nees) > 0.8


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
def test_outliers_are_flagged_by_index(known) -> None:
    for run, bad in enumerate((2, 9, 9)):
        data = sensors.seen_poses([1000, run])
        which = list(range(0, 3 * bad, 3))
        B = sensors.spoilt(np.random.default_rng(run), data.B, which)
        fit = fit_hand_eye(data.A, B, noise=CAMERA if known else None, robust=True)
        assert fit.outliers[which].all()
        assert fit.outliers.sum() <= bad + 1
        e = error(fit, (data.X, data.Y))
        assert e @ np.linalg.solve(fit.cov, e) / 12 < 4.0
        assert "outliers excluded" in fit.report()
        assert fit.residuals.shape == (30, 6)


def test_noise_of_the_camera_is_found_beside_that_of_the_robot() -> None:
    sigma, nees = [], []
    for run in range(12):
        data = sensors.seen_poses([1100, run], robot=ROBOT)
        fit = fit_hand_eye(**data.given, noise_robot=ROBOT)
        e = error(fit, (data.X, data.Y))
        sigma.append(fit.sigma)
        nees.append(e @ np.linalg.solve(fit.cov, e) / 12)
    np.testing.assert_allclose(np.mean(sigma, axis=0), CAMERA, rtol=0.07)
    assert 0.8 < np.mean(nees) < 1.25
    spoilt = sensors.spoilt(np.random.default_rng(0), data.B, [1, 7, 20])
    assert np.flatnonzero(fit_hand_eye(data.A, spoilt, noise_robot=ROBOT, robust=True).outliers).tolist() == [1, 7, 20]


def experiment_of(tilt: float | None = None, robot: tuple[float, float] | None = None):
    def experiment(seed: int, n: int) -> Experiment:
        data = sensors.seen_poses([1000, seed], n, tilt, robot=robot)
        clean = sensors.seen_poses([1000, seed], n, tilt, camera=(0.0, 0.0))
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

    def millimetres(data: dict[str, Any]) -> dict[str, Any]:
        data |= {name: longer(data[name]) for name in ("T_base_tool", "T_cam_marker")}
        return data | {name: (1000.0 * data[name][0], data[name][1]) for name in data if name.startswith("noise")}

    moved_tool = Gauge(  # robot noise refers to the tool point and differs at another point
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


def little_turned(free: float, noise: tuple[float, float] | None = None) -> dict[str, Any]:
    """Return poses rotated only about base z with the tool pointing up (tool axis z), or not rotated at all."""
    rng = np.random.default_rng(8)
    data = sensors.seen_poses(8)
    R = so3.exp(free * rng.uniform(-2, 2, 30)[:, None] * [0.0, 0.0, 1.0])
    A = se3.from_rp(R if free else np.broadcast_to(data.A[0, :3, :3], R.shape), data.A[:, :3, 3])
    B = se3.inv(data.Y) @ A @ data.X
    if noise is not None:
        A, B = sensors.noisy(rng, A, noise), sensors.noisy(rng, B, noise)
    return {"T_base_tool": A, "T_cam_marker": B}


@pytest.mark.parametrize(("runs", "robot", "tilt"), [
    (10, None, None),
    pytest.param(60, None, None, marks=pytest.mark.slow),  # 2 s each
    pytest.param(60, ROBOT, None, marks=pytest.mark.slow),
    pytest.param(60, None, np.radians(30.0), marks=pytest.mark.slow),
])  # fmt: skip
def test_the_statistical_contract(runs: int, robot: tuple[float, float] | None, tilt: float | None) -> None:
    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        bad = np.zeros(len(data["T_cam_marker"]), dtype=bool)
        bad[rng.choice(len(bad), max(len(bad) // 20, 1), replace=False)] = True
        B = sensors.spoilt(rng, data["T_cam_marker"], np.flatnonzero(bad).tolist())
        return {**data, "T_cam_marker": B, "robust": True}, bad

    data = sensors.seen_poses(0)
    refusals = {
        "along tool axis z": {**little_turned(1.0), "noise": CAMERA},
        "T_tool_marker along tool axis z": {**little_turned(1.0, CAMERA), "noise": CAMERA, "noise_robot": CAMERA},
        "tool axis z (T_base_cam moves with it)": little_turned(1.0, CAMERA),
        "translation of T_tool_marker along tool axis x": {**little_turned(0.0), "noise": CAMERA},
        "translation of T_tool_marker along tool axis y": little_turned(0.0, CAMERA),
        "2 poses": {"T_base_tool": data.A[:2], "T_cam_marker": data.B[:2]},
    }
    found = check_estimator(
        fit_hand_eye, experiment_of(tilt, robot), runs, n=30, error=error, gauges=gauges(robot is None),
        blocks={"X t": range(3), "X R": range(3, 6), "Y t": range(6, 9), "Y R": range(9, 12)},
        refusals=refusals, spoil=spoil,
    )  # fmt: skip
    assert found.passed, found.text()


def test_one_axis_is_named_in_any_direction_and_setup() -> None:
    G = se3.exp(np.array([0.0, 0.0, 0.0, 0.7, 0.4, 0.0]))
    given = little_turned(1.0)
    with pytest.raises(NotExcited, match="about two axes, got rotations about one axis only") as caught:
        fit_hand_eye(given["T_base_tool"] @ G, given["T_cam_marker"])
    u = so3.exp([0.7, 0.4, 0.0]).T[:, 2]
    u *= np.sign(u[np.argmax(np.abs(u))])
    assert f"tool axis ({u[0]:.2f}, {u[1]:.2f}, {u[2]:.2f})" in caught.value.directions[0]
    with pytest.raises(NotExcited, match="translation of T_base_marker along base axis z"):
        fit_hand_eye(se3.inv(given["T_base_tool"]), given["T_cam_marker"], setup="eye_in_hand")


def test_weak_directions_are_refused_by_their_deviation() -> None:
    data = sensors.seen_poses(3, 3, np.radians(2.0))
    with pytest.raises(NotExcited, match=r"exceed their limits along: .* of T_.* moves with it\), [0-9.]+ (m|rad)"):
        fit_hand_eye(**data.given, noise=CAMERA)
    fit = fit_hand_eye(**data.given, noise=CAMERA, limits=(100.0, 100.0))
    assert LIMITS == (0.2, 0.2)
    assert "weakest: " in fit.report()


def test_the_ancestors_refinement_does_not_return(capsys) -> None:
    """calibAXYB refined position norms only: Y 1.8 times worse than the bound, results no rotations, text printed."""
    squares = []
    experiment = experiment_of()
    for run in range(40):
        case = experiment(run, 30)
        fit = fit_hand_eye(**case.data)
        e, bound = error(fit, case.truth), np.diag(case.bound)
        squares.append([np.mean(e[k : k + 3] ** 2) / np.mean(bound[k : k + 3]) for k in (0, 3, 6, 9)])
        for T in (fit.value.X, fit.value.Y):
            assert np.abs(T[ROTATION].T @ T[ROTATION] - np.eye(3)).max() < 1e-14
    assert np.sqrt(np.mean(squares, axis=0)).max() < 1.2
    assert capsys.readouterr().out == ""


def error_points(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    X, Y, points = truth
    first = (fit.value.points - points).ravel() if fit.value.X is None else pose_error(fit.value.X, X)
    return np.concatenate([first, pose_error(fit.value.Y, Y)])


def model_of(data: Any, seen: np.ndarray, noise: np.ndarray | None = None) -> PointModel:
    sample, point = np.nonzero(seen)
    return PointModel(data.A[:, :3, :3], data.A[:, :3, 3], data.p[seen], sample, point, seen.shape[1], noise)


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
@pytest.mark.parametrize("missing", [True, False], ids=["20 % missing", "all seen"])
def test_from_points_exact_data_give_the_exact_answer(known, missing) -> None:
    data = sensors.seen_points(0, sigma=0.0)
    p = data.p.copy()
    if missing:
        p[~data.visible] = np.nan
    fit = fit_hand_eye_points(data.A, p, marker=sensors.MARKER if known else None,
                              visible=data.visible if missing else None, noise=1e-4)  # fmt: skip
    np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=1e-12)
    np.testing.assert_allclose(fit.value.points, sensors.MARKER @ data.X[:3, :3].T + data.X[:3, 3], atol=1e-12)
    if known:
        np.testing.assert_allclose(fit.value.T_tool_marker, data.X, atol=1e-12)
    assert fit.residuals.shape == (100, 3, 3)
    assert np.isnan(fit.residuals).any() == missing
    assert fit.outliers.shape == (100,)


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_exact_data_converge_where_no_noise_is_given(known) -> None:
    for run in range(3):
        data = sensors.seen_points(run, sigma=0.0)
        fit = fit_hand_eye_points(data.A[:30], data.p[:30], marker=sensors.MARKER if known else None)
        np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=1e-12)


def test_one_point_is_enough_for_the_camera() -> None:
    data = sensors.seen_points(1)
    fit = fit_hand_eye_points(data.A, data.p[:, :1], noise=SIGMA)
    e = error_points(fit, (data.X, data.Y, sensors.MARKER[:1] @ data.X[:3, :3].T + data.X[:3, 3]))
    assert e @ np.linalg.solve(fit.cov, e) / 9 < 3.0
    assert fit.names[:3] == ("point0 x", "point0 y", "point0 z")
    assert fit.value.X is None


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_from_points_jacobian_is_the_derivative_of_the_residual(known) -> None:
    data = sensors.seen_points(4, 5)
    model = model_of(data, data.visible)
    X, Y = data.X, data.Y
    problem = model.marked(sensors.MARKER) if known else model.free()
    free = Points(sensors.MARKER @ X[:3, :3].T + X[:3, 3], Y[:3, :3], Y[:3, 3])
    value = free
    if known:
        value = marked_start(free, sensors.MARKER)
        np.testing.assert_allclose(value.poses()[0], X, atol=1e-12)
    (found,), h = problem.evaluate(value), 1e-6
    for k, step in enumerate(np.eye(found.J.shape[2]) * h):
        up, down = (problem.evaluate(problem.retract(value, x))[0].r for x in (step, -step))
        np.testing.assert_allclose(found.J[:, :, k], (up - down) / (2 * h), atol=1e-6)


def test_a_missing_point_costs_three_residuals_and_nothing_else() -> None:
    data = sensors.seen_points(5)
    seen = np.ones((100, 3), dtype=bool)
    seen[17, 1] = seen[99] = False  # no point is visible in the last sample
    spoilt = data.p.copy()
    spoilt[~seen] = 1e3
    fit = fit_hand_eye_points(data.A, spoilt, marker=sensors.MARKER, visible=seen, noise=SIGMA, robust=True)
    assert np.count_nonzero(np.isfinite(fit.residuals)) == 3 * (300 - 4)
    assert fit.outliers.shape == (100,)
    whole = fit_hand_eye_points(**data.given, marker=sensors.MARKER, noise=SIGMA)
    assert np.abs((fit.parameters - whole.parameters) / whole.sd).max() < 1.5


def experiment_of_points(known: bool, missing: bool):
    def experiment(seed: int, n: int) -> Experiment:
        data = sensors.seen_points([1500, seed], n)
        points = sensors.MARKER @ data.X[:3, :3].T + data.X[:3, 3]
        seen = data.visible if missing else np.ones((n, 3), dtype=bool)
        clean = sensors.seen_points([1500, seed], n, sigma=0.0)
        model, Y = model_of(clean, seen), data.Y
        free = Points(points, Y[:3, :3], Y[:3, 3])
        if known:
            (truth,) = model.marked(sensors.MARKER).evaluate(marked_start(free, sensors.MARKER))
        else:
            (truth,) = model.free().evaluate(free)
        J = truth.J.reshape(-1, truth.J.shape[2])
        given = {**data.given, "noise": SIGMA, **({"marker": sensors.MARKER} if known else {})}
        given |= {"visible": seen} if missing else {}
        return Experiment(given, (data.X, data.Y, points), SIGMA**2 * np.linalg.inv(J.T @ J))

    return experiment


@pytest.mark.parametrize(("runs", "known", "missing"), [
    (5, True, False),
    pytest.param(120, True, False, marks=pytest.mark.slow),  # 3 s each
    pytest.param(120, True, True, marks=pytest.mark.slow),
    pytest.param(120, False, False, marks=pytest.mark.slow),
])  # fmt: skip
def test_from_points_the_statistical_contract(runs: int, known: bool, missing: bool) -> None:
    G = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -0.5]))
    inv = se3.inv(G)

    def millimetres(data: dict[str, Any]) -> dict[str, Any]:
        data["T_base_tool"] = longer(data["T_base_tool"])
        return data | {name: 1000.0 * data[name] for name in ("p_cam", "noise", "marker") if name in data}

    def truth(fit: Fit[Any], Y: np.ndarray, scale: float = 1.0) -> tuple[Any, ...]:
        X = None if fit.value.X is None else longer(fit.value.X) if scale != 1.0 else fit.value.X
        return X, Y, scale * fit.value.points

    gauges = [
        Gauge("base moved", lambda d: {**d, "T_base_tool": G @ d["T_base_tool"]}, lambda f: truth(f, G @ f.value.Y)),
        Gauge("camera moved", lambda d: {**d, "p_cam": d["p_cam"] @ G[:3, :3].T + G[:3, 3]},
              lambda f: truth(f, f.value.Y @ inv)),
        Gauge("millimetres", millimetres, lambda f: truth(f, longer(f.value.Y), 1000.0)),
    ]  # fmt: skip

    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        p = data["p_cam"].copy()
        bad = np.zeros(len(p), dtype=bool)
        bad[rng.choice(len(p), len(p) // 20, replace=False)] = True
        p[bad] += 0.05 * rng.standard_normal((bad.sum(), 3, 3))
        if missing:  # an invisible outlier cannot be flagged
            bad &= data["visible"].any(axis=1)
        return {**data, "p_cam": p, "robust": True}, bad

    found = check_estimator(
        fit_hand_eye_points, experiment_of_points(known, missing), runs, n=40, error=error_points, gauges=gauges,
        refusals=refusals(known), spoil=spoil,
        skip={"clean": "NaN is allowed where visible is False"} if missing else None,
    )  # fmt: skip
    assert found.passed, found.text()


def refusals(known: bool) -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(7)
    data, more = sensors.seen_points(7), {"marker": sensors.MARKER} if known else {}
    still = "translation of T_tool_marker" if known else "translation of the points"

    def seen(R: np.ndarray, noise: float) -> dict[str, Any]:
        A = se3.from_rp(R, data.A[:, :3, 3])
        T = se3.inv(data.Y) @ A @ data.X
        p = np.einsum("nij,kj->nki", T[:, :3, :3], sensors.MARKER) + T[:, None, :3, 3]
        A[:, :3, :3] = A[:, :3, :3] @ so3.exp(noise * rng.standard_normal((100, 3)))
        return {"T_base_tool": A, "p_cam": p + SIGMA * rng.standard_normal(p.shape), "noise": SIGMA, **more}

    turning = so3.exp(rng.uniform(-2, 2, 100)[:, None] * [0.0, 0.0, 1.0])
    fixed = np.broadcast_to(data.A[0, :3, :3], (100, 3, 3))
    return {
        "along tool axis z": seen(turning, 0.0),
        f"{still} along tool axis z (T_base_cam moves with it)": seen(turning, np.radians(0.05)),
        f"{still} along tool axis x": seen(fixed, 0.0),
        f"{still} along tool axis y": seen(fixed, np.radians(0.05)),
        "2 poses": {"T_base_tool": data.A[:2], "p_cam": data.p[:2], **more},
    }


@pytest.mark.parametrize(("setup", "known"), [("eye_to_hand", False), ("eye_in_hand", True)])
def test_from_points_noise_of_the_robot_makes_the_covariance_honest(setup, known) -> None:
    nees: dict[bool, list[float]] = {True: [], False: []}
    for run in range(12):
        data = sensors.seen_points([1100, run], 40, robot=ROBOT)
        A = data.A
        if setup == "eye_in_hand":  # the robot reads the inverse of A, with noise of its own
            A = sensors.noisy(np.random.default_rng([1100, run, 1]), se3.inv(data.A_exact), ROBOT)
        points = sensors.MARKER @ data.X[:3, :3].T + data.X[:3, 3]
        for told, values in nees.items():
            fit = fit_hand_eye_points(
                A, data.p, visible=data.visible, marker=sensors.MARKER if known else None, setup=setup, noise=SIGMA,
                noise_robot=ROBOT if told else None,
            )  # fmt: skip
            e = error_points(fit, (data.X, data.Y, points))
            values.append(float(e @ np.linalg.solve(fit.cov, e)) / len(e))
    assert 0.75 < np.mean(nees[True]) < 1.3
    assert np.mean(nees[False]) > 1.5


def test_from_points_noise_of_the_camera_is_found_beside_that_of_the_robot() -> None:
    found = []
    for run in range(5):
        data = sensors.seen_points([1101, run], robot=ROBOT)
        p = data.p.copy()
        p[:5] += 0.02
        marked = {"visible": data.visible, "marker": sensors.MARKER}
        fit = fit_hand_eye_points(data.A, p, **marked, noise_robot=ROBOT, robust=True)
        assert fit.outliers[:5][data.visible[:5].any(axis=1)].all()
        found.append(fit.sigma[0])
    assert np.mean(found) == pytest.approx(SIGMA, rel=0.05)


def test_unequal_noise_of_points_counts_by_its_size() -> None:
    told, equal = [], []
    for run in range(6):
        data, rng = sensors.seen_points([1600, run], 40), np.random.default_rng([1600, run])
        sd = np.linspace(0.2, 3.0, 40)[:, None, None] * np.array([0.1e-3, 0.1e-3, 1e-3]) * np.ones((40, 3, 3))
        p = data.p_exact + sd * rng.standard_normal((40, 3, 3))
        given = {"T_base_tool": data.A, "p_cam": p, "marker": sensors.MARKER, "visible": data.visible}
        fit = fit_hand_eye_points(**given, noise=sd[..., None] ** 2 * np.eye(3))
        for one, values in ((fit, told), (fit_hand_eye_points(**given), equal)):
            e = error_points(one, (data.X, data.Y, fit.value.points))
            values.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert 0.8 < np.mean(told) < 1.2
    assert np.mean(equal) > 4.0 * np.mean(told)


def test_unequal_noise_of_poses_counts_by_its_size() -> None:
    told, equal = [], []
    for run in range(25):
        rng = np.random.default_rng([1200, run])
        data = sensors.seen_poses([1200, run])
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
            e = error(one, (data.X, data.Y))
            values.append(e @ np.linalg.solve(fit.cov, e) / 12)
    assert 0.85 < np.mean(told) < 1.15
    assert np.mean(equal) > 4.0 * np.mean(told)


def lagging(seed: int, by: float, setup: str = "eye_to_hand", N: int = 100) -> tuple[Any, Any, Any, Any]:
    """Return poses along a smooth motion, marker poses seen `by` samples late, X and Y."""
    rng = np.random.default_rng([31, seed])
    size, phase = rng.standard_normal((3, 6)) * np.repeat([0.25, 0.5], 3), 2.0 * np.pi * rng.random((3, 6))

    def motion(t: np.ndarray) -> np.ndarray:
        x = sum(size[k] * np.sin(2.0 * np.pi * (k + 1) * t[:, None] + phase[k]) for k in range(3))
        return se3.from_rp(so3.exp(x[:, 3:]), x[:, :3])

    X, Y = se3.from_rp(so3.exp(rng.standard_normal((2, 3))), 0.2 * rng.standard_normal((2, 3)))
    A, seen = motion(np.arange(N) / N), motion((np.arange(N) - by) / N)
    B = se3.inv(Y) @ (seen if setup == "eye_to_hand" else se3.inv(seen)) @ X
    return A, sensors.noisy(rng, B, CAMERA), X, Y


@pytest.mark.parametrize("setup", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("by", [0.4, -0.7])
def test_a_late_camera_is_found_and_named(setup, by) -> None:
    """A delay of 0.4 samples once caused an error of 3.6 mm, with 1.2 mm stated and the verdict "good"."""
    A, B, X, Y = lagging(1, by, setup)
    fit = fit_hand_eye(A, B, setup=setup)
    assert fit.names[-1] == "time offset"
    assert abs(fit.parameters[-1] - by) < 0.1
    assert ("samples late" if by > 0 else "samples early") in fit.doubts[0]
    assert np.linalg.norm(fit.value.X[:3, 3] - X[:3, 3]) < 1e-3
    given = fit_hand_eye(A, B, setup=setup, offset=by)
    assert given.good
    assert len(given.names) == 12
    e = error(given, (X, Y))
    assert e @ np.linalg.solve(given.cov, e) / 12 < 3.0


def test_a_camera_in_time_has_no_offset() -> None:
    for seed in range(10):
        A, B, _, _ = lagging(seed, 0.0)
        assert len(fit_hand_eye(A, B).names) == 12
        random = sensors.seen_poses(seed)
        assert len(fit_hand_eye(random.A, random.B).names) == 12
    with pytest.raises(ShapeError, match="offset"):
        fit_hand_eye(A, B, offset=7.0)


def test_exact_rotations_do_not_hide_the_positions() -> None:
    """With rotation noise of 1e-17, the report once called 0.5 mm of position noise an unidentifiable direction."""
    data = sensors.seen_poses(2, camera=(0.5e-3, 0.0))
    fit = fit_hand_eye(data.A, data.B)
    assert "noise of position" in fit.report()
    assert np.linalg.norm(fit.value.X[:3, 3] - data.X[:3, 3]) < 1e-3

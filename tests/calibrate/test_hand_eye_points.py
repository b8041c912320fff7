"""Hand-eye calibration from points: known marker or not, missing points, at the bound, never silently wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.calibrate import fit_hand_eye_points
from armlab.calibrate.hand_eye_points import PointModel, Points
from armlab.errors import NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3

SIGMA = 0.5e-3


def pose_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[:3, :3].T @ T[:3, :3])])


def error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Error of X and Y, or of the points and Y."""
    X, Y, points = truth
    first = (fit.value.points - points).ravel() if fit.value.X is None else pose_error(fit.value.X, X)
    return np.concatenate([first, pose_error(fit.value.Y, Y)])


def sight_of(data: Any, seen: np.ndarray, noise: np.ndarray | None = None) -> PointModel:
    sample, point = np.nonzero(seen)
    return PointModel(data.A[:, :3, :3], data.A[:, :3, 3], data.p[seen], sample, point, seen.shape[1], noise)


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
@pytest.mark.parametrize("missing", [True, False], ids=["20 % missing", "all seen"])
def test_exact_data_give_the_exact_answer(leds, known, missing) -> None:
    data = leds.draw(0, sigma=0.0)
    p = data.p.copy()
    if missing:
        p[~data.visible] = np.nan
    fit = fit_hand_eye_points(data.A, p, marker=leds.marker if known else None,
                              visible=data.visible if missing else None, noise=1e-4)  # fmt: skip
    np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=1e-12)
    np.testing.assert_allclose(fit.value.points, leds.marker @ data.X[:3, :3].T + data.X[:3, 3], atol=1e-12)
    if known:
        np.testing.assert_allclose(fit.value.T_tool_marker, data.X, atol=1e-12)
    assert fit.residuals.shape == (100, 3, 3)
    assert np.isnan(fit.residuals).any() == missing
    assert fit.outliers.shape == (100,)


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_exact_data_converge_where_no_noise_is_given(leds, known) -> None:
    """Steps then are rounding, and some are long beside a deviation that is rounding too."""
    for run in range(20):
        data = leds.draw(run, sigma=0.0)
        fit = fit_hand_eye_points(data.A[:30], data.p[:30], marker=leds.marker if known else None)
        np.testing.assert_allclose(fit.value.T_base_cam, data.Y, atol=1e-12)


def test_one_point_is_enough_for_the_camera(leds) -> None:
    data = leds.draw(1)
    fit = fit_hand_eye_points(data.A, data.p[:, :1], noise=SIGMA)
    e = error(fit, (data.X, data.Y, leds.marker[:1] @ data.X[:3, :3].T + data.X[:3, 3]))
    assert e @ np.linalg.solve(fit.cov, e) / 9 < 3.0
    assert fit.names[:3] == ("point0 x", "point0 y", "point0 z")
    assert fit.value.X is None


def test_the_camera_is_the_same_with_a_known_marker_and_without(leds) -> None:
    data = leds.draw(2)
    known, free = (fit_hand_eye_points(**data.given, marker=m, noise=SIGMA) for m in (leds.marker, None))
    apart = pose_error(known.value.Y, free.value.Y) / known.sd[6:]
    assert np.abs(apart).max() < 0.5
    np.testing.assert_allclose(known.sd[6:], free.sd[-6:], rtol=0.01)


def test_both_setups_are_one_equation(leds) -> None:
    data = leds.draw(3)
    still = fit_hand_eye_points(**data.given, marker=leds.marker)
    held = fit_hand_eye_points(se3.inv(data.A), data.p, marker=leds.marker, setup="eye_in_hand")
    np.testing.assert_allclose(held.value.T_tool_cam, still.value.T_base_cam, atol=1e-12)
    assert held.names[0] == "T_base_marker x"
    with pytest.raises(UnknownName, match="eye_in_hand"):
        fit_hand_eye_points(**data.given, setup="hand")  # type: ignore[arg-type]


@pytest.mark.parametrize("known", [True, False], ids=["known marker", "unknown marker"])
def test_jacobian_is_the_derivative_of_the_residual(leds, known) -> None:
    data = leds.draw(4, 5)
    sight = sight_of(data, data.visible)
    X, Y = data.X, data.Y
    problem = sight.marked(leds.marker) if known else sight.free()
    free = Points(leds.marker @ X[:3, :3].T + X[:3, 3], Y[:3, :3], Y[:3, 3])
    value = free
    if known:
        from armlab.calibrate.hand_eye_points import marked_start

        value = marked_start(free, leds.marker)
        np.testing.assert_allclose(value.poses()[0], X, atol=1e-12)
    (found,), h = problem.evaluate(value), 1e-6
    for k, step in enumerate(np.eye(found.J.shape[2]) * h):
        up, down = (problem.evaluate(problem.retract(value, x))[0].r for x in (step, -step))
        np.testing.assert_allclose(found.J[:, :, k], (up - down) / (2 * h), atol=1e-6)


def test_a_missing_point_costs_three_residuals_and_nothing_else(leds) -> None:
    data = leds.draw(5)
    seen = np.ones((100, 3), dtype=bool)
    seen[17, 1] = seen[99] = False  # the last sample saw nothing
    spoilt = data.p.copy()
    spoilt[~seen] = 1e3
    fit = fit_hand_eye_points(data.A, spoilt, marker=leds.marker, visible=seen, noise=SIGMA, robust=True)
    assert np.count_nonzero(np.isfinite(fit.residuals)) == 3 * (300 - 4)
    assert fit.outliers.shape == (100,)
    whole = fit_hand_eye_points(**data.given, marker=leds.marker, noise=SIGMA)
    assert np.abs((fit.parameters - whole.parameters) / whole.sd).max() < 1.5


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
def test_outliers_are_flagged_by_index(leds, known) -> None:
    data = leds.draw(6)
    p = data.p.copy()
    which = [0, 10, 20, 55]
    p[which, 1] += 0.02
    fit = fit_hand_eye_points(data.A, p, marker=leds.marker, noise=SIGMA if known else None, robust=True)
    assert fit.outliers[which].all()
    assert fit.outliers.sum() <= 6
    assert fit.sigma[0] == pytest.approx(SIGMA, rel=0.15)


def experiment_of(leds, known: bool, missing: bool):
    def experiment(seed: int, n: int) -> Experiment:
        data = leds.draw([1500, seed], n)
        points = leds.marker @ data.X[:3, :3].T + data.X[:3, 3]
        seen = data.visible if missing else np.ones((n, 3), dtype=bool)
        clean = leds.draw([1500, seed], n, sigma=0.0)
        sight, Y = sight_of(clean, seen), data.Y
        free = Points(points, Y[:3, :3], Y[:3, 3])
        if known:
            from armlab.calibrate.hand_eye_points import marked_start

            (truth,) = sight.marked(leds.marker).evaluate(marked_start(free, leds.marker))
        else:
            (truth,) = sight.free().evaluate(free)
        J = truth.J.reshape(-1, truth.J.shape[2])
        given = {**data.given, "noise": SIGMA, **({"marker": leds.marker} if known else {})}
        given |= {"visible": seen} if missing else {}
        return Experiment(given, (data.X, data.Y, points), SIGMA**2 * np.linalg.inv(J.T @ J))

    return experiment


def contract(leds, runs: int, known: bool = True, missing: bool = False):
    G = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -0.5]))
    inv = se3.inv(G)

    def longer(T: np.ndarray) -> np.ndarray:
        T = T.copy()
        T[..., :3, 3] *= 1000.0
        return T

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
        if missing:  # an outlier that nobody saw cannot be flagged
            bad &= data["visible"].any(axis=1)
        return {**data, "p_cam": p, "robust": True}, bad

    return check_estimator(
        fit_hand_eye_points, experiment_of(leds, known, missing), runs, n=40, error=error, gauges=gauges,
        refusals=refusals(leds, known), spoil=spoil,
        skip={"clean": "NaN is allowed where visible says so"} if missing else None,
    )  # fmt: skip


def refusals(leds, known: bool) -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(7)
    data, more = leds.draw(7), {"marker": leds.marker} if known else {}
    still = "translation of T_tool_marker" if known else "translation of the points"

    def seen(R: np.ndarray, noise: float) -> dict[str, Any]:
        A = se3.from_rp(R, data.A[:, :3, 3])
        T = se3.inv(data.Y) @ A @ data.X
        p = np.einsum("nij,kj->nki", T[:, :3, :3], leds.marker) + T[:, None, :3, 3]
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


def test_the_statistical_contract_in_short(leds) -> None:
    found = contract(leds, 5)
    assert found.passed, found.text()


@pytest.mark.slow  # 5 s each
@pytest.mark.parametrize(("known", "missing"), [(True, False), (True, True), (False, False)],
                         ids=["known marker", "20 % missing", "unknown marker"])  # fmt: skip
def test_the_statistical_contract(leds, known, missing) -> None:
    found = contract(leds, 200, known, missing)
    assert found.passed, found.text()


def test_records_that_do_not_belong_together_are_refused_with_the_cause(leds) -> None:
    data = leds.draw(8)
    robot = data.A.copy()
    robot[:, :3, 3] *= 1000.0
    mixed = np.random.default_rng(0).permutation(100)
    cases = {
        r"Points times 0\.001 would fit: perhaps millimetres": (data.A, 1000.0 * data.p),
        r"Points times 1e\+03 would fit": (robot, data.p),
        "axes of the camera are left-handed": (data.A, data.p * [1.0, 1.0, -1.0]),
        "shifted by 1 samples": (data.A[1:], data.p[:-1]),
        "shifted by 3 samples": (data.A[:-3], data.p[3:]),
        "reverse order": (data.A, data.p[::-1]),
        "the setup is the other one": (se3.inv(data.A), data.p),
        "sample i of both is the same moment": (data.A, data.p[mixed]),
    }
    for words, (A, p) in cases.items():
        for more in ({}, {"marker": 1.0 * leds.marker, "noise": SIGMA}):
            with pytest.raises(NotConverged, match=words):
                fit_hand_eye_points(A, p, **more)


def test_bad_input_is_refused_by_name(leds) -> None:
    data = leds.draw(9, 20)
    spoilt = data.p.copy()
    spoilt[4, 1] = np.nan
    robot = data.A.copy()
    robot[6, 0, 3] = np.inf
    for A, p, more, words in (
        (data.A[:19], data.p, {}, "as many poses of the robot as samples of points, got 19 and 20"),
        (data.A, data.p[:, :, :2], {}, r"p_cam of shape \(N, K, 3\)"),
        (data.A, spoilt, {}, "NaN or Inf in 1 rows: 4"),
        (robot, data.p, {}, "T_base_tool, got NaN or Inf in 1 rows: 6"),
        (data.A, data.p, {"marker": leds.marker[:2]}, r"marker as \(3, 3\)"),
        (data.A, data.p, {"visible": np.ones((20, 3))}, "visible as truth values"),
        (data.A, data.p, {"noise": (0.001, 0.001)}, "noise of points as one standard deviation"),
        (data.A, data.p, {"noise": 0.0}, "above zero"),
        (data.A, data.p, {"noise": -np.eye(3)}, "without negative eigenvalues"),
        (data.A, data.p, {"limits": (0.2, 0.0)}, "two numbers above zero"),
    ):
        with pytest.raises(ShapeError, match=words):
            fit_hand_eye_points(A, p, **more)
    never = np.ones((20, 3), dtype=bool)
    never[:, 2] = False
    with pytest.raises(NotExcited, match="none of points 2"):
        fit_hand_eye_points(**data.given, visible=never)
    with pytest.raises(NotExcited, match="not in a line"):
        fit_hand_eye_points(**data.given, marker=np.diag([1.0, 2.0, 3.0])[[0, 0, 0]] * [[1], [2], [3]])


def test_noise_in_three_forms_is_the_same_noise(leds) -> None:
    data = leds.draw(10)
    S = SIGMA**2 * np.eye(3)
    first, *others = (fit_hand_eye_points(**data.given, marker=leds.marker, visible=data.visible, noise=n)
                      for n in (SIGMA, S, np.broadcast_to(S, (100, 3, 3, 3))))  # fmt: skip
    for other in others:
        np.testing.assert_allclose(other.parameters, first.parameters, atol=1e-12)
        np.testing.assert_allclose(other.cov, first.cov, rtol=1e-9)
    assert "times the noise that was given" in first.report()

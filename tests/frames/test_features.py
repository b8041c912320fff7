"""Planes, lines, circles and spheres fitted to points; points at one distance from a plane."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab.calibrate.laser_model import cube
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.frames import Line, Plane, check_offset, fit_circle, fit_line, fit_plane, fit_sphere
from armlab.frames.feature_fit import LIMIT, upward
from armlab.frames.features import Circle, Sphere
from armlab.frames.plane_line import OffsetCheck
from armlab.lie import se3, so3
from armlab.sim.experiments.sensors import rotations

SIGMA = 5e-5
PLANE = Plane.of([0.1, 0.2, 1.0], [0.3, 0.4, 2.0])


def sheet(n: int = 20, seed: int = 0, sigma: float = SIGMA) -> np.ndarray:
    rng = np.random.default_rng(seed)
    p = np.column_stack([rng.uniform(-0.15, 0.15, n), rng.uniform(-0.1, 0.1, n), np.full(n, 2.0)])
    return p + sigma * rng.standard_normal((n, 3))


def rod(n: int = 20, seed: int = 0, sigma: float = SIGMA) -> np.ndarray:
    """Points on the line through (0, 1, 2) along x, in order."""
    rng = np.random.default_rng(seed)
    p = np.column_stack([np.sort(rng.uniform(-0.15, 0.15, n)), np.ones(n), np.full(n, 2.0)])
    return p + sigma * rng.standard_normal((n, 3))


def ring(rng: np.random.Generator, n: int, arc: float = 2 * np.pi, sigma: float = SIGMA) -> np.ndarray:
    """Points on a circle of radius 0.2 about (0, 0, 1), normal z."""
    turn = rng.uniform(0.0, arc, n)
    p = np.column_stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), np.ones(n)])
    return p + sigma * rng.standard_normal((n, 3))


RING = ring(np.random.default_rng(0), 9)


def test_residuals_and_report() -> None:
    p = sheet()
    fit = fit_plane(p)
    np.testing.assert_allclose(fit.residuals, p @ fit.value.n - fit.value.d, rtol=0, atol=1e-15)
    assert fit.sigma[0] == pytest.approx(SIGMA, rel=0.4)
    assert "n . x = d" in fit.report()
    line = fit_line(rod())
    assert line.residuals.shape == (20, 3)
    np.testing.assert_allclose(line.residuals @ line.value.v, 0.0, atol=1e-16)
    assert "x = r + s v" in line.report()


def test_directions_follow_the_rule_in_every_orientation() -> None:
    plane, line, p = fit_plane(sheet()).value, fit_line(rod()).value, ring(np.random.default_rng(1), 20)
    circle = fit_circle(p).value
    assert circle.n[2] > 0
    assert len(list(cube())) == 24
    for R in cube():
        np.testing.assert_allclose(fit_circle(p @ R.T).value.n, R @ circle.n, atol=1e-9)
        np.testing.assert_allclose(fit_plane(sheet() @ R.T).value.n, R @ plane.n, atol=1e-12)
        turned = fit_line(rod() @ R.T).value
        np.testing.assert_allclose(turned.v, R @ line.v, atol=1e-12)
        np.testing.assert_allclose(turned.r, R @ line.r, atol=1e-12)
        np.testing.assert_allclose(fit_line(rod()[::-1] @ R.T).value.v, -R @ line.v, atol=1e-12)


def test_hints_choose_the_side() -> None:
    p, round_ = sheet(), ring(np.random.default_rng(1), 20)
    assert fit_circle(round_, toward=[0, 0, 0]).value.n[2] < 0
    with pytest.raises(NotExcited, match="toward="):
        fit_circle(round_ - [0, 0, 1.0])
    away = fit_plane(p).value.n
    np.testing.assert_allclose(fit_plane(p, toward=[0, 0, 0]).value.n, -away, atol=1e-15)
    np.testing.assert_allclose(fit_plane(p, normal=[0.3, 0, -1]).value.n, -away, atol=1e-15)
    np.testing.assert_allclose(fit_line(rod(), along=[-1, 0.4, 0]).value.v, -fit_line(rod()).value.v, atol=1e-15)


def test_upward_needs_a_side() -> None:
    n = np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(upward(n, np.array([0.0, 0, -2]), 1e-3, None, None, "plane"), -n)
    with pytest.raises(NotExcited, match="toward="):
        upward(n, np.array([3.0, 0, 2e-3]), 1e-3, None, None, "plane")
    with pytest.raises(NotExcited) as caught:
        fit_plane(sheet() - [0, 0, 2.0])
    assert caught.value.directions == ("side of the plane",)
    assert fit_plane(sheet() - [0, 0, 2.0], normal=[0, 0, 1]).value.n[2] > 0.99
    with pytest.raises(ShapeError, match="got a hint on neither side"):
        fit_plane(sheet(), toward=[0.1, 0, 2.0])
    with pytest.raises(ShapeError, match="got both"):
        fit_plane(sheet(), toward=[0.1, 0, 0], normal=[0, 0, 1])
    closed = rod()
    closed[-1] = closed[0]
    with pytest.raises(NotExcited, match="along="):
        fit_line(closed)
    with pytest.raises(ShapeError, match="got a direction perpendicular to it"):
        fit_line(rod(sigma=0.0), along=[0, 1, 0])


@pytest.mark.parametrize(("call", "error", "sentence"), [
    (lambda: fit_plane(sheet(3)), NotExcited, "at least 4 points"),
    (lambda: fit_plane(sheet(4), robust=True), NotExcited, "at least 5 points"),
    (lambda: fit_line(rod(2)), NotExcited, "at least 3 points"),
    (lambda: fit_plane(sheet().T), ShapeError, "Transpose"),
    (lambda: fit_plane([["a"] * 3] * 5), ShapeError, "real numbers"),
    (lambda: fit_plane(sheet(), noise=0.0), ShapeError, r"finite noise \[m\] above zero"),
    (lambda: fit_plane(sheet(), limit=-1.0), ShapeError, "limit"),
    (lambda: fit_line(np.vstack([rod(), [np.nan, 0, 0]])), ShapeError, "rows 20"),
    (lambda: fit_plane(rod(20, sigma=0.0), normal=[0, 0, 1]), NotExcited, r"the long axis of the points, \(1.0000"),
    (lambda: fit_plane(rod(200), normal=[0, 0, 1]), NotExcited, r"tilt about the long axis of the points, \(1.0000"),
    (lambda: fit_line(np.ones((20, 3)), along=[1, 0, 0]), NotExcited, "points coincide"),
    (lambda: fit_circle(RING[:3]), NotExcited, "at least 4 points"),
    (lambda: fit_sphere(RING[:4]), NotExcited, "at least 5 points"),
    (lambda: fit_circle(RING[:4], robust=True), NotExcited, "at least 5 points"),
    (lambda: fit_circle(RING[:, :2]), ShapeError, r"\(N, 3\)"),
    (lambda: fit_sphere(np.vstack([RING, [np.nan] * 3])), ShapeError, "rows 9"),
    (lambda: fit_circle(np.outer(np.arange(9.0), [1, 2, 3])), NotExcited, "collinear"),
    (lambda: fit_circle(np.ones((9, 3))), NotExcited, "coincident"),
    (lambda: check_offset(PLANE, points(2, 0.0, 0.0)), NotExcited, "at least 3 points"),
    (lambda: check_offset(PLANE, [[0, 0, 0], [0, np.inf, 0], [0, 0, 1]]), ShapeError, "rows 1"),
    (lambda: check_offset([0, 0, 1], points(5, 0.0, 0.0)), ShapeError, "Plane"),
])  # fmt: skip
def test_bad_input_is_refused(call, error, sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call()
    assert LIMIT == 0.2


def test_minimal_sets_find_outliers() -> None:
    p = sheet(5, 3)
    p[2, 2] += 0.02
    assert fit_plane(p, robust=True).outliers.tolist() == [False, False, True, False, False]
    q = rod(4, 1)
    q[3, 1] += 0.02
    assert fit_line(q, robust=True).outliers.tolist() == [False, False, False, True]
    for n in (40, 200):  # all sets, and seeded ones
        bad = np.arange(n) < 0.4 * n
        many = sheet(n, 7)
        many[bad, 2] += np.random.default_rng(1).uniform(0.005, 0.1, int(bad.sum()))
        fit = fit_plane(many, robust=True, noise=SIGMA)
        np.testing.assert_array_equal(fit.outliers[bad], True)
        assert fit.outliers[~bad].sum() <= 1
        assert fit.n == n - fit.outliers.sum()
        assert abs(fit.value.n[2]) > 1 - 1e-6


def drawn(seed: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng([5000, seed])
    R, c = rotations(rng, 1)[0], rng.standard_normal(3)
    flat = c + rng.uniform(-1, 1, (n, 2)) * [0.15, 0.10] @ R[:, :2].T
    measured = flat + SIGMA * rng.standard_normal((n, 3))
    thin = c + np.outer(rng.uniform(-0.15, 0.15, n), R[:, 0])
    return R, c, measured, thin + SIGMA * rng.standard_normal((n, 3))


def plane_error(fit: Fit[Plane], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    n, c = truth
    value = fit.value
    return np.array([*(value.axes @ np.cross(n, value.n)), n @ (value.centroid - c)])


def line_error(fit: Fit[Line], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    v, c = truth
    value = fit.value
    return np.concatenate([value.axes @ np.cross(v, value.v), value.axes @ (value.centroid - c)])


MOVE = se3.from_rp(so3.exp([0.4, 1.0, -0.3]), [3.0, -1.0, 2.0])


def spoil(data: dict, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    bad = np.zeros(len(data["p"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    away = rng.standard_normal((len(bad), 3))
    side = np.asarray(data.get("normal", np.cross(data.get("along", [0, 0, 1]), [0.3, 0.5, 0.8])))
    away = 0.01 * np.sign(away @ side)[:, None] * side / np.linalg.norm(side)
    return {**data, "p": data["p"] + bad[:, None] * away, "robust": True}, bad


def scaled(data: dict) -> dict:
    return {**data, "p": 1000.0 * data["p"], "noise": 1000.0 * data["noise"]}


def uneven(seed: int, n: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, errors and covariances like a tracker's, which is less accurate along its ray."""
    rng = np.random.default_rng([8, seed])
    root = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0] * np.array([2e-4, 5e-5, 2e-5])
    places, errors = rng.uniform(-0.15, 0.15, (n, 3)), (root @ rng.standard_normal((n, 3, 1)))[..., 0]
    return places, errors, root @ root.transpose(0, 2, 1)


def circle_error(fit: Fit[Circle], truth: tuple) -> np.ndarray:
    centre, n, radius = truth
    value = fit.value
    return np.array([*(value.centre - centre), *(value.axes @ np.cross(n, value.n)), value.radius - radius])


def sphere_error(fit: Fit[Sphere], truth: tuple) -> np.ndarray:
    return np.array([*(fit.value.centre - truth[0]), fit.value.radius - truth[1]])


ABOVE = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(("fit", "error", "truth", "hint", "better"), [
    (fit_plane, plane_error, (np.eye(3)[2], ABOVE), {"normal": [0, 0, 1]}, 0.8),
    (fit_line, line_error, (np.eye(3)[0], ABOVE), {"along": [1, 0, 0]}, 0.8),
    (fit_sphere, sphere_error, (ABOVE, 0.2), {}, 0.9),
], ids=["plane", "line", "sphere"])  # fmt: skip
def test_points_of_their_own_covariance(fit, error, truth, hint: dict, better: float) -> None:
    """NEES over the dimension is 1, and the error is smaller than with one standard deviation for all points."""
    nees, weighted, plain = [], [], []
    p = np.zeros((0, 3))
    for seed in range(30):
        p, e, cov = uneven(seed)
        on = {fit_plane: p * [1, 1, 0], fit_line: p * [1, 0, 0]}.get(fit)
        on = 0.2 * p / np.linalg.norm(p, axis=1, keepdims=True) if on is None else on
        p = on + ABOVE + e
        found = fit(p, noise=cov, **hint)
        d = error(found, truth)
        nees.append(d @ np.linalg.solve(found.cov, d) / len(d))
        weighted.append(np.sum(d[:2] ** 2))
        plain.append(np.sum(error(fit(p, **hint), truth)[:2] ** 2))
    assert 0.8 < np.mean(nees) < 1.25
    assert np.sqrt(np.mean(weighted) / np.mean(plain)) < better
    one, other = fit(p, noise=np.eye(3) * SIGMA**2, **hint), fit(p, noise=SIGMA, **hint)
    assert np.abs(error(one, truth) - error(other, truth)).max() < 1e-12
    np.testing.assert_allclose(np.sort(np.diag(one.cov)), np.sort(np.diag(other.cov)), rtol=1e-6)


def test_outliers_among_points_of_their_own_covariance() -> None:
    p, e, cov = uneven(3)
    p = p * [1, 1, 0] + [0, 0, 1.0] + e
    p[[4, 11], 2] += 0.003
    found = fit_plane(p, noise=cov, robust=True)
    assert np.flatnonzero(found.outliers).tolist() == [4, 11]
    with pytest.raises(ShapeError, match=r"\(20, 3, 3\)"):
        fit_plane(p, noise=cov[:5])
    with pytest.raises(ShapeError, match="at point 2"):
        fit_line(p, noise=np.where(np.arange(20)[:, None, None] == 2, -cov, cov))


def test_the_side_of_a_plane_is_as_sure_as_its_tilt_far_away() -> None:
    """Points five metres from the origin: a height of 2 mm is within the uncertainty of their tilt."""
    rng = np.random.default_rng(1)
    p = np.column_stack([rng.uniform(5.0, 5.2, 20), rng.uniform(-0.1, 0.1, 20), np.full(20, 0.002)])
    with pytest.raises(NotExcited, match="side"):
        fit_plane(p, noise=1e-4)
    assert fit_plane(p, noise=1e-4, toward=[5.0, 0.0, 1.0]).value.n[2] == pytest.approx(1.0)
    assert fit_plane(p, noise=1e-6).value.n[2] == pytest.approx(1.0)


@pytest.mark.parametrize(("fit", "draw", "n"), [(fit_line, rod, 4), (fit_plane, sheet, 5)])
def test_noise_of_few_points_is_not_flattered(fit: Callable[..., Fit], draw: Callable[..., np.ndarray], n: int) -> None:
    """The mean of sigma^2 is the variance: degrees of freedom used by the fit are subtracted."""
    squares = [fit(draw(n, seed)).sigma[0] ** 2 for seed in range(150)]
    assert np.mean(squares) == pytest.approx(SIGMA**2, rel=0.15)


def points(n: int, offset: float, sigma: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    on = PLANE.centroid + rng.uniform(-1, 1, (n, 2)) @ PLANE.axes
    return on + (offset + sigma * rng.standard_normal((n, 1))) * PLANE.n


def test_the_constant_and_its_deviation() -> None:
    found = check_offset(PLANE, points(400, -0.005, 1e-4))
    assert isinstance(found, OffsetCheck)
    assert found.sigma == pytest.approx(1e-4, rel=0.1)
    assert found.sd == pytest.approx(found.sigma / 20, rel=0.01)
    assert abs(found.offset + 0.005) < 4 * found.sd
    assert found.outliers.sum() <= 3


def test_outliers_are_flagged_by_index() -> None:
    p = points(9, 0.005, 5e-5)
    p[[1, 4, 7, 8]] += np.outer([0.01, -0.02, 0.03, 0.004], PLANE.n)
    found = check_offset(PLANE, p)
    assert np.flatnonzero(found.outliers).tolist() == [1, 4, 7, 8]
    assert abs(found.offset - 0.005) < 1e-4
    assert "point 4: -0.02" in found.text()


def ball(rng: np.random.Generator, n: int, cap: float = np.pi, sigma: float = SIGMA) -> np.ndarray:
    """Points on a sphere of radius 0.2 about (0, 0, 1), within an angle `cap` of its top."""
    height, turn = rng.uniform(np.cos(cap), 1.0, n), rng.uniform(0.0, 2 * np.pi, n)
    flat = np.sqrt(1 - height**2)
    p = 0.2 * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height]) + [0, 0, 1]
    return p + sigma * rng.standard_normal((n, 3))


def test_exact_points() -> None:
    rng = np.random.default_rng(0)
    plane, line = fit_plane(sheet(sigma=0.0)).value, fit_line(rod(sigma=0.0)).value
    circle, sphere = fit_circle(ring(rng, 20, 1.0, 0.0)).value, fit_sphere(ball(rng, 20, 1.0, 0.0)).value
    for found, truth in (
        (plane.n, [0, 0, 1]), (plane.d, 2.0), (line.v, [1, 0, 0]), (line.r, [0, 1, 2]), (circle.centre, [0, 0, 1]),
        (circle.n, [0, 0, 1]), (circle.radius, 0.2), (sphere.centre, [0, 0, 1]), (sphere.radius, 0.2),
    ):  # fmt: skip
        np.testing.assert_allclose(found, truth, rtol=0, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_what_does_not_tell_the_centre_is_refused(sigma: float) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        with pytest.raises(NotExcited) as caught:
            fit_circle(ring(rng, 20, 0.02 if sigma else 1e-9, sigma))
        assert "centre" in caught.value.directions[0]
        with pytest.raises(NotExcited) as caught:
            fit_sphere(ball(rng, 20, 0.03, sigma) if sigma else ring(rng, 20, 6.0, 0.0))
        assert "centre along" in caught.value.directions[0] or "centre and radius" in caught.value.directions[0]


def test_minimal_sets_find_outliers_of_circles_and_spheres() -> None:
    p = ring(np.random.default_rng(2), 5)
    p[3] += [0.0, 0.0, 0.02]
    assert np.flatnonzero(fit_circle(p, robust=True).outliers).tolist() == [3]
    q = ball(np.random.default_rng(3), 6)
    q[1] *= [1.0, 1.0, 1.02]
    assert np.flatnonzero(fit_sphere(q, robust=True).outliers).tolist() == [1]
    many = ball(np.random.default_rng(4), 100)
    many[:30] = [0, 0, 1] + np.random.default_rng(5).uniform(1.02, 1.3, (30, 1)) * (many[:30] - [0, 0, 1])
    found = fit_sphere(many, robust=True, noise=SIGMA)
    assert found.outliers[:30].all()
    assert found.outliers[30:].sum() <= 1
    p = sheet(20_000)  # no square of their number is ever stored
    p[:4_000, 2] += 0.01
    fit = fit_plane(p, robust=True)
    assert fit.outliers[:4_000].all()
    assert fit.n > 15_800
    assert fit_line(rod(20_000), robust=True).n > 19_800


def inflated(data: dict, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    bad = np.zeros(len(data["p"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    middle = data["p"].mean(axis=0)
    return {**data, "p": np.where(bad[:, None], middle + 1.1 * (data["p"] - middle), data["p"]), "robust": True}, bad


def displaced(data: dict) -> dict:
    hints = {name: MOVE[:3, :3] @ data[name] for name in ("normal", "along") if name in data}
    return {**data, "p": data["p"] @ MOVE[:3, :3].T + MOVE[:3, 3], **hints}


def truth_of(value: Plane | Line | Circle | Sphere, T: np.ndarray, scale: float = 1.0) -> tuple:
    if isinstance(value, Plane | Line):
        there = value.moved(T)
        return there.n if isinstance(there, Plane) else there.v, scale * there.centroid
    centre = scale * (T[:3, :3] @ value.centre + T[:3, 3])
    turned = (T[:3, :3] @ value.n,) if isinstance(value, Circle) else ()
    return (centre, *turned, scale * value.radius)


def made(what: str) -> Callable[[int, int], Experiment]:
    def experiment(seed: int, n: int) -> Experiment:
        R, c, flat, thin = drawn(seed, n)
        if what == "plane":
            return Experiment({"p": flat, "noise": SIGMA, "normal": R[:, 2]}, (R[:, 2], c))
        if what == "line":
            return Experiment({"p": thin, "noise": SIGMA, "along": R[:, 0]}, (R[:, 0], c))
        rng = np.random.default_rng([6000, seed])
        if what == "sphere":
            return Experiment({"p": ball(rng, n, 1.5) - ABOVE + c, "noise": SIGMA}, (c, 0.2))
        p = (ring(rng, n, 4.0, 0.0) - ABOVE) @ R.T + c + SIGMA * rng.standard_normal((n, 3))
        return Experiment({"p": p, "noise": SIGMA, "normal": R[:, 2]}, (c, R[:, 2], 0.2))

    return experiment


PLACE = np.ones((20, 3)) + SIGMA * np.random.default_rng(0).standard_normal((20, 3))
SHORT, CAP = ring(np.random.default_rng(0), 20, 0.02), ball(np.random.default_rng(0), 20, 0.03)
CONTRACTS = {
    "plane": (fit_plane, plane_error, spoil, "tilt about the long axis", {"p": rod(), "normal": [0, 0, 1]}),
    "line": (fit_line, line_error, spoil, "points coincide", {"p": PLACE, "along": [1, 0, 0]}),
    "circle": (fit_circle, circle_error, inflated, "centre", {"p": SHORT, "normal": [0, 0, 1]}),
    "sphere": (fit_sphere, sphere_error, inflated, "centre along", {"p": CAP}),
}


@pytest.mark.parametrize(("what", "runs"), [
    ("plane", 60),
    ("line", 60),
    pytest.param("circle", 50, marks=pytest.mark.slow),  # 3 s
    pytest.param("sphere", 50, marks=pytest.mark.slow),
])  # fmt: skip
def test_every_fit_keeps_the_contract(what: str, runs: int) -> None:
    fit, error, bad, words, data = CONTRACTS[what]
    gauges = [
        Gauge("frame", displaced, lambda fit: truth_of(fit.value, MOVE)),
        Gauge("millimetres", scaled, lambda fit: truth_of(fit.value, np.eye(4), 1000.0)),
    ]
    contract = check_estimator(
        fit, made(what), runs, n=20, error=error, gauges=gauges, spoil=bad,
        refusals={words: {**data, "noise": SIGMA}},
        skip={"efficient": "benchmarks/bench_calibrate_frames.py judges it on 1000 runs of two seeds"},
    )  # fmt: skip
    assert contract.passed, contract.text()

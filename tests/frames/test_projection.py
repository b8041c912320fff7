"""Projections, intersections, distances, and how the errors of features go through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.frames import Line, Plane, distance, intersect, project
from armlab.lie import so3

RNG = np.random.default_rng(3)
LINE_COV = np.diag([1e-3, 2e-3, 1e-4, 3e-4]) ** 2
PLANE_COV = np.diag([2e-3, 1e-3, 2e-4]) ** 2
PLANE = replace(Plane.of([0.2, -0.1, 1.0], [0.3, 0.2, 0.9]), cov=PLANE_COV)
OTHER = replace(Plane.of([1.0, 0.4, 0.2], [0.7, -0.2, 0.6]), cov=2.0 * PLANE_COV)
LINE = replace(Line.of([1.0, 0.4, 0.3], [0.1, -0.2, 0.5]), cov=LINE_COV)


def test_points_on_a_plane_and_on_a_line() -> None:
    p = RNG.standard_normal((4, 5, 3))
    q = project(p, PLANE)
    np.testing.assert_allclose(q @ PLANE.n, PLANE.d, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.cross(p - q, PLANE.n), 0.0, atol=1e-15)
    np.testing.assert_allclose(q, p - (p @ PLANE.n - PLANE.d)[..., None] * PLANE.n, atol=1e-15)
    r = project(p, LINE)
    np.testing.assert_allclose((p - r) @ LINE.v, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.cross(r - LINE.r, LINE.v), 0.0, atol=1e-15)
    assert project([1.0, 2.0, 3.0], PLANE).shape == (3,)


def test_a_line_on_a_plane_is_the_line_of_its_points() -> None:
    shadow = project(LINE, PLANE)
    on = project(LINE.centroid + np.outer([-1.0, 2.0], LINE.v), PLANE)
    np.testing.assert_allclose(shadow.offset(on), 0.0, atol=1e-15)
    assert shadow.v @ (on[1] - on[0]) > 0
    assert shadow.v @ PLANE.n == pytest.approx(0.0, abs=1e-16)
    with pytest.raises(ShapeError, match="along its normal"):
        project(Line.of(PLANE.n, [0, 0, 0]), PLANE)
    nearly = Line.of(PLANE.n + 1e-7 * PLANE.axes[0], [0, 0, 0])
    np.testing.assert_allclose(project(nearly, PLANE).v, PLANE.axes[0], atol=1e-8)


def test_intersections() -> None:
    point = intersect(PLANE, LINE)
    assert PLANE.distance([point])[0] == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose(LINE.offset([point]), 0.0, atol=1e-15)
    np.testing.assert_array_equal(point, intersect(LINE, PLANE))
    edge = intersect(PLANE, OTHER)
    for plane in (PLANE, OTHER):
        np.testing.assert_allclose(plane.distance(edge.centroid + np.outer([-3.0, 0, 5.0], edge.v)), 0.0, atol=1e-14)
    assert edge.v @ np.cross(PLANE.n, OTHER.n) > 0
    assert edge.v @ (edge.centroid - PLANE.centroid) == pytest.approx(0.0, abs=1e-15)


def test_distance_of_lines() -> None:
    z = Line.of([0, 0, 1.0], [0, 0, 5.0])
    assert distance(z, Line.of([1.0, 0, 0], [7.0, 2.0, 0])) == pytest.approx(2.0)
    assert distance(z, Line.of([0, 0, -1.0], [3.0, 4.0, 0])) == pytest.approx(5.0)
    assert distance(z, Line.of([1.0, 1.0, 1.0], [0, 0, 3.0])) == pytest.approx(0.0, abs=1e-15)


def shifted(item: Line | Plane, e: np.ndarray) -> Line | Plane:
    """Return a feature with the errors e of its names."""
    R = so3.exp(e[0] * item.axes[0] + e[1] * item.axes[1])
    if isinstance(item, Line):
        return Line.of(R @ item.v, item.centroid + e[2:] @ item.axes)
    return Plane.of(R @ item.n, item.centroid + e[2] * item.n)


@pytest.mark.parametrize(
    ("make", "items"), [(project, (LINE, PLANE)), (intersect, (PLANE, OTHER))], ids=["shadow", "edge"]
)
def test_errors_go_through(make: Callable, items: tuple) -> None:
    """The covariance of the result is that of its central differences."""
    plain, columns, variances = make(*items), [], []
    for which, item in enumerate(items):
        for k in range(len(item.names)):
            ends = []
            for h in (1e-6, -1e-6):
                e = np.zeros(len(item.names))
                e[k] = h
                found = make(*(shifted(item, e) if i == which else other for i, other in enumerate(items)))
                turn = plain.axes @ np.cross(plain.v, found.v)
                away = found.centroid - plain.centroid
                away -= found.v * (plain.v @ away) / (plain.v @ found.v)  # where it passes the old centroid
                ends.append(np.concatenate([turn, plain.axes @ away]))
            columns.append((ends[0] - ends[1]) / 2e-6)
            variances.append(item.cov[k, k])
    J = np.stack(columns, axis=1)
    np.testing.assert_allclose(plain.cov, J * variances @ J.T, rtol=1e-6, atol=1e-15)


def test_what_is_exact_stays_exact() -> None:
    assert project(replace(LINE, cov=None), replace(PLANE, cov=None)).cov is None
    half = project(LINE, replace(PLANE, cov=None))
    assert half.cov is not None
    assert np.all(np.linalg.eigvalsh(project(LINE, PLANE).cov - half.cov) > -1e-18)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: project(LINE, LINE), "Project its points"),
        (lambda: project(np.zeros((2, 4)), PLANE), "points"),
        (lambda: project([np.nan, 0, 0], PLANE), "missing"),
        (lambda: project([0, 0, 0], "plane"), "Take the value of a fit"),
        (lambda: intersect(LINE, LINE), "distance"),
        (lambda: intersect(PLANE, Line.of(PLANE.axes[0], [0, 0, 0])), "parallel to it"),
        (lambda: intersect(PLANE, -PLANE), "parallel ones"),
        (lambda: distance(LINE, PLANE), "two lines"),
    ],
)
def test_bad_input_is_refused(call, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        call()

"""Frames from two features: exact axes, right-handed by construction, with the covariance of the features."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from armlab.errors import ArmlabError, FrameError, ShapeError
from armlab.frames import BuiltFrame, Circle, Line, Plane, Sphere, build, fit_line
from armlab.lie import se3, so3

LINE = replace(Line.of([0.1, 0.2, 1.0], [0.3, 0.1, 0.9]), cov=np.diag([1e-3, 3e-3, 1e-4, 1e-4]) ** 2)
PLANE = replace(Plane.of([0.3, 1.0, 0.1], [0.3, 0.1, 0.9]), cov=np.diag([2e-3, 1e-3, 1e-4]) ** 2)


@pytest.mark.parametrize(("one", "two"), list(permutations("xyz", 2)))
def test_the_first_is_exact_the_second_orthogonal_the_third_right_handed(one: str, two: str) -> None:
    found = build(**{one: LINE, two: -PLANE}, origin=[1.0, 2.0, 3.0])
    assert isinstance(found, BuiltFrame)
    R = found.T[:3, :3]
    np.testing.assert_array_equal(R[:, "xyz".index(one)], LINE.v)
    assert -PLANE.n @ R[:, "xyz".index(two)] > 0
    third = 3 - "xyz".index(one) - "xyz".index(two)
    assert PLANE.n @ R[:, third] == pytest.approx(0.0, abs=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)
    assert se3.is_pose(found.T, 1e-14)
    assert np.cos(found.angle) == pytest.approx(-LINE.v @ PLANE.n, abs=1e-15)
    assert found.deviation == pytest.approx(found.angle - np.pi / 2)
    np.testing.assert_array_equal(found.T[:3, 3], [1, 2, 3])


def test_vectors_are_exact_features() -> None:
    found = build(x=[2.0, 0, 0], z=[5.0, 0, 1.0], origin=[0, 0, 0])
    np.testing.assert_allclose(found.T, np.eye(4), atol=1e-15)
    assert found.cov is None


@pytest.mark.parametrize(("one", "two"), [("z", "y"), ("y", "x"), ("x", "z")])
def test_the_covariance_is_that_of_central_differences(one: str, two: str) -> None:
    origin_cov = np.diag([1.0, 2.0, 3.0]) * 1e-8
    found = build(**{one: LINE, two: -PLANE}, origin=[1.0, 2.0, 3.0], origin_cov=origin_cov)
    J, variances = [], []
    for item in (LINE, PLANE):
        for k in range(2):
            ends = []
            for h in (1e-6, -1e-6):
                R = so3.exp(h * item.axes[k])
                line = Line.of(R @ LINE.v, LINE.r) if item is LINE else LINE
                plane = Plane.of(R @ PLANE.n, PLANE.centroid) if item is PLANE else PLANE
                there = build(**{one: line, two: -plane}, origin=[1.0, 2.0, 3.0]).T
                ends.append(so3.log(found.T[:3, :3].T @ there[:3, :3]))
            J.append((ends[0] - ends[1]) / 2e-6)
            variances.append(item.cov[k, k])
    J = np.stack(J, axis=1)
    np.testing.assert_allclose(found.cov[3:, 3:], J * variances @ J.T, rtol=1e-6, atol=1e-14)
    np.testing.assert_array_equal(found.cov[:3, :3], origin_cov)
    np.testing.assert_array_equal(found.cov[:3, 3:], 0.0)


def test_the_origin_of_a_sphere_or_circle() -> None:
    ball = Sphere(np.array([1.0, 2, 3]), 0.1, np.diag([1.0, 2, 3, 4]) * 1e-8)
    found = build(x=[1.0, 0, 0], y=[0, 1.0, 0], origin=ball)
    np.testing.assert_allclose(np.diag(found.cov), [1e-8, 2e-8, 3e-8, 0, 0, 0], rtol=1e-15)
    hole = Circle(np.array([1.0, 2, 3]), np.eye(3)[2], 0.1, np.eye(3)[:2])
    np.testing.assert_array_equal(build(z=hole, x=[1.0, 0, 1.0], origin=hole).T[:3, 3], [1, 2, 3])


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (lambda: build(z=LINE, origin=[0, 0, 0]), ShapeError, "exactly two"),
        (lambda: build(x=LINE, y=PLANE, z=LINE, origin=[0, 0, 0]), ShapeError, "exactly two"),
        (lambda: build(z=LINE, w=PLANE, origin=[0, 0, 0]), FrameError, "'w'"),
        (lambda: build(z=LINE, xy=PLANE, origin=[0, 0, 0]), FrameError, "'xy'"),
        (lambda: build(z=LINE, y=[0.1, 0.2, 1.0], origin=[0, 0, 0]), ShapeError, "not parallel"),
        (lambda: build(z=LINE, y=-LINE, origin=[0, 0, 0]), ShapeError, "not parallel"),
        (lambda: build(z=LINE, y=PLANE, origin=[0, 0]), ShapeError, "origin"),
        (lambda: build(z=LINE, y=[0, 0, 0], origin=[0, 0, 0]), ShapeError, "length zero"),
        (lambda: build(z=fit_line(np.outer(np.arange(5.0), [1, 2, 3])), y=PLANE, origin=[0, 0, 0]), ShapeError, "Fit"),
        (lambda: build(z=LINE, y=PLANE, origin=Sphere(np.ones(3), 1.0), origin_cov=np.eye(3)), ShapeError, "beside"),
    ],
)
def test_bad_input_is_refused(call: Callable, error: type[ArmlabError], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call()

"""Features as values: what was typed in fits together, a move keeps the invariants, a minus turns them round."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import models
from armlab.errors import ShapeError
from armlab.frames import Circle, Line, Plane, Sphere
from armlab.lie import se3, so3

T_A_B = se3.from_rp(so3.exp([0.3, -1.2, 0.7]), [0.4, -2.0, 1.5])
COV = np.diag([1e-6, 4e-6, 1e-8])


def test_plane_of_a_normal_that_is_not_unit() -> None:
    """Files of trackers have six decimals: the length is made 1, not taken for 1."""
    plane = Plane.of([0.999918, 0.010683, -0.007026], [-0.44, 0.23, -2.6])
    assert np.linalg.norm(plane.n) == pytest.approx(1.0, abs=1e-15)
    assert plane.d == pytest.approx(plane.n @ [-0.44, 0.23, -2.6], abs=1e-15)
    with pytest.raises(ShapeError, match=r"length 1, got one off by 2\.5e-07"):
        Plane(np.array([0.999918, 0.010683, -0.007026]), 0.0, np.zeros(3), np.eye(3)[1:])


def test_a_moved_plane_and_line_keep_their_invariants() -> None:
    plane = Plane.of([1.0, 2.0, -1.0], [0.3, 0.1, 0.9])
    moved = plane.moved(T_A_B)
    on = se3.inv(T_A_B)[:3, :3] @ (moved.n * moved.d - T_A_B[:3, 3])
    assert np.linalg.norm(moved.n) == pytest.approx(1.0, abs=1e-15)
    assert plane.n @ on == pytest.approx(plane.d, abs=1e-14)
    line = Line.of([1.0, 2.0, -1.0], [0.3, 0.1, 0.9]).moved(T_A_B)
    assert np.linalg.norm(line.v) == pytest.approx(1.0, abs=1e-15)
    assert line.r @ line.v == pytest.approx(0.0, abs=1e-14)
    there = T_A_B[:3, :3] @ [0.3, 0.1, 0.9] + T_A_B[:3, 3]
    np.testing.assert_allclose(np.cross(line.v, there - line.r), 0.0, atol=1e-14)
    back = line.moved(se3.inv(T_A_B))
    np.testing.assert_allclose(back.centroid, [0.3, 0.1, 0.9], rtol=0, atol=1e-14)


def test_minus_turns_a_feature_round() -> None:
    plane = Plane(np.array([0.0, 0.0, 1.0]), 2.0, np.array([1.0, 0.0, 2.0]), np.eye(3)[:2], COV)
    other = -plane
    assert (other.n.tolist(), other.d, other.centroid.tolist()) == ([0.0, 0.0, -1.0], -2.0, [1.0, 0.0, 2.0])
    assert plane.distance([[0, 0, 3.0]])[0] == -other.distance([[0, 0, 3.0]])[0] == 1.0
    line = Line.of([0.0, 1.0, 0.0], [1.0, 5.0, 0.0])
    reverse = -line
    np.testing.assert_array_equal(reverse.v, -line.v)
    np.testing.assert_array_equal(reverse.r, line.r)
    assert np.linalg.det(np.vstack([reverse.axes, reverse.v])) == pytest.approx(1.0)
    assert np.linalg.det(np.vstack([line.axes, line.v])) == pytest.approx(1.0)
    np.testing.assert_array_equal((-other).cov, plane.cov)


def test_distance_and_offset() -> None:
    line = Line.of([0.0, 0.0, 2.0], [1.0, 0.0, 7.0])
    np.testing.assert_allclose(line.offset([[1.0, 3.0, -4.0]]), [[0.0, 3.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(line.r, [1.0, 0.0, 0.0], atol=1e-15)


def test_circle_and_sphere() -> None:
    circle = Circle(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]), 0.5, np.eye(3)[:2], np.diag([1.0] * 6) * 1e-8)
    assert circle.plane.d == 3.0
    np.testing.assert_allclose(circle.plane.cov, np.eye(3) * 1e-8, atol=1e-20)
    with pytest.raises(ShapeError, match="radius of a sphere"):
        Sphere(np.zeros(3), -1.0)
    with pytest.raises(ShapeError, match="radius of a circle"):
        Circle(np.zeros(3), np.eye(3)[2], 0.0, np.eye(3)[:2])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Plane.of([0, 0, 0], [1, 1, 1]), "length zero"),
        (lambda: Plane.of([0, 0, np.nan], [1, 1, 1]), "finite vector"),
        (lambda: Plane.of("up", [1, 1, 1]), "real numbers"),
        (lambda: Plane(np.eye(3)[2], 1.0, np.zeros(3), np.eye(3)[:2]), "centroid in the plane"),
        (lambda: Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[1:]), "unit vectors"),
        (lambda: Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[:2], -COV), "not negative"),
        (lambda: Line(np.eye(3)[2], np.array([1.0, 0, 1]), np.zeros(3), np.eye(3)[:2]), "foot of a line"),
        (lambda: Line.of([1, 0], [1, 1, 1]), r"vector \(3,\)"),
        (lambda: Plane.of([0, 0, 1], [1, 1, 1]).moved(np.diag([1.0, 1, -1, 1])), "pose"),
        (lambda: Plane.of([0, 0, 1], [1, 1, 1]).distance(np.zeros((3, 5))), "Transpose"),
    ],
)
def test_what_does_not_fit_is_refused(make, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        make()


@pytest.mark.parametrize(
    "value",
    [
        Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[:2], COV),
        Line.of([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]),
        Circle(np.ones(3), np.eye(3)[2], 0.5, np.eye(3)[:2]),
        Sphere(np.ones(3), 0.5, np.eye(4) * 1e-8),
    ],
)
def test_files_are_exact(value, tmp_path) -> None:
    again = models.load(models.save(value, tmp_path / "feature.toml"))
    assert type(again) is type(value)
    for name in value.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(value, name))
    assert not again.axes.flags.writeable if hasattr(again, "axes") else not again.centre.flags.writeable

"""Features as values; frames, projections and intersections made from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from armlab import models
from armlab.errors import ArmlabError, FrameError, ShapeError
from armlab.frames import Graph, Line, Plane, build, distance, fit_line, fit_plane, intersect, project
from armlab.frames.construction import BuiltFrame
from armlab.frames.features import Circle, Sphere
from armlab.lie import se3, so3

T_A_B = se3.from_rp(so3.exp([0.3, -1.2, 0.7]), [0.4, -2.0, 1.5])
COV = np.diag([1e-6, 4e-6, 1e-8])
LINE = replace(Line.of([0.1, 0.2, 1.0], [0.3, 0.1, 0.9]), cov=np.diag([1e-3, 3e-3, 1e-4, 1e-4]) ** 2)
PLANE = replace(Plane.of([0.3, 1.0, 0.1], [0.3, 0.1, 0.9]), cov=np.diag([2e-3, 1e-3, 1e-4]) ** 2)
RNG = np.random.default_rng(3)
LINE_COV = np.diag([1e-3, 2e-3, 1e-4, 3e-4]) ** 2
PLANE_COV = np.diag([2e-3, 1e-3, 2e-4]) ** 2
FLOOR = replace(Plane.of([0.2, -0.1, 1.0], [0.3, 0.2, 0.9]), cov=PLANE_COV)
OTHER = replace(Plane.of([1.0, 0.4, 0.2], [0.7, -0.2, 0.6]), cov=2.0 * PLANE_COV)
RAY = replace(Line.of([1.0, 0.4, 0.3], [0.1, -0.2, 0.5]), cov=LINE_COV)


def test_plane_of_a_normal_that_is_not_unit() -> None:
    """Tracker files have six decimals, so the length is normalised to 1, not assumed to be 1."""
    plane = Plane.of([0.999918, 0.010683, -0.007026], [-0.44, 0.23, -2.6])
    assert np.linalg.norm(plane.n) == pytest.approx(1.0, abs=1e-15)
    assert plane.d == pytest.approx(plane.n @ [-0.44, 0.23, -2.6], abs=1e-15)
    with pytest.raises(ShapeError, match=r"length 1, got a length error of 2\.5e-07"):
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


def test_the_plane_of_a_circle() -> None:
    circle = Circle(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]), 0.5, np.eye(3)[:2], np.diag([1.0] * 6) * 1e-8)
    assert circle.plane.d == 3.0
    np.testing.assert_allclose(circle.plane.cov, np.eye(3) * 1e-8, atol=1e-20)


@pytest.mark.parametrize("value", [
    Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[:2], COV),
    Line.of([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]),
    Circle(np.ones(3), np.eye(3)[2], 0.5, np.eye(3)[:2]),
    Sphere(np.ones(3), 0.5, np.eye(4) * 1e-8),
])  # fmt: skip
def test_files_are_exact(value, tmp_path) -> None:
    again = models.load(models.save(value, tmp_path / "feature.toml"))
    assert type(again) is type(value)
    for name in value.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(value, name))
    assert not again.axes.flags.writeable if hasattr(again, "axes") else not again.centre.flags.writeable


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


def shifted(item: Line | Plane, e: np.ndarray) -> Line | Plane:
    R = so3.exp(e[0] * item.axes[0] + e[1] * item.axes[1])
    if isinstance(item, Line):
        return Line.of(R @ item.v, item.centroid + e[2:] @ item.axes)
    return Plane.of(R @ item.n, item.centroid + e[2] * item.n)


def propagated(make: Callable, items: tuple, error: Callable) -> np.ndarray:
    columns, variances = [], []
    for which, item in enumerate(items):
        for k, step in enumerate(1e-6 * np.eye(len(item.names))):
            up, down = ((*items[:which], shifted(item, e), *items[which + 1 :]) for e in (step, -step))
            columns.append((error(make(*up)) - error(make(*down))) / 2e-6)
            variances.append(item.cov[k, k])
    J = np.stack(columns, axis=1)
    return J * variances @ J.T


@pytest.mark.parametrize(("one", "two"), [("z", "y"), ("y", "x"), ("x", "z")])
def test_the_covariance_is_that_of_central_differences(one: str, two: str) -> None:
    origin_cov = np.diag([1.0, 2.0, 3.0]) * 1e-8

    def make(line: Line, plane: Plane) -> BuiltFrame:
        return build(**{one: line, two: -plane}, origin=[1.0, 2.0, 3.0], origin_cov=origin_cov)

    found = make(LINE, PLANE)
    expected = propagated(make, (LINE, PLANE), lambda there: so3.log(found.T[:3, :3].T @ there.T[:3, :3]))
    np.testing.assert_allclose(found.cov[3:, 3:], expected, rtol=1e-6, atol=1e-14)
    np.testing.assert_array_equal(found.cov[:3, :3], origin_cov)
    np.testing.assert_array_equal(found.cov[:3, 3:], 0.0)


def test_the_origin_of_a_sphere_or_circle() -> None:
    ball = Sphere(np.array([1.0, 2, 3]), 0.1, np.diag([1.0, 2, 3, 4]) * 1e-8)
    found = build(x=[1.0, 0, 0], y=[0, 1.0, 0], origin=ball)
    np.testing.assert_allclose(np.diag(found.cov), [1e-8, 2e-8, 3e-8, 0, 0, 0], rtol=1e-15)
    hole = Circle(np.array([1.0, 2, 3]), np.eye(3)[2], 0.1, np.eye(3)[:2])
    np.testing.assert_array_equal(build(z=hole, x=[1.0, 0, 1.0], origin=hole).T[:3, 3], [1, 2, 3])


@pytest.mark.parametrize(("call", "error", "sentence"), [
    (lambda: build(z=LINE, origin=[0, 0, 0]), ShapeError, "exactly two"),
    (lambda: build(x=LINE, y=PLANE, z=LINE, origin=[0, 0, 0]), ShapeError, "exactly two"),
    (lambda: build(z=LINE, w=PLANE, origin=[0, 0, 0]), FrameError, "'w'"),
    (lambda: build(z=LINE, xy=PLANE, origin=[0, 0, 0]), FrameError, "'xy'"),
    (lambda: build(z=LINE, y=[0.1, 0.2, 1.0], origin=[0, 0, 0]), ShapeError, "non-parallel"),
    (lambda: build(z=LINE, y=-LINE, origin=[0, 0, 0]), ShapeError, "non-parallel"),
    (lambda: build(z=LINE, y=PLANE, origin=[0, 0]), ShapeError, "origin"),
    (lambda: build(z=LINE, y=[0, 0, 0], origin=[0, 0, 0]), ShapeError, "length zero"),
    (lambda: build(z=fit_line(np.outer(np.arange(5.0), [1, 2, 3])), y=PLANE, origin=[0, 0, 0]), ShapeError, "Fit"),
    (lambda: build(z=LINE, y=PLANE, origin=Sphere([1, 1, 1], 1.0), origin_cov=np.eye(3)), ShapeError, "own covariance"),
    (lambda: project(RAY, RAY), ShapeError, "Project points on the line"),
    (lambda: project(np.zeros((2, 4)), FLOOR), ShapeError, "points"),
    (lambda: project([np.nan, 0, 0], FLOOR), ShapeError, "missing"),
    (lambda: project([0, 0, 0], "plane"), ShapeError, "If this is a fit, pass its value"),
    (lambda: project(Line.of(FLOOR.n, [0, 0, 0]), FLOOR), ShapeError, "got a normal line"),
    (lambda: intersect(RAY, RAY), ShapeError, "distance"),
    (lambda: intersect(FLOOR, Line.of(FLOOR.axes[0], [0, 0, 0])), ShapeError, "got a parallel line"),
    (lambda: intersect(FLOOR, -FLOOR), ShapeError, "parallel planes"),
    (lambda: distance(RAY, FLOOR), ShapeError, "two lines"),
    (lambda: Plane.of([0, 0, 0], [1, 1, 1]), ShapeError, "length zero"),
    (lambda: Plane.of([0, 0, np.nan], [1, 1, 1]), ShapeError, "finite vector"),
    (lambda: Plane.of("up", [1, 1, 1]), ShapeError, "real numbers"),
    (lambda: Plane(np.eye(3)[2], 1.0, np.zeros(3), np.eye(3)[:2]), ShapeError, "centroid in the plane"),
    (lambda: Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[1:]), ShapeError, "unit vectors"),
    (lambda: Plane(np.eye(3)[2], 0.0, np.zeros(3), np.eye(3)[:2], -COV), ShapeError, "positive semidefinite"),
    (lambda: Line(np.eye(3)[2], np.array([1.0, 0, 1]), np.zeros(3), np.eye(3)[:2]), ShapeError, "foot of a line"),
    (lambda: Line.of([1, 0], [1, 1, 1]), ShapeError, r"vector \(3,\)"),
    (lambda: Plane.of([0, 0, 1], [1, 1, 1]).moved(np.diag([1.0, 1, -1, 1])), ShapeError, "pose"),
    (lambda: Plane.of([0, 0, 1], [1, 1, 1]).distance(np.zeros((3, 5))), ShapeError, "Transpose"),
    (lambda: Sphere(np.zeros(3), -1.0), ShapeError, "radius of a sphere"),
    (lambda: Circle(np.zeros(3), np.eye(3)[2], 0.0, np.eye(3)[:2]), ShapeError, "radius of a circle"),
])  # fmt: skip
def test_bad_input_is_refused(call: Callable, error: type[ArmlabError], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call()


def test_points_on_a_plane_and_on_a_line() -> None:
    p = RNG.standard_normal((4, 5, 3))
    q = project(p, FLOOR)
    np.testing.assert_allclose(q @ FLOOR.n, FLOOR.d, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.cross(p - q, FLOOR.n), 0.0, atol=1e-15)
    np.testing.assert_allclose(q, p - (p @ FLOOR.n - FLOOR.d)[..., None] * FLOOR.n, atol=1e-15)
    r = project(p, RAY)
    np.testing.assert_allclose((p - r) @ RAY.v, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.cross(r - RAY.r, RAY.v), 0.0, atol=1e-15)
    assert project([1.0, 2.0, 3.0], FLOOR).shape == (3,)


def test_a_line_on_a_plane_is_the_line_of_its_points() -> None:
    shadow = project(RAY, FLOOR)
    on = project(RAY.centroid + np.outer([-1.0, 2.0], RAY.v), FLOOR)
    np.testing.assert_allclose(shadow.offset(on), 0.0, atol=1e-15)
    assert shadow.v @ (on[1] - on[0]) > 0
    assert shadow.v @ FLOOR.n == pytest.approx(0.0, abs=1e-16)
    nearly = Line.of(FLOOR.n + 1e-7 * FLOOR.axes[0], [0, 0, 0])
    np.testing.assert_allclose(project(nearly, FLOOR).v, FLOOR.axes[0], atol=1e-8)


def test_intersections() -> None:
    point = intersect(FLOOR, RAY)
    assert FLOOR.distance([point])[0] == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose(RAY.offset([point]), 0.0, atol=1e-15)
    np.testing.assert_array_equal(point, intersect(RAY, FLOOR))
    edge = intersect(FLOOR, OTHER)
    for plane in (FLOOR, OTHER):
        np.testing.assert_allclose(plane.distance(edge.centroid + np.outer([-3.0, 0, 5.0], edge.v)), 0.0, atol=1e-14)
    assert edge.v @ np.cross(FLOOR.n, OTHER.n) > 0
    assert edge.v @ (edge.centroid - FLOOR.centroid) == pytest.approx(0.0, abs=1e-15)


def test_distance_of_lines() -> None:
    z = Line.of([0, 0, 1.0], [0, 0, 5.0])
    for v, point, expected in (([1, 0, 0], [7, 2, 0], 2.0), ([0, 0, -1], [3, 4, 0], 5.0), ([1, 1, 1], [0, 0, 3], 0.0)):
        assert distance(z, Line.of(v, point)) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(
    ("make", "items"), [(project, (RAY, FLOOR)), (intersect, (FLOOR, OTHER))], ids=["shadow", "edge"]
)
def test_errors_go_through(make: Callable, items: tuple) -> None:
    plain = make(*items)

    def error(found: Line) -> np.ndarray:
        away = found.centroid - plain.centroid
        away -= found.v * (plain.v @ away) / (plain.v @ found.v)  # where the line passes the old centroid
        return np.concatenate([plain.axes @ np.cross(plain.v, found.v), plain.axes @ away])

    np.testing.assert_allclose(plain.cov, propagated(make, items, error), rtol=1e-6, atol=1e-15)


def test_what_is_exact_stays_exact() -> None:
    assert project(replace(RAY, cov=None), replace(FLOOR, cov=None)).cov is None
    half = project(RAY, replace(FLOOR, cov=None))
    assert half.cov is not None
    assert np.all(np.linalg.eigvalsh(project(RAY, FLOOR).cov - half.cov) > -1e-18)


def test_products_check_their_inner_names() -> None:
    """The ancestor silently multiplied the frame of a camera in a base by that of a tool in a flange."""
    graph = Graph()
    graph.add("base", "cam", np.eye(4))
    graph.add("flange", "tool", np.eye(4))
    with pytest.raises(FrameError, match="'base' and 'tool'"):
        graph.get("base", "tool")
    graph.add("cam", "flange", np.eye(4))
    with pytest.raises(FrameError, match="'base' and 'flange'"):
        graph.get("base", "tool", via=["flange"])


def test_perpendicular_and_divisions_have_counterparts_that_run() -> None:
    """The ancestor's ⊥ used a name that did not exist; \\ and / called a constructor that was not there."""
    up, front = Plane.of([0, 0, 1], [0, 0, 0]), Plane.of([1, 0, 0], [0, 0, 0])
    assert build(z=up, x=front, origin=[0, 0, 0]).deviation == pytest.approx(0.0, abs=1e-15)
    assert abs(intersect(up, front).v[1]) == 1.0
    graph = Graph()
    graph.add("base", "cam", se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1, 2, 3]))
    graph.add("base", "tool", se3.from_rp(so3.exp([0.3, 0.2, 0.1]), [3, 2, 1]))
    np.testing.assert_allclose(graph.get("cam", "tool") @ graph.get("tool", "cam"), np.eye(4), atol=1e-15)


def test_directions_are_unit_after_every_step() -> None:
    """The ancestor's normalize! changed a copy."""
    T_a_b = se3.from_rp(so3.exp([1.0, -0.4, 0.2]), [3, 2, 1])
    plane, line = Plane.of([3, 4, 5], [1, 1, 1]), Line.of([3, 4, 5], [1, 1, 1])
    for _ in range(100):
        plane, line = plane.moved(T_a_b), line.moved(T_a_b)
    assert np.linalg.norm(plane.n) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.norm(line.v) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("away", [1.0, 1e3, 1e6])
def test_good_data_far_from_the_origin_pass(away: float) -> None:
    """The ancestor asserted equality to 1e-14, which rounding at a hundred metres does not allow."""
    rng = np.random.default_rng(1)
    p = away * np.array([1.0, -2.0, 3.0]) + rng.uniform(-1, 1, (20, 3)) * [1.0, 0.7, 1e-4]
    plane = fit_plane(p).value
    line = fit_line(p * [1, 0, 0] + away * np.array([0, 1.0, 1.0])).value
    moved = build(z=line, y=plane, origin=p[0]).T
    assert se3.is_pose(moved)
    back = plane.moved(moved).moved(se3.inv(moved))
    np.testing.assert_allclose(back.n, plane.n, atol=1e-12)

"""Defects of the ancestor's frames that must not return, one test for each (calibration, section 7)."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import FrameError
from armlab.frames import Graph, Line, Plane, build, fit_line, fit_plane, intersect, project
from armlab.lie import se3, so3


def test_products_check_their_inner_names() -> None:
    """It multiplied the frame of a camera in a base by that of a tool in a flange without a word."""
    graph = Graph()
    graph.add("base", "cam", np.eye(4))
    graph.add("flange", "tool", np.eye(4))
    with pytest.raises(FrameError, match="'base' and 'tool'"):
        graph.get("base", "tool")
    graph.add("cam", "flange", np.eye(4))
    with pytest.raises(FrameError, match="'base' and 'flange'"):
        graph.get("base", "tool", via=["flange"])


def test_a_line_on_a_plane_can_be_projected() -> None:
    """It built a list of rows and failed."""
    plane = Plane.of([0, 0, 1], [0, 0, 1])
    assert project(Line.of([1, 0, 1], [0, 0, 5]), plane).v.tolist() == [1.0, 0.0, 0.0]


def test_perpendicular_and_divisions_have_counterparts_that_run() -> None:
    """Its ⊥ used a name that did not exist; \\ and / called a constructor that was not there."""
    up, front = Plane.of([0, 0, 1], [0, 0, 0]), Plane.of([1, 0, 0], [0, 0, 0])
    assert build(z=up, x=front, origin=[0, 0, 0]).deviation == pytest.approx(0.0, abs=1e-15)
    assert abs(intersect(up, front).v[1]) == 1.0
    graph = Graph()
    graph.add("base", "cam", se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1, 2, 3]))
    graph.add("base", "tool", se3.from_rp(so3.exp([0.3, 0.2, 0.1]), [3, 2, 1]))
    np.testing.assert_allclose(graph.get("cam", "tool") @ graph.get("tool", "cam"), np.eye(4), atol=1e-15)


def test_directions_are_unit_after_every_step() -> None:
    """Its normalize! changed a copy."""
    T_a_b = se3.from_rp(so3.exp([1.0, -0.4, 0.2]), [3, 2, 1])
    plane, line = Plane.of([3, 4, 5], [1, 1, 1]), Line.of([3, 4, 5], [1, 1, 1])
    for _ in range(1000):
        plane, line = plane.moved(T_a_b), line.moved(T_a_b)
    assert np.linalg.norm(plane.n) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.norm(line.v) == pytest.approx(1.0, abs=1e-14)


def test_no_sign_of_a_decomposition_is_returned(cube: list[np.ndarray]) -> None:
    """The same points in other axes had the opposite normal."""
    p = np.random.default_rng(0).uniform(-1, 1, (9, 3)) * [1.0, 0.5, 1e-4] + [0, 0, 3.0]
    assert {round(float(fit_plane(p @ R.T).value.n @ R[:, 2]), 6) for R in cube} == {1.0}
    q = np.sort(p[:, :1], axis=0) * [1.0, 0, 0] + [0, 1e-4, 3.0]
    assert {round(float(fit_line(q @ R.T, noise=1e-6).value.v @ R[:, 0]), 6) for R in cube} == {1.0}


@pytest.mark.parametrize("away", [1.0, 1e3, 1e6])
def test_good_data_far_from_the_origin_pass(away: float) -> None:
    """It asserted equality to 1e-14, which no rounding at a hundred metres keeps."""
    rng = np.random.default_rng(1)
    p = away * np.array([1.0, -2.0, 3.0]) + rng.uniform(-1, 1, (20, 3)) * [1.0, 0.7, 1e-4]
    plane = fit_plane(p).value
    line = fit_line(p * [1, 0, 0] + away * np.array([0, 1.0, 1.0])).value
    moved = build(z=line, y=plane, origin=p[0]).T
    assert se3.is_pose(moved)
    back = plane.moved(moved).moved(se3.inv(moved))
    np.testing.assert_allclose(back.n, plane.n, atol=1e-12)


def test_no_list_keeps_the_frames_of_everybody() -> None:
    """One global set knew every name that was ever used, and refused the same name twice."""
    for _ in range(2):
        graph = Graph()
        graph.add("base", "cam", np.eye(4))
        assert graph.names == ("base", "cam")


def test_a_normal_of_six_decimals_is_made_unit() -> None:
    """It used (0.999918, 0.010683, -0.007026), 2.5e-7 too short, as it was: 0.7 micrometres at 2.7 m."""
    plane = Plane.of([0.999918, 0.010683, -0.007026], [-0.447610821, 0.239195030, -2.653884552])
    assert np.linalg.norm(plane.n) == pytest.approx(1.0, abs=1e-15)

"""A graph of frames: composition by name, loops that close or not, the most likely poses."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import FrameError, ShapeError
from armlab.frames import Graph
from armlab.lie import se3, so3

COV = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
NAMES = ("base", "flange", "tool", "cam", "marker")


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.from_rp(so3.exp(rng.standard_normal(3)), rng.standard_normal(3))


POSES = {name: pose(k) if k else np.eye(4) for k, name in enumerate(NAMES)}  # in base


def between(a: str, b: str) -> np.ndarray:
    return se3.inv(POSES[a]) @ POSES[b]


def ring(*extra: tuple[str, str], cov: np.ndarray | None = COV) -> Graph:
    graph = Graph()
    for a, b in (("base", "flange"), ("flange", "tool"), ("cam", "tool"), ("cam", "base"), *extra):
        graph.add(a, b, between(a, b), cov, source="drawing")
    return graph


def test_inverse_and_chain_are_automatic() -> None:
    graph = ring(("cam", "marker"))
    assert graph.names == ("base", "flange", "tool", "cam", "marker")
    assert len(graph.edges) == 5
    for a in NAMES:
        for b in NAMES:
            np.testing.assert_allclose(graph.get(a, b), between(a, b), atol=1e-14)


def test_via_composes_only_what_is_joined() -> None:
    graph = ring()
    np.testing.assert_allclose(graph.get("base", "tool", via=["cam"]), between("base", "tool"), atol=1e-14)
    with pytest.raises(FrameError, match=r"between 'flange' and 'cam', got none\. Joined to 'flange': base, tool"):
        graph.get("base", "cam", via=["flange"])


def test_the_earliest_of_several_poses_is_taken() -> None:
    graph = Graph()
    graph.add("base", "cam", pose(1))
    graph.add("cam", "base", se3.inv(pose(2)))
    np.testing.assert_array_equal(graph.get("base", "cam"), pose(1))


def test_graphs_know_nothing_of_each_other() -> None:
    ring()
    assert Graph().names == ()


def test_unknown_and_unjoined_frames_are_named() -> None:
    graph = ring()
    with pytest.raises(FrameError, match=r"'camera'\. Known: base, flange, tool, cam"):
        graph.get("base", "camera")
    graph.add("world", "table", np.eye(4))
    with pytest.raises(FrameError, match="join 'base' and 'table'"):
        graph.get("base", "table")
    with pytest.raises(FrameError, match="join 'base' and 'world'"):
        graph.solve()


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        (("base", "base", np.eye(4)), FrameError, "twice"),
        (("base", "my_cam", np.eye(4)), FrameError, "underscore"),
        (("base", 3, np.eye(4)), FrameError, "letters"),
        (("base", "cam", np.eye(3)), ShapeError, "T_base_cam"),
        (("base", "cam", np.diag([1.0, 1, -1, 1])), ShapeError, "T_base_cam"),
        (("base", "cam", np.eye(4), np.eye(3)), ShapeError, "covariance of T_base_cam"),
        (("base", "cam", np.eye(4), -np.eye(6)), ShapeError, "not negative"),
    ],
)
def test_bad_input_is_refused(arguments: tuple, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        Graph().add(*arguments)


def test_a_millimetre_in_one_of_four_poses_is_reported_with_it() -> None:
    graph = ring()
    assert graph.check().passed
    bad = Graph()
    for k, edge in enumerate(graph.edges):
        T = edge.T.copy()
        T[0, 3] += 1e-3 * (k == 2)
        bad.add(edge.a, edge.b, T, edge.cov / 100, edge.source)
    (loop,) = bad.check().loops
    assert loop.beyond
    assert loop.position == pytest.approx(1e-3, rel=1e-9)
    assert "cam to tool (drawing)" in loop.text()
    assert 2 in loop.edges
    assert not bad.check().passed


def test_solve_spreads_the_error_and_finds_the_wrong_pose() -> None:
    graph = ring(("base", "tool"), ("flange", "cam"), ("cam", "marker"), ("tool", "marker"))
    wrong = Graph()
    for k, edge in enumerate(graph.edges):
        T = edge.T.copy()
        T[0, 3] += 0.02 * (k == 4)
        wrong.add(edge.a, edge.b, T, edge.cov, edge.source)
    fit = wrong.solve(robust=True)
    assert np.flatnonzero(fit.outliers).tolist() == [4]
    assert "left out: base to tool (drawing)" in fit.report()
    np.testing.assert_allclose(fit.value.get("cam", "tool"), between("cam", "tool"), atol=1e-9)

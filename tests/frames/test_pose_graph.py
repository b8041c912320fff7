"""Pose graphs: paths, loops, and the most likely poses."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import models
from armlab.errors import FrameError, NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, check_estimator
from armlab.frames import Graph
from armlab.frames.pose_graph import Edge, FrameSet, Loop, LoopCheck, check_loops, solve_poses
from armlab.lie import se3, so3

COV = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
NAMES = ("base", "flange", "tool", "cam", "marker")
UNEVEN = np.diag([2e-4, 1e-4, 3e-4, 1e-3, 2e-3, 1e-3]) ** 2
NAMES_SOLVED = ("a", "b", "c", "d")
PAIRS = (("a", "b"), ("b", "c"), ("d", "c"), ("a", "d"), ("a", "c"), ("d", "b"))
T = np.stack([se3.exp(np.random.default_rng(k).standard_normal(6)) if k else np.eye(4) for k in range(4)])


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


def spoilt(graph: Graph, which: int, shift: float, times: float = 1.0) -> Graph:
    bad = Graph()
    for k, edge in enumerate(graph.edges):
        T = edge.T.copy()
        T[0, 3] += shift * (k == which)
        bad.add(edge.a, edge.b, T, edge.cov * times, edge.source)
    return bad


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
    words = r"between 'flange' and 'cam', but there is no direct pose\. Poses of 'flange': base, tool"
    with pytest.raises(FrameError, match=words):
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
    with pytest.raises(FrameError, match="connect 'base' and 'table'"):
        graph.get("base", "table")
    with pytest.raises(FrameError, match="connect 'base' and 'world'"):
        graph.solve()


@pytest.mark.parametrize(("arguments", "error", "sentence"), [
    (("base", "base", np.eye(4)), FrameError, "twice"),
    (("base", "my_cam", np.eye(4)), FrameError, "underscore"),
    (("base", 3, np.eye(4)), FrameError, "letters"),
    (("base", "cam", np.eye(3)), ShapeError, "T_base_cam"),
    (("base", "cam", np.diag([1.0, 1, -1, 1])), ShapeError, "T_base_cam"),
    (("base", "cam", np.eye(4), np.eye(3)), ShapeError, "covariance of T_base_cam"),
    (("base", "cam", np.eye(4), -np.eye(6)), ShapeError, "positive semidefinite"),
])  # fmt: skip
def test_bad_input_is_refused(arguments: tuple, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        Graph().add(*arguments)


def test_a_millimetre_in_one_of_four_poses_is_reported_with_it() -> None:
    graph = ring()
    assert graph.check().passed
    bad = spoilt(graph, 2, 1e-3, 0.01)
    (loop,) = bad.check().loops
    assert loop.beyond
    assert loop.position == pytest.approx(1e-3, rel=1e-9)
    assert "cam to tool (drawing)" in loop.text()
    assert 2 in loop.edges
    assert not bad.check().passed


def test_solve_spreads_the_error_and_finds_the_wrong_pose() -> None:
    graph = ring(("base", "tool"), ("flange", "cam"), ("cam", "marker"), ("tool", "marker"))
    fit = spoilt(graph, 4, 0.02).solve(robust=True)
    assert np.flatnonzero(fit.outliers).tolist() == [4]
    assert "excluded: base to tool (drawing)" in fit.report()
    np.testing.assert_allclose(fit.value.get("cam", "tool"), between("cam", "tool"), atol=1e-9)


def noisy(T: np.ndarray, e: np.ndarray) -> np.ndarray:
    return se3.from_rp(T[:3, :3] @ so3.exp(e[3:]), T[:3, 3] + e[:3])


def loop_of(rng: np.random.Generator, scale: float = 1.0) -> list[Edge]:
    T = {name: pose(k) for k, name in enumerate(NAMES_SOLVED)}
    edges = []
    for a, b in (("a", "b"), ("c", "b"), ("c", "d"), ("d", "a")):
        e = scale * np.linalg.cholesky(UNEVEN) @ rng.standard_normal(6)
        edges.append(Edge(a, b, noisy(se3.inv(T[a]) @ T[b], e), UNEVEN, f"{a}{b}"))
    return edges


def test_closure_errors_are_as_large_as_the_covariances_say() -> None:
    """The mean of chi2 is 6; its 99.9 % quantile is exceeded once in a thousand."""
    found = [check_loops(loop_of(np.random.default_rng(seed))) for seed in range(150)]
    assert isinstance(found[0], LoopCheck)
    assert isinstance(found[0].loops[0], Loop)
    chi2 = np.array([one.loops[0].chi2 for one in found])
    assert abs(chi2.mean() - 6.0) < 3 * np.sqrt(12 / 150)
    assert sum(not one.passed for one in found) <= 3
    assert not check_loops(loop_of(np.random.default_rng(1), scale=5.0)).passed


def test_the_number_of_independent_loops() -> None:
    edges = [*loop_of(np.random.default_rng(0)), Edge("a", "c", se3.inv(pose(0)) @ pose(2)), Edge("x", "y", pose(9))]
    loops = check_loops(edges).loops
    assert len(loops) == len(edges) - (6 - 2)
    assert loops[1].frames[0] == "a"
    assert np.isnan(loops[1].chi2), "a covariance is not known"
    assert not loops[1].beyond
    assert "mm" in check_loops(edges).text()
    assert "nothing to check" in check_loops(edges[:3]).text()


def test_two_poses_between_two_frames_are_a_loop() -> None:
    T = pose(3)
    moved = T.copy()
    moved[2, 3] += 0.004
    (loop,) = check_loops([Edge("a", "b", T), Edge("b", "a", se3.inv(moved))]).loops
    assert loop.position == pytest.approx(0.004, rel=1e-9)
    assert loop.angle == pytest.approx(0.0, abs=1e-12)


def test_chi2_is_that_of_the_closure_for_errors_that_differ_along_every_axis() -> None:
    rng = np.random.default_rng(3)
    exact = loop_of(rng, 0.0)
    covs = [1e-8 * (L @ L.T) for L in rng.standard_normal((4, 6, 6)) * [10.0, 1.0, 0.1, 1.0, 10.0, 3.0]]
    errors = [1e-6 * rng.standard_normal(6) for _ in exact]

    def closure(errors: list[np.ndarray]) -> np.ndarray:
        ab, cb, cd, da = (noisy(edge.T, e) for edge, e in zip(exact, errors))
        T = da @ ab @ se3.inv(cb) @ cd
        return np.concatenate([T[:3, 3], so3.log(T[:3, :3])])

    C = np.zeros((6, 6))
    for k, cov in enumerate(covs):
        steps = [[step * (i == k) for i in range(4)] for step in np.eye(6) * 1e-6]
        J = np.stack([(closure(s) - closure([-e for e in s])) / 2e-6 for s in steps], axis=1)
        C += J @ cov @ J.T
    e = closure(errors)
    edges = [Edge(one.a, one.b, noisy(one.T, x), cov) for one, x, cov in zip(exact, errors, covs)]
    (loop,) = check_loops(edges).loops
    assert loop.chi2 == pytest.approx(e @ np.linalg.solve(C, e), rel=1e-4)


def measured(rng: np.random.Generator | None, times: int = 1) -> list[Edge]:
    edges = []
    for a, b in PAIRS * times:
        true = se3.inv(T[NAMES_SOLVED.index(a)]) @ T[NAMES_SOLVED.index(b)]
        e = np.zeros(6) if rng is None else np.sqrt(np.diag(UNEVEN)) * rng.standard_normal(6)
        edges.append(Edge(a, b, noisy(true, e), UNEVEN))
    return edges


def error(fit: Fit, truth: np.ndarray) -> np.ndarray:
    v = fit.value.T[1:, :3, 3] - truth[1:, :3, 3]
    w = so3.log(np.swapaxes(truth[1:, :3, :3], 1, 2) @ fit.value.T[1:, :3, :3])
    return np.hstack([v, w]).ravel()


def test_the_covariance_is_honest(tmp_path) -> None:
    def experiment(seed: int, n: int) -> Experiment:
        return Experiment({"edges": measured(np.random.default_rng(seed), n), "names": NAMES_SOLVED}, T)

    skip = {
        "efficient": "the bound is the covariance, to first order", "order-free": "poses are not rows of an array",
        "gauge-free": "the first frame is the gauge", "refuses": "tested below", "robust": "tested with the graph",
        "clean": "NaN cannot be in a pose; the rest is tested below",
    }  # fmt: skip
    contract = check_estimator(solve_poses, experiment, 40, n=1, error=error, skip=skip)
    assert contract.passed, contract.text()
    fit = solve_poses(measured(None), NAMES_SOLVED)
    np.testing.assert_allclose(fit.value.T, T, rtol=0, atol=1e-12)
    assert fit.names[:6] == ("b x", "b y", "b z", "b turn x", "b turn y", "b turn z")
    np.testing.assert_allclose(fit.value.get("c", "b"), se3.inv(T[2]) @ T[1], atol=1e-12)
    with pytest.raises(FrameError, match="Known: a, b, c, d"):
        fit.value.get("a", "e")
    assert not fit.value.T.flags.writeable
    assert isinstance(models.load(models.save(fit.value, tmp_path / "frames.toml")), FrameSet)


def test_unknown_noise_is_found_by_class() -> None:
    plain = [Edge(e.a, e.b, e.T) for e in measured(np.random.default_rng(3), 40)]
    fit, variances = solve_poses(plain, NAMES_SOLVED), np.diag(UNEVEN).reshape(2, 3)
    np.testing.assert_allclose(fit.sigma**2, variances.mean(axis=1), rtol=0.2)


def test_what_cannot_be_solved_is_refused() -> None:
    with pytest.raises(FrameError, match="empty graph"):
        solve_poses([], ())
    some = measured(None)
    some[2] = Edge("d", "c", some[2].T, None, "drawing")
    with pytest.raises(FrameError, match=r"but d to c \(drawing\) has no covariance"):
        solve_poses(some, NAMES_SOLVED)
    with pytest.raises(NotExcited, match="at least 19 residuals"):
        solve_poses([Edge(e.a, e.b, e.T) for e in measured(None)[:3]], NAMES_SOLVED)

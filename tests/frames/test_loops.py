"""Loops: which ones there are, how they close, and what noise allows."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.frames.pose_graph import Edge, Loop, LoopCheck, check_loops, path, spanning
from armlab.lie import se3, so3

COV = np.diag([2e-4, 1e-4, 3e-4, 1e-3, 2e-3, 1e-3]) ** 2


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.from_rp(so3.exp(rng.standard_normal(3)), rng.standard_normal(3))


def noisy(T: np.ndarray, e: np.ndarray) -> np.ndarray:
    return se3.from_rp(T[:3, :3] @ so3.exp(e[3:]), T[:3, 3] + e[:3])


def loop_of(rng: np.random.Generator, scale: float = 1.0) -> list[Edge]:
    """A loop of four with one pose against its direction."""
    names = ("a", "b", "c", "d")
    T = {name: pose(k) for k, name in enumerate(names)}
    edges = []
    for a, b in (("a", "b"), ("c", "b"), ("c", "d"), ("d", "a")):
        e = scale * np.linalg.cholesky(COV) @ rng.standard_normal(6)
        edges.append(Edge(a, b, noisy(se3.inv(T[a]) @ T[b], e), COV, f"{a}{b}"))
    return edges


def test_path_and_spanning() -> None:
    edges = loop_of(np.random.default_rng(0))
    assert spanning(edges) == [0, 1, 2]
    assert path(edges, "a", "c") in ([(0, 1), (1, -1)], [(3, -1), (2, -1)])
    assert path(edges[:2], "a", "d") is None
    assert path(edges, "a", "a") == []


def test_closure_errors_are_as_large_as_the_covariances_say() -> None:
    """The mean of chi2 is 6, its 99.9 % are passed once in a thousand."""
    found = [check_loops(loop_of(np.random.default_rng(seed))) for seed in range(300)]
    assert isinstance(found[0], LoopCheck)
    assert isinstance(found[0].loops[0], Loop)
    chi2 = np.array([one.loops[0].chi2 for one in found])
    assert abs(chi2.mean() - 6.0) < 3 * np.sqrt(12 / 300)
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
    """The covariance of the closure against differences of the poses, full covariances in their own axes."""
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

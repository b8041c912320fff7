"""The most likely poses of a graph: exact on exact data, honest on noisy data."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import models
from armlab.errors import FrameError, NotExcited
from armlab.estimation import Experiment, Fit, check_estimator
from armlab.frames import FrameSet
from armlab.frames.pose_graph import Edge, solve_poses
from armlab.lie import se3, so3

NAMES = ("a", "b", "c", "d")
PAIRS = (("a", "b"), ("b", "c"), ("d", "c"), ("a", "d"), ("a", "c"), ("d", "b"))
COV = np.diag([2e-4, 1e-4, 3e-4, 1e-3, 2e-3, 1e-3]) ** 2
T = np.stack([se3.exp(np.random.default_rng(k).standard_normal(6)) if k else np.eye(4) for k in range(4)])


def measured(rng: np.random.Generator | None, times: int = 1, cov: np.ndarray | None = COV) -> list[Edge]:
    edges = []
    for a, b in PAIRS * times:
        true = se3.inv(T[NAMES.index(a)]) @ T[NAMES.index(b)]
        e = np.zeros(6) if rng is None else np.sqrt(np.diag(COV)) * rng.standard_normal(6)
        edges.append(Edge(a, b, se3.from_rp(true[:3, :3] @ so3.exp(e[3:]), true[:3, 3] + e[:3]), cov))
    return edges


def error(fit: Fit, truth: np.ndarray) -> np.ndarray:
    """Pose errors [v; w] of all frames but the first."""
    v = fit.value.T[1:, :3, 3] - truth[1:, :3, 3]
    w = so3.log(np.swapaxes(truth[1:, :3, :3], 1, 2) @ fit.value.T[1:, :3, :3])
    return np.hstack([v, w]).ravel()


def test_exact_poses() -> None:
    fit = solve_poses(measured(None), NAMES)
    np.testing.assert_allclose(fit.value.T, T, rtol=0, atol=1e-12)
    assert fit.names[:6] == ("b x", "b y", "b z", "b turn x", "b turn y", "b turn z")


def test_the_covariance_is_honest(tmp_path) -> None:
    def experiment(seed: int, n: int) -> Experiment:
        return Experiment({"edges": measured(np.random.default_rng(seed), n), "names": NAMES}, T)

    contract = check_estimator(
        solve_poses,
        experiment,
        60,
        n=1,
        error=error,
        skip={
            "efficient": "the bound is the covariance, to first order",
            "order-free": "poses are no rows of an array",
            "gauge-free": "the first frame is the gauge",
            "refuses": "tested below",
            "robust": "tested with the graph",
            "clean": "NaN cannot be in a pose; the rest is tested below",
        },
    )
    assert contract.passed, contract.text()
    fit = solve_poses(measured(np.random.default_rng(0)), NAMES)
    assert not fit.value.T.flags.writeable
    assert isinstance(models.load(models.save(fit.value, tmp_path / "frames.toml")), FrameSet)


def test_unknown_noise_is_found_by_class() -> None:
    plain = [Edge(e.a, e.b, e.T) for e in measured(np.random.default_rng(3), 40)]
    fit = solve_poses(plain, NAMES)
    np.testing.assert_allclose(fit.sigma**2, [np.trace(COV[:3, :3]) / 3, np.trace(COV[3:, 3:]) / 3], rtol=0.2)


def test_frame_set_names_what_it_knows() -> None:
    fit = solve_poses(measured(None), NAMES)
    np.testing.assert_allclose(fit.value.get("c", "b"), se3.inv(T[2]) @ T[1], atol=1e-12)
    with pytest.raises(FrameError, match="Known: a, b, c, d"):
        fit.value.get("a", "e")


def test_what_cannot_be_solved_is_refused() -> None:
    with pytest.raises(FrameError, match="got none"):
        solve_poses([], ())
    some = measured(None)
    some[2] = Edge("d", "c", some[2].T, None, "drawing")
    with pytest.raises(FrameError, match=r"got none of d to c \(drawing\)"):
        solve_poses(some, NAMES)
    with pytest.raises(NotExcited, match="numbers"):
        solve_poses([Edge(e.a, e.b, e.T) for e in measured(None)[:3]], NAMES)

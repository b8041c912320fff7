"""Fits of poses: the accuracy of the motion, the laws of its frames, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.estimation import Experiment, Fit, check_estimator
from armlab.lie import quaternion, so3
from armlab.motion import PoseDmp, fit_pose_dmp

Demo = tuple[np.ndarray, np.ndarray]


def off(dmp: PoseDmp, t: np.ndarray, T: np.ndarray) -> tuple[float, float]:
    """Return RMSE of position [m] and angle [rad]."""
    run = dmp.rollout(t)
    angle = so3.log(np.swapaxes(T[:, :3, :3], 1, 2) @ run.T[:, :3, :3])
    return tuple(np.sqrt((e**2).sum(axis=1).mean()) for e in (run.T[:, :3, 3] - T[:, :3, 3], angle))


@pytest.mark.parametrize(
    ("n_basis", "hold", "bar"), [(50, 0.0, (2e-6, 1e-5)), (50, 0.3, (2e-6, 1e-5)), (15, 0.0, (2e-4, 2e-4))]
)
def test_the_motion_is_the_demonstration(
    fine_pose_demo: Demo, n_basis: int, hold: float, bar: tuple[float, float]
) -> None:
    fit = fit_pose_dmp(*fine_pose_demo, n_basis=n_basis, hold=hold)
    position, angle = off(fit.value, *fine_pose_demo)
    assert position < bar[0]
    assert angle < bar[1]
    rmse = np.sqrt((fit.residuals.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    np.testing.assert_allclose(rmse, [position, angle], rtol=1e-3, atol=1e-9)
    assert "rad" in fit.report()


def test_quaternions_of_either_sign_give_the_same(pose_demo: Demo, pose_fit: Fit[PoseDmp]) -> None:
    t, T = pose_demo
    q = quaternion.from_matrix(T[:, :3, :3]) * np.random.default_rng(0).choice([-1.0, 1.0], (len(t), 1))
    again = fit_pose_dmp(t, np.concatenate([T[:, :3, 3], q], axis=1)).value
    np.testing.assert_allclose(again.rollout(t).T, pose_fit.value.rollout(t).T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.goal, pose_fit.value.goal, rtol=0, atol=1e-12)


def test_a_turned_demonstration_gives_a_turned_path(pose_demo: Demo) -> None:
    t, T = pose_demo
    T_a_b = np.eye(4)
    T_a_b[:3, :3], T_a_b[:3, 3] = so3.exp([0.7, -1.9, 0.4]), [0.3, -0.2, 1.0]
    turned = fit_pose_dmp(t, T_a_b @ T, scaling="none").value
    here = fit_pose_dmp(t, T, scaling="none").value
    np.testing.assert_allclose(turned.rollout(t).T, T_a_b @ here.rollout(t).T, rtol=0, atol=1e-9)


def test_a_hold_keeps_the_orientation_at_the_goal(pose_demo: Demo) -> None:
    t, T = (a[::2] for a in pose_demo)
    late = np.linspace(0.0, 1.3, 131)
    left = []
    for hold in (0.0, 0.3):
        R = fit_pose_dmp(t, T, n_basis=15, hold=hold).value.rollout(late).T[100:, :3, :3]
        left.append(np.abs(so3.log(R @ T[-1, :3, :3].T)).max())
    assert left[1] < 5e-4
    assert left[0] > 3 * left[1]


def test_a_shifted_clock_changes_nothing(pose_demo: Demo, pose_fit: Fit[PoseDmp]) -> None:
    t, T = pose_demo
    again = fit_pose_dmp(t + 5.0, T).value
    np.testing.assert_allclose(again.rollout(t).T, pose_fit.value.rollout(t).T, rtol=0, atol=1e-8)


def test_noise_is_found_and_the_motion_is_nearer_than_the_samples(pose_demo: Demo) -> None:
    t, T = pose_demo
    rng = np.random.default_rng(1)
    noisy = T.copy()
    noisy[:, :3, :3] = so3.exp(1e-3 * rng.normal(size=(len(t), 3))) @ T[:, :3, :3]
    noisy[:, :3, 3] += 1e-3 * rng.normal(size=(len(t), 3))
    fit = fit_pose_dmp(t, noisy, schedule="time")
    np.testing.assert_allclose(fit.sigma, 1e-3, rtol=0.2)
    position, angle = off(fit.value, t, T)
    assert max(position, angle) < 1e-3


@pytest.mark.parametrize("angle", [2.0, 2.9])
def test_long_bent_turns_are_followed(angle: float) -> None:
    """The linear response of the weights leads nowhere here: 0.14 rad would be left."""
    t = np.linspace(0.0, 2.0, 201)
    u = t / t[-1]
    s = 10 * u**3 - 15 * u**4 + 6 * u**5
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = so3.exp(angle * np.stack([0.8 * s, 0.5 * np.sin(np.pi * s), -0.6 * s], axis=1))
    T[:, 0, 3] = s
    fit = fit_pose_dmp(t, T)
    assert np.abs(fit.residuals[:, 3:]).max() < 5e-5


@pytest.fixture(scope="module")
def truth(pose_demo: Demo) -> PoseDmp:
    t, T = pose_demo
    return fit_pose_dmp(t, T, n_basis=8, hold=0.0, scaling="none").value


def error(fit: Fit[PoseDmp], truth: PoseDmp) -> np.ndarray:
    found, parts = fit.value, []
    for own, true, turned in ((found.position, truth.position, False), (found.rotation, truth.rotation, True)):
        y0, g = own.y0 - true.y0, own.g - true.g
        if turned:
            y0, g = (turn(getattr(found, name), getattr(truth, name)) for name in ("T_start", "T_goal"))
        parts.append(np.concatenate([own.weights - true.weights, [y0], [own.v0 - true.v0], [g]]).T.ravel())
    return np.concatenate(parts)


def turn(T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
    return so3.log(T_a[:3, :3] @ T_b[:3, :3].T)


@pytest.mark.slow  # 3 s
def test_the_fit_meets_the_contract(truth: PoseDmp) -> None:
    def drawn(seed: int, n: int) -> Experiment:
        """Noise of a milliradian and a millimetre."""
        t = np.linspace(0.0, 1.0, n)
        T, noise = truth.rollout(t).T.copy(), 1e-3 * np.random.default_rng([1, seed]).normal(size=(2, n, 3))
        T[:, :3, :3] = so3.exp(noise[0]) @ T[:, :3, :3]
        T[:, :3, 3] += noise[1]
        return Experiment({"t": t, "T": T, "n_basis": 8, "hold": 0.0, "scaling": "none"}, truth)

    reasons = {
        "consistent": "start and goal are one sample each, however many there are",
        "efficient": "judged from 1000 runs on",
        "order-free": "samples are a motion in time",
        "gauge-free": "a turned frame turns the path, which a test of its own shows; weights are no pose",
        "refuses": "directions that the samples do not tell are left at zero and counted in the rank",
        "robust": "a motion has no outliers that could be told from it",
    }
    contract = check_estimator(fit_pose_dmp, drawn, 30, n=60, error=error, noise_given=False, skip=reasons)
    assert contract.passed, contract.text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"T": np.zeros((251, 3, 3))}, "N, 4, 4"),
        ({"T": np.full((251, 7), np.nan)}, r"NaN or Inf in row 0 \(251"),
        ({"T": np.ones((251, 7))}, "length 1"),
        ({"T": np.ones((251, 4, 4))}, "last rows"),
        ({"t": np.zeros(251)}, "times that increase"),
        ({"t": np.arange(10.0)}, "t "),
    ],
)
def test_bad_input_is_refused_by_a_sentence(pose_demo: Demo, change: dict, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        fit_pose_dmp(**{"t": pose_demo[0], "T": pose_demo[1], **change})


def test_half_a_turn_and_unknown_options_are_refused(pose_demo: Demo) -> None:
    t, T = pose_demo
    T = T.copy()
    T[:, :3, :3] = so3.exp(np.outer(t, [0, 0, 3.5]))
    with pytest.raises(ShapeError, match="half a turn away"):
        fit_pose_dmp(t, T)
    with pytest.raises(UnknownName, match="frame"):
        fit_pose_dmp(*pose_demo, frame="tool")
    with pytest.raises(ConfigError, match="phase of time"):
        fit_pose_dmp(*pose_demo, schedule="position")
    with pytest.raises(UnknownName, match="convention"):
        fit_pose_dmp(*pose_demo, convention="lab")

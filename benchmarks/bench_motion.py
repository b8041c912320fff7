"""Movement primitives compared with movement_primitives: fit, rollout, one step, and a thousand runs at once.

Seven coordinates, 1000 samples and 50 kernels; both libraries are called through their public API. The peer has no
batch function, so its runs are executed in a loop; one pass is timed. Its derivatives and phase differ, so the motions
are compared with the demonstration.
"""

from __future__ import annotations

import numpy as np
from blocks import Contender, Disagreement, Table, loop, once, table
from demonstrations import JOINTS, KERNELS, N, demonstration, rmse
from movement_primitives.dmp import DMP, CartesianDMP

from armlab.lie import quaternion, so3
from armlab.motion import Dmp, fit_dmp, fit_pose_dmp

RUNS = 1000


def run(quick: bool) -> list[Table]:
    """Measure fits, `rollout`, `Stepper.step` and `rollout_batch`."""
    t, y = demonstration()
    ours, theirs = fit_dmp(t, y).value, _peer(t, y)
    errors = [rmse(ours.rollout(t).y, y), rmse(theirs.open_loop()[1][:N], y)]
    if not max(errors) < 5e-3:
        raise Disagreement(f"Expected motions within 5e-3 of the demonstration, got {errors}.")
    rounds = 5 if quick else 40
    equations = np.random.default_rng(4).normal(size=(N, KERNELS + JOINTS))
    text = f"{JOINTS} coordinates x {N} samples, {KERNELS} kernels."
    accuracy = f"RMSE from the demonstration: armlab {errors[0]:.1e}, movement_primitives {errors[1]:.1e}."
    return [
        table(
            "Movement primitives: fit to accelerations",
            f"{text} armlab also computes covariance and excitation.",
            "ms",
            [
                Contender("armlab fit_dmp(method='acceleration')", _fit(t, y, method="acceleration"), "armlab"),
                Contender("movement_primitives imitate", once(lambda: theirs.imitate(t, y)), bar=1 / 4),
                Contender("movement_primitives imitate, ridge", once(lambda: _ridge(theirs, t, y)), bar=1 / 4),
                Contender(
                    "numpy.linalg.qr and svd of as many equations",
                    once(lambda: np.linalg.svd(np.linalg.qr(equations, mode="r")[:KERNELS, :KERNELS])),
                    "limit",
                ),
            ],
            rounds,
        ),
        table(
            "Movement primitives: fit to the trajectory",
            f"{text} This peer fits only accelerations; mp_pytorch is measured in motion_batch.",
            "ms",
            [
                Contender("armlab fit_dmp", _fit(t, y), "armlab"),
                Contender("movement_primitives imitate, ridge", once(lambda: _ridge(theirs, t, y)), bar=1.0),
            ],
            rounds,
        ),
        table(
            "Movement primitives: a motion",
            f"{text} {accuracy}",
            "ms",
            [
                Contender("armlab rollout", once(lambda: ours.rollout(t)), "armlab"),
                Contender("movement_primitives open_loop", once(theirs.open_loop), bar=1 / 40),
            ],
            rounds,
        ),
        table("Movement primitives: one step", text, "µs", _steps(ours, theirs, y), rounds),
        table(
            "Movement primitives: many motions",
            f"{RUNS} runs. {text}",
            "ms",
            _batches(ours, theirs, t),
            rounds // 4 + 2,
        ),
        table("Movement primitives: a motion of poses", *_poses(t), rounds),
    ]


def _peer(t: np.ndarray, y: np.ndarray) -> DMP:
    peer = DMP(n_dims=JOINTS, execution_time=t[-1], dt=t[1], n_weights_per_dim=KERNELS)
    peer.imitate(t, y)
    return peer


def _fit(t: np.ndarray, y: np.ndarray, **options: str):
    return once(lambda: fit_dmp(t, y, **options))


def _ridge(peer: DMP, t: np.ndarray, y: np.ndarray) -> None:
    peer.imitate(t, y, regularization_coefficient=1e-6)


def _steps(ours: Dmp, theirs: DMP, y: np.ndarray) -> list[Contender]:
    stepper, dt = ours.stepper(), np.full(200, 1.0 / (N - 1))
    theirs.reset()
    state = [y[0].copy(), np.zeros(JOINTS)]

    def step(_: float) -> None:
        state[:] = theirs.step(*state)

    return [
        Contender("armlab Stepper.step(dt)", loop(stepper.step, list(dt)), "armlab"),
        Contender("movement_primitives step", loop(step, list(dt)), bar=1 / 12),
    ]


def _poses(t: np.ndarray) -> tuple[str, str, list[Contender]]:
    S = t**3 * (10 - 15 * t + 6 * t**2)
    p = np.stack([0.4 + 0.2 * S, 0.1 * np.sin(2 * np.pi * S), 0.3 + 0.1 * S], axis=1)
    R = so3.exp(np.stack([0.8 * S, 0.5 * np.sin(np.pi * S), -0.6 * S], axis=1))
    demo = np.concatenate([p, quaternion.from_matrix(R)], axis=1)
    ours = fit_pose_dmp(t, demo).value
    theirs = CartesianDMP(execution_time=t[-1], dt=t[1], n_weights_per_dim=KERNELS)
    theirs.imitate(t, demo)
    errors = []
    for T in (ours.rollout(t).T, _matrices(theirs.open_loop()[1][:N])):
        angle = so3.log(np.swapaxes(R, 1, 2) @ T[:, :3, :3])
        errors += [np.sqrt((e**2).sum(axis=1).mean()) for e in (T[:, :3, 3] - p, angle)]
    if not max(errors) < 1e-2:
        raise Disagreement(f"Expected motions within 1e-2 of the demonstration, got {errors}.")
    text = (
        f"Position and quaternion x {N} samples, {KERNELS} kernels. RMSE from the demonstration: armlab "
        f"{errors[0]:.1e} m, {errors[1]:.1e} rad, movement_primitives {errors[2]:.1e} m, {errors[3]:.1e} rad."
    )
    return (
        text,
        "ms",
        [
            Contender("armlab PoseDmp.rollout", once(lambda: ours.rollout(t)), "armlab"),
            Contender("movement_primitives CartesianDMP.open_loop", once(theirs.open_loop), bar=1 / 40),
        ],
    )


def _matrices(y: np.ndarray) -> np.ndarray:
    T = np.tile(np.eye(4), (len(y), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = quaternion.to_matrix(y[:, 3:]), y[:, :3]
    return T


def _batches(ours: Dmp, theirs: DMP, t: np.ndarray) -> list[Contender]:
    rng = np.random.default_rng(2)
    starts = ours.y0 + 0.1 * rng.normal(size=(RUNS, JOINTS))
    weights = ours.weights * (1.0 + 0.1 * rng.normal(size=(RUNS, KERNELS, 1)))
    return [
        Contender("armlab rollout_batch(y0)", once(lambda: ours.rollout_batch(t, y0=starts)), "armlab"),
        Contender(
            "armlab rollout_batch(weights)",
            once(lambda: ours.rollout_batch(t, weights=weights)),
            note="separate weights per run",
        ),
        Contender("movement_primitives open_loop, 1000 of them", once(theirs.open_loop, scale=RUNS), bar=1 / 150),
    ]

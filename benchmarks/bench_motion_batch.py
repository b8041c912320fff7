"""A thousand movement primitives at once, and a fit to the trajectory, compared with mp_pytorch if it is installed.

Seven coordinates, 1000 samples, 50 kernels. Equation, kernels, weights, starts and goals are the same, so both are
compared with the exact solution. The peer returns positions and velocities; armlab also returns accelerations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from blocks import Contender, Disagreement, Table, once, table
from demonstrations import JOINTS, KERNELS, N, demonstration, rmse

from armlab.motion import Dmp, fit_dmp

RUNS, CHECKED = 1000, 5  # runs; runs compared with the exact solution
FACTOR = 1 / 0.8**2  # bandwidth factor of mp_pytorch for armlab's kernel widths
SIZE = f"{JOINTS} coordinates x {N} samples, {KERNELS} kernels."
KINDS = {"dmp": "DMP", "prodmp": "ProDMP"}
ALONE = "without a peer: mp_pytorch is not installed, see benchmarks/requirements_heavy.txt"


def run(quick: bool) -> list[Table]:
    """Measure `Dmp.rollout_batch` with separate weights per run, and `fit_dmp`."""
    t, y = demonstration()
    dmp = fit_dmp(t, y, convention="ijspeert").value
    peers = _Peers(dmp) if find_spec("mp_pytorch") else None
    rounds = 2 if quick else 30
    return [*_batches(peers, t, peers.same(dmp) if peers else dmp, rounds), _fits(peers, t, y, rounds)]


def _batches(peers: _Peers | None, t: np.ndarray, dmp: Dmp, rounds: int) -> list[Table]:
    """Return one table per peer, because the gigabytes of a ProDMP slow down the allocations of other contenders."""
    weights = dmp.weights * (1.0 + 0.1 * np.random.default_rng(2).normal(size=(RUNS, KERNELS, JOINTS)))
    exact = np.stack([replace(dmp, weights=own).solve(t).y for own in weights[:CHECKED]], axis=1)
    error = rmse(dmp.rollout_batch(t, weights=weights).y[:, :CHECKED], exact)
    ours = Contender("armlab rollout_batch(weights)", once(lambda: dmp.rollout_batch(t, weights=weights)), "armlab")
    tables = []
    for kind in KINDS if peers else [ALONE]:
        errors, contenders = {"armlab": error}, [ours]
        for name, roll in peers.rollouts(kind, t, dmp, weights) if peers else ():
            errors[name] = rmse(np.swapaxes(roll()[0][:CHECKED].numpy(), 0, 1), exact)
            contenders.append(Contender(f"mp_pytorch {name}", once(roll)))
        if not max(errors.values()) < 1e-2:
            raise Disagreement(f"Expected motions within 1e-2 of the exact solution, got {errors}.")
        text = f"{RUNS} runs with separate weights. {SIZE} RMSE from the exact solution: {_told(errors)}."
        fewer = rounds if kind != "prodmp" else min(rounds, 5)
        tables.append(table(f"Movement primitives: many motions, {kind}", text, "ms", contenders, fewer))
    return tables


def _fits(peers: _Peers | None, t: np.ndarray, y: np.ndarray, rounds: int) -> Table:
    contenders = [Contender("armlab fit_dmp", once(lambda: fit_dmp(t, y)), "armlab")]
    errors = {"armlab": rmse(fit_dmp(t, y).value.rollout(t).y, y)}
    if peers:
        fit, path = peers.fit(t, y)
        errors["ProDMP"] = rmse(path, y)
        contenders.append(Contender("mp_pytorch ProDMP.learn_mp_params_from_trajs", once(fit), note="64 bits"))
    text = f"{SIZE} RMSE from the demonstration: {_told(errors)}."
    return table("Movement primitives: fit to the trajectory, prodmp", text, "ms", contenders, rounds)


def _told(errors: dict[str, float]) -> str:
    return ", ".join(f"{name} {error:.1e}" for name, error in errors.items())


class _Peers:
    """DMP (Euler's method) and ProDMP (precomputed integrals of its kernels) of mp_pytorch in one thread."""

    def __init__(self, dmp: Dmp) -> None:
        import torch
        from mp_pytorch.mp import MPFactory

        torch.set_num_threads(1)
        torch.set_grad_enabled(False)
        self._torch, self._make = torch, MPFactory.init_mp
        self._settings = {
            "num_basis": KERNELS,
            "basis_bandwidth_factor": FACTOR,
            "num_basis_outside": 0,
            "alpha": dmp.alpha_z,
            "alpha_phase": dmp.alpha_x,
            "dt": dmp.duration / (N - 1),
        }

    def same(self, dmp: Dmp) -> Dmp:
        """Return the primitive with the peer's kernels, which differ from armlab's in the last width."""
        kernels = self._mp("dmp", dmp, "float64").basis_gn
        return replace(dmp, centres=kernels.centers_p.numpy(), widths=kernels.bandwidth.numpy() ** -0.5)

    def rollouts(
        self, kind: str, t: np.ndarray, dmp: Dmp, weights: np.ndarray
    ) -> Iterator[tuple[str, Callable[[], Any]]]:
        """Yield names and functions that return positions and velocities; a clock common to all runs is fastest."""
        goals = np.broadcast_to(dmp.g, (RUNS, JOINTS))[:, :, None]
        wanted = np.concatenate([np.swapaxes(weights, 1, 2), goals], axis=2).reshape(RUNS, -1)
        starts = [np.zeros(RUNS), *(np.broadcast_to(part, (RUNS, JOINTS)) for part in (dmp.y0, dmp.v0))]
        for bits in (32, 64):
            given = [self._tensor(part, f"float{bits}") for part in (t, wanted, *starts)]
            yield f"{KINDS[kind]}, {bits} bits", _rolling(self._mp(kind, dmp, f"float{bits}"), given)

    def fit(self, t: np.ndarray, y: np.ndarray) -> tuple[Callable[[], Any], np.ndarray]:
        """Return the function that fits a ProDMP in double precision, and the motion of the fitted ProDMP."""
        times, shown = self._torch.tensor(t), self._torch.tensor(y)
        mp = self._make("prodmp", self._settings, JOINTS, tau=float(t[-1]), dtype=self._torch.float64)
        mp.learn_mp_params_from_trajs(times, shown)
        path = mp.get_traj_pos().numpy()
        return lambda: mp.learn_mp_params_from_trajs(times, shown), path

    def _mp(self, kind: str, dmp: Dmp, precision: str) -> Any:
        return self._make(kind, self._settings, JOINTS, tau=dmp.tau_d, dtype=getattr(self._torch, precision))

    def _tensor(self, values: np.ndarray, precision: str) -> Any:
        return self._torch.tensor(np.array(values), dtype=getattr(self._torch, precision))


def _rolling(mp: Any, given: list[Any]) -> Callable[[], Any]:
    def roll() -> tuple[Any, Any]:
        mp.update_inputs(*given[:2], init_time=given[2], init_pos=given[3], init_vel=given[4])
        return mp.get_traj_pos(), mp.get_traj_vel()

    return roll

"""Static MAP estimate of the contact wrench.

With ``tau_e = model - measured = J^T F + e``, e ~ N(0, C_tau(qd)), F ~ N(0, C_F):

    S = J^T C_F J + C_tau,   K = C_F J S^-1,   F_hat = K tau_e,   P = (I - K J^T) C_F (I - K J^T)^T + K C_tau K^T

It needs no inverse of C_tau or C_F and works at singular poses, where the prior remains. TFRT-7651 prints the estimate
with C_tau where its inverse belongs; as a covariance that gives the noisiest joint the most weight. The prior shrinks:
the bias is ``(I - K J^T) F``.
"""

from __future__ import annotations

import numpy as np

from armlab.contact.wrench import INVALID, WEAK, WEAK_BELOW, Wrench, flags_of
from armlab.errors import ShapeError
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Estimator"]

DEFAULT_PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)  # standard deviations [N, N m]


class Estimator:
    """Contact wrench from joint motion and torque, sample by sample or for a whole log.

    `step` and `run` call the same kernel: for the same rows their results are equal bit for bit. Causal: a residual
    filter of second order at the model's cut-off (10 Hz: 22 ms delay).

    Parameters
    ----------
    model : identified torque model.
    robot : the arm; must be the one the model belongs to.
    prior : (6,) standard deviations of the wrench before any measurement [N, N m]; 20 N and 2 N m when left out.

    Raises
    ------
    ModelMismatchError : when the model belongs to another robot.
    ShapeError : when the prior is not six positive numbers.

    Examples
    --------
    >>> estimator = Estimator(models.load("model.toml"), robot)  # doctest: +SKIP
    >>> estimator.step(state).F  # doctest: +SKIP
    """

    def __init__(self, model: TorqueModel, robot: Robot, prior: np.ndarray | None = None) -> None:
        model.check_robot(robot)
        deviations = np.array(DEFAULT_PRIOR) if prior is None else np.asarray(prior, dtype=float)
        if deviations.shape != (6,) or not np.all(np.isfinite(deviations)) or not np.all(deviations > 0):
            raise ShapeError(
                f"Expected six positive standard deviations [N, N, N, N m, N m, N m] as prior, got {prior!r}. "
                "Give the size of the forces and moments that you expect."
            )
        variances = deviations**2
        variances.flags.writeable = False
        self._n = model.n
        self._prior = variances
        self._kernel = model.estimator_kernel(variances)

    @property
    def prior(self) -> np.ndarray:
        """Prior variances (6,) [N^2, (N m)^2]."""
        return self._prior

    def reset(self) -> None:
        """Forget the past: filter, presliding state and how well it is known."""
        self._kernel.reset()

    def step(self, state: State) -> Wrench:
        """Advance by one state and return the wrench.

        A sample that is not finite, or so large that its torque is not, gives NaN and changes nothing.

        Parameters
        ----------
        state : with q, qd, tau (n,) and dt.
        """
        F, cov, observability, error, variance = self._kernel.step(state.q, state.qd, state.tau, state.dt)
        return Wrench(F, cov, observability, error, variance, self._prior, flags_of(F, observability))

    def run(self, table: Table) -> Table:
        """Return the table with wrench_hat, wrench_hat_cov, observability, tau_error, tau_variance and flags.

        Parameters
        ----------
        table : log with columns q, qd, tau (N, n).

        Raises
        ------
        ShapeError : when the joint count is not the model's.
        """
        q, qd, tau = (np.ascontiguousarray(table[name], dtype=float) for name in ("q", "qd", "tau"))
        if q.shape != (len(table), self._n):
            raise ShapeError(
                f"Expected q of shape ({len(table)}, {self._n}), got {q.shape}. "
                "Give the log of the robot that the model belongs to."
            )
        self.reset()
        F, cov, observability, error, variance = self._kernel.run(q, qd, tau, np.ascontiguousarray(table.dt))
        flags = np.where(np.isfinite(F[:, 0]), np.where(observability.min(axis=1) < WEAK_BELOW, WEAK, 0), INVALID)
        return (
            table.with_column("wrench_hat", F)
            .with_column("wrench_hat_cov", cov)
            .with_column("observability", observability)
            .with_column("tau_error", error, unit="N m")
            .with_column("tau_variance", variance, unit="N^2 m^2")
            .with_column("wrench_flags", flags, unit="1", kind="count")
        )

"""Contact wrench from joint motion and torque, causal, at the rate of the loop.

All methods take ``tau_e = model - measured = J^T F + error``, low-passed at the model's cut-off, and its covariance
C_tau(qd) over velocity.

"map"       most probable F for F ~ N(0, C_F): ``S = J^T C_F J + C_tau, K = C_F J S^-1, F = K tau_e``. It needs no
            inverse of either covariance and works at singular poses, where the prior remains. The prior shrinks: the
            bias is ``(I - K J^T) F``.
"bounded"   near rest friction is bounded instead of random: the least ``sum max(|tau_e - J^T F| - D, 0)^2 / s^2 + F^T
            C_F^-1 F`` by semismooth Newton (after Linderoth, Stolt, Robertsson and Johansson, IROS 2013). No contact
            unless proven; no drift at rest. Joints inside their bound tell nothing.
"interval"  bounded, and the guaranteed interval of every axis while |friction error| <= D and |noise| <= 3 s, by linear
            programmes.
"clip"      bounded, by the iteration that is easy to audit and needs thousands of rounds. To compare.
"ls"        weighted least squares without a prior. To compare; near singular poses its forces are huge.
"lund"      ``(J C_tau J^T + C_F^-1)^-1 J C_tau tau_e`` as TFRT-7651, eq. (2), prints it. To compare: with a covariance
            in place of a weight the noisiest joint speaks loudest. Our sign; the report's F_ext is -F.

For ``x = K tau_e`` with any gain the covariance is ``(I - K J^T) C_F (I - K J^T)^T + K C_tau K^T``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.contact.wrench import Wrench
from armlab.errors import ShapeError, UnknownName
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Estimator"]

Method = Literal["map", "bounded", "clip", "interval", "ls", "lund"]
METHODS = ("map", "bounded", "clip", "interval", "ls", "lund")  # the kernel knows them by number
DEFAULT_PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)  # standard deviations [N, N m]


class Estimator:
    """Contact wrench, sample by sample or for a whole log.

    `step` and `run` call the same kernel: for the same rows their results are equal bit for bit. Causal: a residual
    filter of second order at the model's cut-off (10 Hz: 22 ms delay).

    Parameters
    ----------
    model : identified torque model.
    robot : the arm; must be the one the model belongs to.
    method : see the module; "map" is for motion, "bounded" and "interval" for an arm that may rest.
    prior : (6,) standard deviations of the wrench before any measurement [N, N m]; 20 N and 2 N m when left out. At a
        known point the first three are those of the force.
    point : (3,) where the contact is, in tool axes [m], when that is known: three unknowns instead of six, about half
        the error, and a wrong point about doubles it.

    Raises
    ------
    ModelMismatchError : when the model belongs to another robot.
    UnknownName : for another method.
    ShapeError : when the prior is not six positive numbers, or the point not three finite ones.

    Examples
    --------
    >>> estimator = Estimator(models.load("model.toml"), robot)  # doctest: +SKIP
    >>> estimator.step(state).F  # doctest: +SKIP
    """

    def __init__(
        self,
        model: TorqueModel,
        robot: Robot,
        method: Method = "map",
        prior: ArrayLike | None = None,
        point: ArrayLike | None = None,
    ) -> None:
        model.check_robot(robot)
        if method not in METHODS:
            raise UnknownName.among("estimation method", method, METHODS)
        deviations = np.array(DEFAULT_PRIOR) if prior is None else np.asarray(prior, dtype=float)
        if deviations.shape != (6,) or not np.all(np.isfinite(deviations)) or not np.all(deviations > 0):
            raise ShapeError(
                f"Expected six positive standard deviations [N, N, N, N m, N m, N m] as prior, got {prior!r}. "
                "Give the size of the forces and moments that you expect."
            )
        if point is not None:
            point = np.array(point, dtype=float)
            if point.shape != (3,) or not np.all(np.isfinite(point)):
                raise ShapeError(f"Expected the contact point as three finite numbers [m], tool axes, got {point!r}.")
        variances = deviations**2
        variances.flags.writeable = False
        self._n = model.n
        self._prior = variances
        self._at_point = point is not None
        self._method = method
        self._kernel = model.estimator_kernel(variances, METHODS.index(method), point)

    @property
    def prior(self) -> np.ndarray:
        """Prior variances (6,) [N^2, (N m)^2]."""
        return self._prior

    @property
    def method(self) -> str:
        """The method that was chosen."""
        return self._method

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
        F, cov, observability, error, variance, flags, active, interval = self._kernel.step(
            state.q, state.qd, state.tau, state.dt
        )
        return Wrench(F, cov, observability, error, variance, self._prior, flags, active, interval, self._at_point)

    def run(self, table: Table) -> Table:
        """Return the table with the estimate of every row.

        Columns: wrench_hat, wrench_hat_cov, observability, tau_error, tau_variance, wrench_flags, wrench_active, and
        wrench_interval (6, 2) of the method "interval".

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
        F, cov, observability, error, variance, flags, active, interval = self._kernel.run(
            q, qd, tau, np.ascontiguousarray(table.dt)
        )
        table = (
            table.with_column("wrench_hat", F)
            .with_column("wrench_hat_cov", cov)
            .with_column("observability", observability)
            .with_column("tau_error", error, unit="N m")
            .with_column("tau_variance", variance, unit="N^2 m^2")
            .with_column("wrench_flags", flags, unit="1", kind="count")
            .with_column("wrench_active", active.astype(np.int64), unit="1", kind="count")
        )
        return table if interval is None else table.with_column("wrench_interval", interval)

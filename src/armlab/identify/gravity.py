"""Gravity and friction from slow motion: the ancestor's model of a YuMi for force estimation.

    tau_i = Y_i(q) gravity parameters + F_f,i(qd_i, s_i) + ripple_i(q_i) + e_i

A log of slow motion does not tell inertia. Masses and first moments that gravity shows (14 combinations of a YuMi arm)
need no more than that, and contact forces at low speed need no more than these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.identify.base_parameters import base_parameters
from armlab.identify.drafting import Job
from armlab.identify.dynamics import fit_model
from armlab.identify.preparation import Prepared
from armlab.identify.threads import one_thread
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot

__all__ = ["fit_gravity"]

BAND = 5.0  # Hz, in which acceleration is judged
SLOW = 1.0  # rad/s^2, m/s^2
QUANTILE = 0.99


@one_thread()
def fit_gravity(
    table: Table | Sequence[Table],
    robot: Robot,
    *,
    method: str = "irls",
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
    prior: Fit[TorqueModel] | None = None,
) -> Fit[TorqueModel]:
    """Identify gravity, friction and offsets from one or several logs of slow free motion.

    Parameters
    ----------
    table : logs with columns q, tau (N, n), and qd where it was measured, without contact.
    robot : the arm that was logged; its gravity counts.
    method, seed, progress, prior : as in `fit_dynamics`.

    Returns
    -------
    Fit of a `models.TorqueModel` that is quasi-static: no torque comes with acceleration or velocity of its links.

    Raises
    ------
    ShapeError : logs that `fit_dynamics` refuses, or motion so fast that inertia would count as gravity.
    NotExcited : joints or directions that the log does not determine, by name. UnknownName : another method.

    References
    ----------
    Bagge Carlson and Haage (2017), YuMi low-level motion guidance, TFRT-7651, section 4.
    """
    job = Job("gravity model", method, seed, progress or (lambda done, total, what: None), prior)
    return fit_model(
        table, robot, base_parameters(robot, quasi_static=True), job, lambda data: _check_slow(data, robot)
    )


def _check_slow(data: Prepared, robot: Robot) -> None:
    """Refuse motion whose inertia cannot be neglected."""
    band = min(BAND, data.rate / 10.0)
    acceleration = np.quantile(np.abs(data.filter(data.differentiate(data.qd), band)), QUANTILE, axis=0)
    fast = np.flatnonzero(acceleration > SLOW)
    if len(fast):
        listed = ", ".join(f"{robot.joint_names[i]} ({acceleration[i]:.2g})" for i in fast)
        raise ShapeError(
            f"Expected slow motion, accelerations below {SLOW:g} rad/s^2 or m/s^2, got more for {listed}: inertia "
            "would count as gravity. Use fit_dynamics for this log, or record a slower one."
        )

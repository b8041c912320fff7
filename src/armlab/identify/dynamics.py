"""Rigid-body base parameters, friction and ripple of all joints from a log, by robust least squares with covariance.

    tau_i = Y_i(q, qd, qdd) base + F_f,i(qd_i, s_i) + ripple_i(q_i) + e_i

1. The same zero-phase filter runs over torque and every regressor column; then every few samples are kept.
2. Joints may read their torque by a few percent too large or small: gains, by which it is divided, are fitted before
   and after the next step.
3. Per joint, kind and width of the sign, Stribeck speed and the terms of friction are chosen on held-out blocks, with
   the rigid part held.
4. All linear parameters by least squares, joints weighted by 1 / their residual deviation, within physical bounds.
5. Covariance by drawing blocks again: residuals are coloured, and the formal covariance is far too small.
6. Models fitted without a fifth of the blocks give held-out residuals through the estimator's own causal filter; to
   them the torque covariance over velocity is fitted and its scale calibrated to 95.4 % inside 2 sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from armlab.estimation import Fit, block_bootstrap
from armlab.identify.base_parameters import BaseParameters, base_parameters, measured_joints
from armlab.identify.drafting import Job, Progress, fit_of, fold_models, make_draft, model_of
from armlab.identify.preparation import Prepared, prepare
from armlab.identify.threads import one_thread
from armlab.identify.torque_gains import gain_share
from armlab.identify.validation import assess
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot

__all__ = ["fit_dynamics", "fit_model"]


@one_thread()
def fit_dynamics(
    table: Table | Sequence[Table],
    robot: Robot,
    *,
    method: str = "irls",
    seed: int = 0,
    progress: Progress | None = None,
    prior: Fit[TorqueModel] | None = None,
    joints: Sequence[int] | None = None,
) -> Fit[TorqueModel]:
    """Identify the torque model of an arm from one or several logs of free motion.

    Parameters
    ----------
    table : logs with columns q, qd, tau (N, n) over the robot's clock, without contact.
    robot : the arm that was logged.
    method : "irls": joints weighted by 1 / their deviation, rows by Huber's loss, single spikes of torque replaced.
        "lts": the same with weights of 1 for the blocks of a quarter of a second that agree, 0 for the others. "wls",
        "ols": every sample as it is; with weights per joint, or without.
    seed : of the block bootstrap and of the random starts of "lts".
    progress : called with (done, total, what).
    prior : an earlier fit of the same robot; where the log does not tell a direction of the parameters, its values
        stay, and the report lists the direction. Without it such a log is refused.
    joints : numbers, from 0, of those whose torque is measured; all when left out. All joints may move. Estimators do
        not listen to the others, and momentum methods have none of such a model.

    Returns
    -------
    Fit of `models.TorqueModel`; its parameters are the base parameters, then of each joint viscous and Coulomb friction
    (one number, or one for each direction), offset, and stribeck, root and two ripple amplitudes where the joint has
    them. No inertia of a rotor, viscous or Coulomb friction is negative.

    Raises
    ------
    ShapeError : NaN rows, wrong joint count, velocity that is not the derivative of position.
    NotExcited : joints or directions that the log does not determine, by name. UnknownName : another method.
    ModelMismatchError : a prior of another robot.

    References
    ----------
    Gautier (1991) for base parameters, Huber (1964), Rousseeuw (1984), Dahl (1968) for presliding, Kunsch (1989) for
    the block bootstrap.
    """
    measured = None if joints is None else tuple(measured_joints(robot, joints))
    job = Job("torque model", method, seed, progress or (lambda done, total, what: None), prior, measured)
    return fit_model(table, robot, base_parameters(robot, joints=measured), job)


def fit_model(
    table: Table | Sequence[Table],
    robot: Robot,
    base: BaseParameters,
    job: Job,
    check: Callable[[Prepared], None] = lambda data: None,
) -> Fit[TorqueModel]:
    """Fit base parameters, friction and offset; see `fit_dynamics` and `fit_gravity`.

    Parameters
    ----------
    table, robot : as there. base : which base parameters. job : how to fit.
    check : refuses records that are not of this kind.
    """
    job.check(robot)
    job.tell(0, 5, "checking the log")
    data = prepare(table, robot, job.joints)
    check(data)
    draft = make_draft(data, robot, base, job)
    design, sums = draft.design, draft.sums
    data, solution = design.data, sums.solution
    cov = block_bootstrap(sums, seed=job.seed, length=draft.length).cov
    job.tell(4, 5, "held-out residuals")
    model = model_of(design, solution.x, cov, draft.gain_cov)
    model = assess(model, fold_models(model, design, sums, draft.block, draft.length), data, design.joints)
    job.tell(5, 5, "done")
    return fit_of(model, design, solution, cov + gain_share(solution, draft.gain_cov), len(data.t))

"""A load at the flange from a log of an arm whose torque model is known.

    tau - tau_model = (1 + g_i) Y_i(q, qd, qdd) pi + e_i,      g_i ~ N(0, 5 %)

Y are the columns of the last link, moved to the flange; pi is mass, first moment and, in mode "dynamic", inertia. In
mode "static" the load counts as a point for its inertia. What joint i calls one newton metre may be a little more or
less, g_i: without it the mass would seem to be known far better than it is.

1. Residual of the model and regressor pass the same zero-phase filter. With a log of the same motion without the load
   its residual is subtracted, and with it all that the model has wrong and both logs share.
2. Huber's least squares for pi alone gives the weights of rows and joints.
3. Gauss-Newton for pi and the gains together, each joint counting its independent samples only. Then both once more:
   weights that know nothing of the gains take them for outliers.
4. The covariance: scatter of whole blocks of time, what the gains may be, what the model may have wrong in its masses
   and its friction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armlab._numbers import number
from armlab.errors import ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit, LinearSolution, Rows, block_seconds, check_spread, least_squares
from armlab.identify.base_parameters import LINK_SYMBOLS
from armlab.identify.gains import GainProblem
from armlab.identify.load_record import EVERY, LoadRecord
from armlab.identify.model_error import ModelError
from armlab.log import Table
from armlab.models import Payload, TorqueModel
from armlab.robots import Robot, inertia

__all__ = ["fit_payload"]

SIZES = {"static": 4, "dynamic": 10}
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
FARTHEST = 0.5  # m, of the centre of mass
MIN_BLOCKS = 8


def fit_payload(
    table: Table | Sequence[Table],
    model: TorqueModel | Fit[TorqueModel],
    robot: Robot,
    mode: str = "static",
    without: Table | None = None,
    *,
    gain_sd: float = 0.05,
) -> Fit[Payload]:
    """Estimate mass, centre and, if asked, inertia of a load at the flange.

    Parameters
    ----------
    table : log or logs with the load, columns q, qd, tau (N, n), without contact.
    model : of the arm without the load, as `identify.fit_dynamics` returns it: what is uncertain in its masses and in
        its friction is in the covariance. Of a model alone, `fit.value`, that of the friction is not known.
    robot : the arm.
    mode : "static": mass and first moment; "dynamic": all ten parameters, which needs fast motion of the wrist.
    without : log of the same motion without the load: what the model has wrong falls out of the difference.
    gain_sd : how well the torque constants are known, as a share; 0 for exactly.

    Returns
    -------
    Fit of `models.Payload`; its parameters are m, m c (and I about the flange's origin) in flange axes. m >= 0 and
    a centre within 0.5 m hold; the covariance is that without these bounds.

    Raises
    ------
    ModelMismatchError : a model of another robot. UnknownName : another mode.
    NotExcited : motion that does not tell the parameters apart, by name; too short a log.
    ShapeError : NaN rows, wrong joint count, a motion without the load that is another one, `gain_sd` out of range.
    """
    value = model.value if isinstance(model, Fit) else model
    if not isinstance(value, TorqueModel):
        raise ModelMismatchError.no_model(model)
    value.check_robot(robot)
    if mode not in SIZES:
        raise UnknownName.among("mode of a payload fit", mode, SIZES)
    if not 0 <= number(gain_sd, "the deviation of the gains") < 1:
        raise ShapeError(f"Expected a standard deviation of the gains in [0, 1), got {gain_sd}. 0.05 is 5 %.")
    record, p = LoadRecord.of(table, model, robot, without), SIZES[mode]
    seconds = record.data.seconds / 20.0
    gains, rest = np.zeros(len(record.joints)), np.zeros(10)
    guess = _robust(record, p, gains, rest, seconds)
    left = _left(record, guess, gains, rest)
    x, gains = GainProblem.of(guess, left, gains, gain_sd).solve()
    rest = _point(x) if mode == "static" else rest
    found = _robust(record, p, gains, rest, min(block_seconds(left, EVERY / record.data.rate), seconds))
    problem = GainProblem.of(found, _left(record, found, gains, rest), gains, gain_sd)
    x, gains = problem.solve()
    known = np.linalg.cholesky(problem.information(x, gains)).T
    check_spread(known, LINK_SYMBOLS[:p], UNITS[:p], _limits(record, robot)[:p], "payload")
    wrong = np.einsum("iab,i,ibs->as", problem.response(x, gains), problem.weights, record.against[:, :p])
    cov = problem.covariance(x, gains) + wrong @ record.error.cov @ wrong.T
    theta = _possible(x, cov)
    pi = _point(theta) if mode == "static" else theta
    value = Payload(robot.name, robot.hash, pi, robot.links[-1], record.sources)
    notes = _notes(x, theta, value, np.sqrt(np.diag(cov)), gains, gain_sd)
    if len(record.joints) < robot.n:
        rest_names = [robot.joint_names[i] for i in range(robot.n) if i not in record.joints]
        notes.append(f"left out, at rest: {', '.join(rest_names)}")
    notes += _unknown(record.error, isinstance(model, Fit))
    return Fit(
        value=value,
        names=LINK_SYMBOLS[:p],
        units=UNITS[:p],
        parameters=theta,
        cov=cov,
        sigma=found.sigma,
        residuals=record.y - (1.0 + gains) * (record.A @ pi),
        n=len(record.y),
        excitation=found.excitation,
        summary=lambda fit: "\n".join([_table(fit), *notes, f"{fit.n} samples", fit.excitation.text()]),
    )


def _robust(record: LoadRecord, p: int, gains: np.ndarray, rest: np.ndarray, seconds: float) -> LinearSolution:
    """Return Huber's solution for the first p parameters; the gains less 1 (n,) and the rest (10,) are held."""
    block = record.blocks(seconds)
    if block[-1] + 1 < MIN_BLOCKS:
        raise NotExcited(
            f"Expected at least {MIN_BLOCKS} blocks of {seconds:.2g} s for a covariance, got {block[-1] + 1}. "
            "Record for longer.",
            ["covariance"],
            [f"{record.data.seconds:.1f} s"],
        )
    A = (1.0 + gains)[:, None] * record.A
    rows = list(Rows.of(A[:, :, :p], record.y - A[:, :, p:] @ rest[p:], block))
    return least_squares(rows, LINK_SYMBOLS[:p], what="payload", method="irls")


def _limits(record: LoadRecord, robot: Robot) -> np.ndarray:
    """Return the deviations (10,) that are the most accepted: loads that would double the largest torque of the log."""
    torque, gravity = np.sqrt(np.mean(record.data.tau[:, record.joints] ** 2, axis=0)).max(), 9.81
    reach = np.linalg.norm(robot.frames[1:, :3, 3], axis=1).sum()
    return torque / gravity * np.array([1.0 / reach, *[1.0] * 3, *[reach] * 6])


def _left(record: LoadRecord, found: LinearSolution, gains: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the residuals (M, n) of a solution [N m]."""
    return record.y - (1.0 + gains) * (record.A @ np.concatenate([found.x, rest[len(found.x) :]]))


def _point(theta: np.ndarray) -> np.ndarray:
    """Return the ten parameters of a point with mass and first moment `theta` (4,)."""
    if not theta[0] > 0:
        return np.concatenate([theta[:4], np.zeros(6)])
    return inertia.from_body(theta[0], theta[1:4] / theta[0], np.zeros((3, 3)))


def _possible(theta: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return the nearest parameters with ``m >= 0, |m c| <= 0.5 m``, in deviations of `cov`; no load at the tip."""
    m, h = theta[0], theta[1:4]
    if m >= 0 and np.linalg.norm(h) <= FARTHEST * m:
        return theta
    cone = np.diag([-(FARTHEST**2), 1.0, 1.0, 1.0])
    metric = np.linalg.pinv(cov[:4, :4], hermitian=True)

    def at(multiplier: float) -> np.ndarray:
        return np.linalg.solve(metric + multiplier * cone, metric @ theta[:4])

    from scipy.optimize import root_scalar

    reach = np.linalg.eigvals(np.linalg.solve(metric, -cone)).real.max()
    ends = 0.0, (1.0 - 1e-9) / reach
    if at(ends[1]) @ cone @ at(ends[1]) > 0 or at(ends[1])[0] < 0:
        return np.zeros_like(theta)
    near = at(root_scalar(lambda s: at(s) @ cone @ at(s), bracket=ends).root)
    if near[0] <= 0:
        return np.zeros_like(theta)
    return np.concatenate([near, theta[4:] + cov[4:, :4] @ metric @ (near - theta[:4])])


def _table(fit: Fit[Payload]) -> str:
    """Return mass, centre and inertia with deviations, then what was fitted."""
    load, theta = fit.value, fit.parameters
    lines = [f"{name:6s} {x: .5g} +- {sd:.2g} {unit}" for name, x, sd, unit in zip(fit.names, theta, fit.sd, fit.units)]
    for axis in range(3):
        slope = np.zeros(len(theta))
        if load.mass > 0:
            slope[[0, 1 + axis]] = -load.centre[axis] / load.mass, 1.0 / load.mass
        sd = np.sqrt(slope @ fit.cov @ slope)
        lines.append(f"centre {'xyz'[axis]} {1e3 * load.centre[axis]:.1f} +- {1e3 * sd:.1f} mm")
    return "\n".join([*lines, "flange axes; deviations of one sigma"])


def _unknown(error: ModelError, fitted: bool) -> list[str]:
    """Return what of the model's own uncertainty the deviations leave out."""
    notes = []
    if error.base is None:
        notes.append("the model was identified from some joints only: what is uncertain in its masses is not in")
    if not fitted:
        notes.append("what is uncertain in the model's friction is not in: give the fit of the model, not its value")
    elif error.base is not None and error.left_out:
        notes.append(f"not in the deviations: what is uncertain in {', '.join(error.left_out)}")
    return notes


def _notes(
    free: np.ndarray, theta: np.ndarray, load: Payload, sd: np.ndarray, gains: np.ndarray, gain_sd: float
) -> list[str]:
    """Return what the reader of a report must know beside the numbers."""
    notes = []
    if not np.array_equal(free, theta):
        notes.append(f"held at a bound (m >= 0, centre within {FARTHEST} m); without it m = {free[0]:.4g} kg")
    if len(theta) == 10 and inertia.principal_moments(load.pi).min() < -3.0 * sd[4:].max():
        notes.append("the inertia is not that of a body; identify.physical_load gives the nearest, or use mode static")
    if gain_sd:
        percent = "  ".join(f"{100 * g:+.1f}" for g in gains)
        notes.append(f"gains of the joints, of which {100 * gain_sd:g} % is expected [%]: {percent}")
    return notes

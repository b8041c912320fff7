"""A load at the flange from a log of an arm whose torque model is known.

    tau - tau_model = (1 + g_i) Y_i(q, qd, qdd) pi + e_i,      g_i ~ N(0, 5 %)

Y are the columns of the last link, moved to the flange; pi is mass, first moment and, in mode "dynamic", inertia. In
mode "static" the load counts as a point for its inertia. What joint i calls one newton metre may be a little more or
less, g_i: without it the mass would seem to be known far better than it is.

1. Residual of the model and regressor pass the same zero-phase filter. With a log of the same motion without the load
   its residual is subtracted, and with it all that the model has wrong and both logs share.
2. Huber's least squares for pi alone gives the weights of rows and joints.
3. Gauss-Newton for pi and the gains together, each joint counting its independent samples only.
4. Whole blocks of time are drawn again, with other gains and another model inside its covariance: the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit, LinearSolution, Rows, block_seconds, check_spread, least_squares
from armlab.identify.base_parameters import LINK_SYMBOLS
from armlab.identify.gains import GainProblem
from armlab.identify.load_record import EVERY, LoadRecord
from armlab.log import Table
from armlab.models import Payload, TorqueModel
from armlab.robots import Robot, inertia

__all__ = ["fit_payload"]

SIZES = {"static": 4, "dynamic": 10}
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
FARTHEST = 0.5  # m, of the centre of mass
DRAWS, MIN_BLOCKS = 400, 8


def fit_payload(
    table: Table | Sequence[Table],
    model: TorqueModel,
    robot: Robot,
    mode: str = "static",
    without: Table | None = None,
    *,
    gain_sd: float = 0.05,
    seed: int = 0,
) -> Fit[Payload]:
    """Estimate mass, centre and, if asked, inertia of a load at the flange.

    Parameters
    ----------
    table : log or logs with the load, columns q, qd, tau (N, n), without contact.
    model : torque model of the arm without the load.
    robot : the arm.
    mode : "static": mass and first moment; "dynamic": all ten parameters, which needs fast motion of the wrist.
    without : log of the same motion without the load: what the model has wrong falls out of the difference.
    gain_sd : how well the torque constants are known, as a share; 0 for exactly.
    seed : of the bootstrap.

    Returns
    -------
    Fit of `models.Payload`; its parameters are m, m c (and I about the flange's origin) in flange axes. m >= 0 and
    a centre within 0.5 m hold. The covariance is that of whole blocks drawn again, of the gains and of the model.

    Raises
    ------
    ModelMismatchError : a model of another robot. UnknownName : another mode.
    NotExcited : motion that does not tell the parameters apart, by name; too short a log.
    ShapeError : NaN rows, wrong joint count, a motion without the load that is another one, `gain_sd` out of range.
    """
    model.check_robot(robot)
    if mode not in SIZES:
        raise UnknownName.among("mode of a payload fit", mode, SIZES)
    if not 0 <= gain_sd < 1:
        raise ShapeError(f"Expected a standard deviation of the gains in [0, 1), got {gain_sd}. 0.05 is 5 %.")
    record, p = LoadRecord.of(table, model, robot, without), SIZES[mode]
    first = _robust(record, p, np.zeros(10), record.data.seconds / 20.0)
    rest = _point(first.x) if mode == "static" else np.zeros(10)
    seconds = min(block_seconds(_left(record, first, rest), EVERY / record.data.rate), record.data.seconds / 20.0)
    found = _robust(record, p, rest, seconds)
    problem = GainProblem.of(found, _left(record, found, rest), gain_sd)
    x, gains = (part[0] for part in problem.solve(np.ones((1, len(problem.sums))), np.zeros((1, robot.n))))
    known = np.linalg.cholesky(problem.information(x, gains)).T
    check_spread(known, LINK_SYMBOLS[:p], UNITS[:p], _limits(record, robot)[:p], "payload")
    draws = _draws(problem, found, record, (x, gains), model, seed)
    metric = np.cov(draws.T)
    theta = _possible(x, metric)
    cov = np.cov(np.stack([_possible(one, metric) for one in draws]).T)
    pi = _point(theta) if mode == "static" else theta
    value = Payload(robot.name, robot.hash, pi, robot.links[-1], record.sources)
    notes = _notes(x, theta, value, np.sqrt(np.diag(cov)), gains, gain_sd)
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


def _robust(record: LoadRecord, p: int, rest: np.ndarray, seconds: float) -> LinearSolution:
    """Return Huber's solution for the first p parameters, the others held at those of `rest` (10,)."""
    block = record.blocks(seconds)
    if block[-1] + 1 < MIN_BLOCKS:
        raise NotExcited(
            f"Expected at least {MIN_BLOCKS} blocks of {seconds:.2g} s for a covariance, got {block[-1] + 1}. "
            "Record for longer.",
            ["covariance"],
            [f"{record.data.seconds:.1f} s"],
        )
    y = record.y - record.A[:, :, p:] @ rest[p:]
    rows = list(Rows.of(record.A[:, :, :p], y, block))
    return least_squares(rows, LINK_SYMBOLS[:p], what="payload", method="irls")


def _limits(record: LoadRecord, robot: Robot) -> np.ndarray:
    """Return the deviations (10,) that are the most accepted: loads that would double the largest torque of the log."""
    torque, gravity = np.sqrt(np.mean(record.data.tau**2, axis=0)).max(), 9.81
    reach = np.linalg.norm(robot.frames[1:, :3, 3], axis=1).sum()
    return torque / gravity * np.array([1.0 / reach, *[1.0] * 3, *[reach] * 6])


def _left(record: LoadRecord, found: LinearSolution, rest: np.ndarray) -> np.ndarray:
    """Return the residuals (M, n) of a solution [N m]."""
    return record.y - record.A @ np.concatenate([found.x, rest[len(found.x) :]])


def _draws(
    problem: GainProblem,
    found: LinearSolution,
    record: LoadRecord,
    solution: tuple[np.ndarray, np.ndarray],
    model: TorqueModel,
    seed: int,
) -> np.ndarray:
    """Return solutions (D, p) for blocks, gains and models drawn again."""
    rng = np.random.default_rng(seed)
    B, n = problem.sums.shape[:2]
    blocks = rng.multinomial(B, np.full(B, 1.0 / B), DRAWS).astype(float)
    blocks = 1.0 + found.stretch * np.sqrt(B / (B - 1.0)) * (blocks - 1.0)
    draws = problem.solve(blocks, problem.gain_sd * rng.standard_normal((DRAWS, n)))[0]
    p, size = draws.shape[1], record.against.shape[2]
    if size:
        wrong = rng.multivariate_normal(np.zeros(size), model.base_cov, DRAWS, method="svd")
        sums = problem.weights[:, None, None] * record.against[:, :p]
        draws = draws - wrong @ np.einsum("iab,ibs->as", problem.response(*solution), sums).T
    return draws


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

    from scipy.optimize import brentq

    reach = np.linalg.eigvals(np.linalg.solve(metric, -cone)).real.max()
    ends = 0.0, (1.0 - 1e-9) / reach
    if at(ends[1]) @ cone @ at(ends[1]) > 0 or at(ends[1])[0] < 0:
        return np.zeros_like(theta)
    near = at(float(brentq(lambda s: at(s) @ cone @ at(s), *ends)))
    if near[0] <= 0:
        return np.zeros_like(theta)
    return np.concatenate([near, theta[4:] + cov[4:, :4] @ metric @ (near - theta[:4])])


def _table(fit: Fit[Payload]) -> str:
    """Return mass, centre and inertia with deviations, then what was fitted."""
    load, theta = fit.value, fit.parameters
    lines = [f"mass    {1e3 * load.mass:9.1f} +- {1e3 * fit.sd[0]:.1f} g"]
    for axis in range(3):
        slope = np.zeros(len(theta))
        if load.mass > 0:
            slope[[0, 1 + axis]] = -load.centre[axis] / load.mass, 1.0 / load.mass
        sd = np.sqrt(slope @ fit.cov @ slope)
        lines.append(f"centre {'xyz'[axis]}{1e3 * load.centre[axis]:8.1f} +- {1e3 * sd:.1f} mm")
    for name, value, sd, unit in list(zip(fit.names, theta, fit.sd, fit.units))[4:]:
        lines.append(f"{name:7s} {value: .3g} +- {sd:.2g} {unit}")
    return "\n".join([*lines, "flange axes; deviations of one sigma"])


def _notes(
    free: np.ndarray, theta: np.ndarray, load: Payload, sd: np.ndarray, gains: np.ndarray, gain_sd: float
) -> list[str]:
    """Return what the reader of a report must know beside the numbers."""
    notes = []
    if not np.array_equal(free, theta):
        notes.append(f"held at a bound (m >= 0, centre within {FARTHEST} m); without it m = {free[0]:.4g} kg")
    if len(theta) == 10 and inertia.principal_moments(load.pi).min() < -3.0 * sd[4:].max():
        notes.append("the inertia is not that of a body: the motion does not tell it; use mode static")
    if gain_sd:
        percent = "  ".join(f"{100 * g:+.1f}" for g in gains)
        notes.append(f"gains of the joints, of which {100 * gain_sd:g} % is expected [%]: {percent}")
    return notes

"""Payload identification at the flange from a log of an arm with a known torque model.

    tau - tau_model = (1 + g_i) Y_i(q, qd, qdd) pi + e_i,      g_i ~ N(0, 5 %)

Y contains the columns of the last link, moved to the flange, including load friction. pi contains the mass, the first
moment and, in mode "dynamic", the inertia. A Huber fit of pi alone determines the weights of rows and joints;
Gauss-Newton steps then estimate pi and the gains g_i. Both steps run twice, because weights computed without gains
treat gain errors as outliers. Theory: docs/theory/payload.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab._numbers import number
from armlab.dynamics import BaseParameters, base_parameters
from armlab.dynamics.base_parameters import LINK_SYMBOLS
from armlab.errors import ModelMismatchError, ShapeError, UnknownName
from armlab.estimation import Fit, Rows, least_squares
from armlab.estimation.linear_problem import LinearSolution, check_spread
from armlab.estimation.robust import block_seconds
from armlab.identify.record import MIN_SECONDS, MIN_SLIDE, MIN_TURN, Record, check_blocks, check_once, log_name
from armlab.identify.residuals import friction_signs, load_torque, model_residuals
from armlab.identify.solve import GainProblem
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import Payload, TorqueModel
from armlab.models.friction import FRICTION_TERMS, Friction
from armlab.robots import Robot, inertia

# If the residual ``y = tau - tau_model`` is fitted by ``y = A x + e``, an error d of the model's parameters adds
# ``-C d`` to e, with C = d tau_model / d parameters. All rows share one d, so more rows do not average it out.


CHUNK = 4096  # rows of the full regressor in memory
STEP = 1e-3  # logarithmic step of nonlinear parameters
RIPPLE: dict[str, Callable[..., np.ndarray]] = {"ripple cos": np.cos, "ripple sin": np.sin}


@dataclass(frozen=True, eq=False)
class ModelError:
    """Uncertain parameters of a model.

    `base`: base parameters, or None if the model covers only some joints. `cov`: (P, P) covariance of the parameters.
    """

    model: TorqueModel
    robot: Robot
    base: BaseParameters | None
    names: tuple[str, ...]
    cov: np.ndarray
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, known: TorqueModel | Fit[TorqueModel], robot: Robot) -> ModelError:
        """Return the uncertainty of a model: rigid body and friction for a fit, rigid body only for a model."""
        model = known.value if isinstance(known, Fit) else known
        names, cov = (known.names, _apart(known)) if isinstance(known, Fit) else (model.base_names, model.base_cov)
        bases = base_parameters(robot), base_parameters(robot, quasi_static=True)
        base = next((base for base in bases if base.names == tuple(model.base_names)), None)
        own = {name for terms in _own_names(robot, base).values() for name in terms}
        rigid = set() if base is None else set(base.names)
        index = [k for k, name in enumerate(names) if name in own | rigid]
        left_out = tuple(name for name in names if name not in own | rigid)
        return cls(model, robot, base, tuple(names[k] for k in index), cov[np.ix_(index, index)], left_out)

    def against(self, A: np.ndarray, data: Record, rows: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return the sums (J, w, P) of A_i^T C_i per joint, which determine how model errors affect the columns."""
        total = np.zeros((len(joints), A.shape[2], len(self.names)))
        at = {name: k for k, name in enumerate(self.names)}
        if self.base is not None:
            rigid = [at[name] for name in self.base.names]
            total[:, :, rigid] = _rigid(A, data, rows, joints, self.robot, self.base)
        for names, slope in self._own(data, set(self.names)):
            column = data.filter(slope, data.rate / 10.0)[rows]
            for i, joint in enumerate(joints):
                if names[joint] in at:
                    total[i, :, at[names[joint]]] = A[:, i].T @ column[:, joint]
        return total

    def _own(self, data: Record, wanted: set[str]) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
        """Yield, for each term, its parameter names (n,) and the derivative (N, n) of the torque with respect to it."""
        friction, ripple = self.model.friction, self.model.ripple
        for term, names in _own_names(self.robot, self.base).items():
            if wanted.isdisjoint(names):
                continue
            if term in RIPPLE:
                yield names, RIPPLE[term](ripple.cycles * data.q)
                continue
            if term == "load":
                yield names, friction_signs(self.model, data) * np.abs(load_torque(self.model, data))
                continue
            known, ends = FRICTION_TERMS[term], []
            for sign in (1.0, -1.0):
                fields = {name: getattr(friction, name) for name in known.fields}
                moved = {k: x + sign if known.column else x * np.exp(sign * STEP) for k, x in fields.items()}
                ends.append(_friction(replace(friction, **moved), data))
            width = 2.0
            if not known.column:
                value = getattr(friction, known.fields[0])
                width = 2.0 * np.sinh(STEP) * np.where(value > 0, value, 1.0)
            yield names, (ends[0] - ends[1]) / width


def _apart(fit: Fit[TorqueModel]) -> np.ndarray:
    """Return the covariance of a fit without the common gain error, which the parameter scale absorbs."""
    gain_cov = fit.value.gain_cov
    measured = np.flatnonzero(np.diag(gain_cov) > 0)
    if not len(measured):
        return fit.cov
    ones = np.ones(len(measured))
    common = 1.0 / (ones @ np.linalg.solve(gain_cov[np.ix_(measured, measured)], ones))
    curved = [term.name for term in FRICTION_TERMS.values() if not term.column or term.name == "load"]
    scaled = np.array([0.0 if name.split()[0] in curved else x for name, x in zip(fit.names, fit.parameters)])
    return fit.cov - common * np.outer(scaled, scaled)


def _own_names(robot: Robot, base: BaseParameters | None) -> dict[str, tuple[str, ...]]:
    """Return the parameter names (n,) of each joint-specific term."""
    names = {term: tuple(f"{term} {joint}" for joint in robot.joint_names) for term in (*FRICTION_TERMS, *RIPPLE)}
    return names if base is None else {**names, "offset": tuple(base.offset_names)}


def _friction(friction: Friction, data: Record) -> np.ndarray:
    """Return the friction torque (N, n) along a record, each segment starting at rest."""
    torque = np.empty_like(data.q)
    for a, b in data.segments:
        z = presliding(data.q[a:b], friction.delta, friction.resolution)
        torque[a:b] = friction.torque(data.qd[a:b], z)
    return torque


def _rigid(
    A: np.ndarray, data: Record, rows: np.ndarray, joints: np.ndarray, robot: Robot, base: BaseParameters
) -> np.ndarray:
    """Return the sums (J, w, p) of A_i^T C_i for the columns of the base parameters."""
    n, moves = robot.n, 0.0 if base.quasi_static else 1.0
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    total = np.zeros((len(joints), A.shape[2], len(base.names)))
    for a in range(0, len(rows), CHUNK):
        part = rows[a : a + CHUNK]
        Y = robot.chain.rigid_regressor(data.q[part], moves * data.qd[part], moves * qdd[part], robot.gravity)
        Y = Y @ base.lift[: 10 * n] + qdd[part][:, :, None] * base.lift[10 * n :]
        total += A[a : a + CHUNK].transpose(1, 2, 0) @ Y[:, joints].transpose(1, 0, 2)
    return total


EXPLAINED, CHANGED = 0.5, 3.0  # minimum explained fraction; largest ratio to the held-out residual without a load
EVERY = 4  # decimation; the filter's cut-off is at a tenth of the rate
APART = 0.02  # RMS position difference [rad or m] above which two records are different motions


@dataclass(frozen=True, eq=False)
class LoadRecord:
    """Regression ``y = A pi + e`` of the torque added by a load.

    `rows`: (M,) kept rows. `joints`: (j,) moving joints; the others are excluded because friction at rest is unknown.
    `A`: (M, j, 10) filtered columns of the load at the flange. `y`: (M, j) filtered residual of the model [N m].
    `against`: (j, 10, P) sums of A_i^T C_i per joint, with C the derivatives of the joint torque with respect to the
    model parameters; they determine how model errors affect the load. `sources`: name and SHA-256 of each log.
    """

    data: Record
    rows: np.ndarray
    joints: np.ndarray
    A: np.ndarray
    y: np.ndarray
    error: ModelError
    against: np.ndarray
    sources: tuple[str, ...]

    @classmethod
    def of(
        cls,
        table: Table | Sequence[Table],
        known: TorqueModel | Fit[TorqueModel],
        robot: Robot,
        without: Table | None = None,
    ) -> LoadRecord:
        """Build the regression from logs."""
        error = ModelError.of(known, robot)
        model = error.model
        tables = [table] if isinstance(table, Table) else table
        joints = moving_joints(tables, robot)
        found = model_residuals(table, model, joints.tolist(), robot)
        data, cutoff = found.data, found.data.rate / 10.0
        rows = np.concatenate([np.arange(a, b, EVERY) for a, b in data.segments])
        y, sources = data.filter(found.y[:, joints], cutoff), data.sources
        rubs = 1.0 + model.friction.load * found.s * np.sign(load_torque(model, data))
        columns = data.filter((_at_flange(data, robot) * rubs[:, :, None])[:, joints], cutoff)
        if without is None:
            A = columns[rows]
            return cls(data, rows, joints, A, y[rows], error, error.against(A, data, rows, joints), sources)
        other = model_residuals(without, model, joints.tolist(), robot)
        check_once((log_name(one, k), one.sha256) for k, one in enumerate([*tables, without], 1))
        shift = _shift(data, other.data)
        rows = rows[(rows >= shift) & (rows - shift < len(other.data.t))]
        A, there = columns[rows], rows - shift
        y = y[rows] - other.data.filter(other.y[:, joints], cutoff)[there]
        shared = error.against(A, data, rows, joints) - error.against(A, other.data, there, joints)
        return cls(data, rows, joints, A, y, error, shared, (*sources, *other.data.sources))

    def blocks(self, seconds: float) -> np.ndarray:
        """Return the block number (M,) of each row (from 0) for blocks of about `seconds`."""
        return np.unique(self.data.blocks(seconds)[self.rows], return_inverse=True)[1]


def moving_joints(tables: Sequence[Table], robot: Robot) -> np.ndarray:
    """Return the indices of joints that move enough for their friction to be determined; all joints if none moves
    enough."""
    if not tables or any(not isinstance(one, Table) or one["q"].shape[1:] != (robot.n,) for one in tables):
        return np.arange(robot.n)  # `prepare` raises
    ends = np.array([(np.nanmin(one["q"], axis=0), np.nanmax(one["q"], axis=0)) for one in tables if len(one)])
    least = np.where(robot.prismatic, MIN_SLIDE, MIN_TURN)
    moving = np.flatnonzero(ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0) >= least) if len(ends) else []
    return np.asarray(moving) if len(moving) else np.arange(robot.n)


def _at_flange(data: Record, robot: Robot) -> np.ndarray:
    """Return the unfiltered torque columns (N, n, 10) for a load at the flange."""
    moved = inertia.transform(robot.links[-1], np.eye(10)).T
    qdd = data.differentiate(data.qd)
    parts = [slice(a, a + CHUNK) for a in range(0, len(data.t), CHUNK)]
    regressor = robot.chain.rigid_regressor
    return np.concatenate([regressor(data.q[p], data.qd[p], qdd[p], robot.gravity)[:, :, -10:] @ moved for p in parts])


def _shift(data: Record, other: Record) -> int:
    """Return the shift [rows] for which data.q[i] = other.q[i - shift]; raise an error if the motions differ."""
    if len(data.segments) > 1 or len(other.segments) > 1 or abs(data.rate / other.rate - 1.0) > 1e-3:
        raise ShapeError(
            f"Expected one log with the load and one without, at equal rates and without gaps, got "
            f"{len(data.segments)} and {len(other.segments)} segments at {data.rate:.4g} and {other.rate:.4g} Hz. "
            "Record both logs again, or omit the log without the load."
        )
    size = len(data.t) + len(other.t)
    weight = 1.0 / np.maximum(np.std(data.qd, axis=0), 1e-3 * np.std(data.qd))
    one, two = (np.fft.rfft(x.qd * weight, size, axis=0) for x in (data, other))
    alike = np.fft.irfft((one * np.conj(two)).sum(axis=1), size)
    shift = int(np.argmax(alike))
    shift = shift - size if shift >= len(data.t) else shift
    first, last = max(shift, 0), min(len(data.t), len(other.t) + shift)
    apart = np.sqrt(np.mean((data.q[first:last] - other.q[first - shift : last - shift]) ** 2, axis=0))
    if (last - first) / data.rate < MIN_SECONDS or apart.max() > APART:
        raise ShapeError(
            f"Expected the same motion with and without the load for at least {MIN_SECONDS:g} s, got "
            f"{(last - first) / data.rate:.1f} s, in which joint {int(apart.argmax()) + 1} differs by "
            f"{apart.max():.2g} (RMS). Run the same motion twice, or omit the log without the load."
        )
    return shift


SIZES = {"static": 4, "dynamic": 10}
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
FARTHEST = 0.5  # m, largest distance of the centre of mass


def fit_payload(
    table: Table | Sequence[Table],
    model: TorqueModel | Fit[TorqueModel],
    robot: Robot,
    mode: str = "static",
    without: Table | None = None,
    *,
    gain_sd: float = 0.05,
) -> Fit[Payload]:
    """Identify the mass, centre of mass and, in mode "dynamic", inertia of a payload at the flange.

    Parameters
    ----------
    table : Table or sequence of Table
        Logs with the load and without contact, with columns q, qd, tau (N, n).
    model : TorqueModel or Fit of TorqueModel
        Model of the arm without the load. With a fit, the covariance includes the uncertainty of the arm's masses and
        friction; with a model, only that of the masses.
    robot : Robot
        The arm.
    mode : {"static", "dynamic"}
        "static": mass and first moment. "dynamic": all ten parameters, which requires fast wrist motion.
    without : Table, optional
        Log of the same motion without the load; model errors cancel in the difference.
    gain_sd : float
        Relative standard deviation of the torque constants; 0 if they are known exactly.

    Returns
    -------
    Fit of Payload
        Parameters m [kg], m c [kg m] and I [kg m^2] about the flange's origin, in flange axes. Bounds: m >= 0 and a
        centre of mass within 0.5 m; the covariance ignores these bounds.

    Raises
    ------
    ModelMismatchError
        The model belongs to another robot.
    UnknownName
        Unknown mode.
    NotExcited
        Motion that does not determine the parameters (the message names them), or a log that is too short.
    ShapeError
        NaN rows, a wrong number of joints, a different motion without the load, or `gain_sd` out of range.
    """
    value = model.value if isinstance(model, Fit) else model
    if not isinstance(value, TorqueModel):
        raise ModelMismatchError.no_model(model)
    value.check_robot(robot)
    if mode not in SIZES:
        raise UnknownName.among("mode of a payload fit", mode, SIZES)
    if not 0 <= number(gain_sd, "the gain standard deviation") < 1:
        raise ShapeError(f"Expected a gain standard deviation in [0, 1), got {gain_sd}. Pass 0.05 for 5 %.")
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
        notes.append(f"excluded because at rest: {', '.join(rest_names)}")
    notes += _unknown(record.error, isinstance(model, Fit))
    residuals = record.y - (1.0 + gains) * (record.A @ pi)
    share, doubts = _explained(record, residuals, robot)
    return Fit(
        value=value,
        names=LINK_SYMBOLS[:p],
        units=UNITS[:p],
        parameters=theta,
        cov=cov,
        sigma=found.sigma,
        residuals=residuals,
        n=len(record.y),
        excitation=found.excitation,
        summary=lambda fit: "\n".join(
            [_table(fit), share, *notes, f"{fit.n} samples", fit.excitation.text(), *fit.doubts]
        ),
        doubts=doubts,
    )


def _robust(record: LoadRecord, p: int, gains: np.ndarray, rest: np.ndarray, seconds: float) -> LinearSolution:
    """Return the Huber estimate of the first p parameters for given values of the gains minus 1 (n,) and of the other
    parameters (10,)."""
    block = record.blocks(seconds)
    check_blocks(block[-1] + 1, seconds, record.data)
    A = (1.0 + gains)[:, None] * record.A
    rows = list(Rows.of(A[:, :, :p], record.y - A[:, :, p:] @ rest[p:], block))
    return least_squares(rows, LINK_SYMBOLS[:p], what="payload", method="irls")


def _limits(record: LoadRecord, robot: Robot) -> np.ndarray:
    """Return the largest accepted standard deviations (10,): the parameters of loads that double the largest torque in
    the log."""
    torque, gravity = np.sqrt(np.mean(record.data.tau[:, record.joints] ** 2, axis=0)).max(), 9.81
    reach = np.linalg.norm(robot.frames[1:, :3, 3], axis=1).sum()
    return torque / gravity * np.array([1.0 / reach, *[1.0] * 3, *[reach] * 6])


def _left(record: LoadRecord, found: LinearSolution, gains: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the residuals (M, n) of a solution [N m]."""
    return record.y - (1.0 + gains) * (record.A @ np.concatenate([found.x, rest[len(found.x) :]]))


def _point(theta: np.ndarray) -> np.ndarray:
    """Return the ten parameters of a point mass with the mass and first moment `theta` (4,)."""
    if not theta[0] > 0:
        return np.concatenate([theta[:4], np.zeros(6)])
    return inertia.from_body(theta[0], theta[1:4] / theta[0], np.zeros((3, 3)))


def _possible(theta: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return the nearest parameters (in the metric of `cov`) in the cone ``m >= 0, |m c| <= 0.5 m`` (apex m = 0)."""
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
    """Return the mass, centre of mass and inertia with standard deviations as text, followed by the fit."""
    load, theta = fit.value, fit.parameters
    lines = [f"{name:6s} {x: .5g} +- {sd:.2g} {unit}" for name, x, sd, unit in zip(fit.names, theta, fit.sd, fit.units)]
    for axis in range(3):
        slope = np.zeros(len(theta))
        if load.mass > 0:
            slope[[0, 1 + axis]] = -load.centre[axis] / load.mass, 1.0 / load.mass
        sd = np.sqrt(slope @ fit.cov @ slope)
        lines.append(f"centre {'xyz'[axis]} {1e3 * load.centre[axis]:.1f} +- {1e3 * sd:.1f} mm")
    return "\n".join([*lines, "flange axes; standard deviations"])


def _unknown(error: ModelError, fitted: bool) -> list[str]:
    """Return notes about model uncertainty that the standard deviations do not include."""
    notes = []
    if error.base is None:
        notes.append(
            "not included in the standard deviations: uncertainty of the model's masses, which were "
            "identified from only some joints"
        )
    if not fitted:
        notes.append(
            "not included in the standard deviations: uncertainty of the model's friction; pass the fit "
            "instead of the model"
        )
    elif error.base is not None and error.left_out:
        notes.append(f"not included in the standard deviations: {', '.join(error.left_out)}")
    return notes


def _explained(record: LoadRecord, residuals: np.ndarray, robot: Robot) -> tuple[str, tuple[str, ...]]:
    """Return a sentence on the share of the arm model's residual explained by the load; add a doubt if it is small."""
    power = np.mean(record.y**2, axis=0)
    share = 1.0 - np.mean(residuals**2) / np.mean(power)
    left = f"{np.sqrt(np.mean(power)):.3g} N m RMS"
    said = f"the load explains {100 * share:.0f} % of the residual of the arm's model, {left}"
    more = np.sqrt(power) / record.error.model.quality.rms_cv[record.joints]
    worst = int(np.argmax(np.nan_to_num(more)))
    if share > EXPLAINED or more[worst] < CHANGED:
        return said, ()
    return said, (
        f"the residual of {robot.joint_names[record.joints[worst]]} is {more[worst]:.1f} times as large as without a "
        f"load, and the load explains only {100 * share:.0f} % of the total: "
        "the arm may carry a load elsewhere, or the log may contain a contact",
    )


def _notes(
    free: np.ndarray, theta: np.ndarray, load: Payload, sd: np.ndarray, gains: np.ndarray, gain_sd: float
) -> list[str]:
    """Return the notes of a report."""
    notes = []
    if not np.array_equal(free, theta):
        notes.append(f"load at a bound (m >= 0, centre within {FARTHEST} m); without bounds, m = {free[0]:.4g} kg")
    if len(theta) == 10 and inertia.principal_moments(load.pi).min() < -3.0 * sd[4:].max():
        notes.append(
            "the inertia is not physically consistent: use the nearest "
            "consistent load (identify.physically_consistent_load) or mode static"
        )
    if gain_sd:
        percent = "  ".join(f"{100 * g:+.1f}" for g in gains)
        notes.append(f"joint gains, prior standard deviation {100 * gain_sd:g} % [%]: {percent}")
    return notes

"""Identification of base parameters, friction and ripple of all joints by robust least squares, with covariance.

    tau_i = Y_i(q, qd, qdd) base + F_f,i(qd_i, s_i) + ripple_i(q_i) + e_i

Five stages, in this order:

1. Record: the logs are validated and cut at gaps (`identify.record`).
2. Regression: one zero-phase filter for torque and every regressor column, then decimation (`identify.regression`).
   The torque is divided by torque gains, which differ from 1 by a few percent per joint. The gains are fitted before
   and after stage 3.
3. Friction structure: for each joint, the type and width of the sign function of friction, the Stribeck speed and the
   friction terms are selected on held-out blocks with the rigid-body parameters fixed (`identify.friction_structure`).
4. Solution: all linear parameters are fitted by least squares within physical bounds, with joints weighted by the
   inverse of their residual standard deviation. The covariance comes from a block bootstrap, because the formal
   covariance is far too small for coloured residuals. Friction drift and the uncertainty of the friction structure are
   added (`identify.solve`).
5. Validation: models fitted without a fifth of the blocks provide held-out residuals, which pass through the
   estimator's own causal filter. The velocity-dependent torque covariance is fitted to these residuals and scaled to
   95.4 % coverage of 2 sigma (`identify.validation`).

`fit_gravity` fits only gravity, friction and offsets from slow motion; `identify.many` runs the same stages over any
number of logs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab._numbers import check_name, positive
from armlab.dynamics import BaseParameters, base_parameters
from armlab.dynamics.base_parameters import measured_joints
from armlab.errors import ModelMismatchError, ShapeError
from armlab.estimation import BlockSums, Fit, Prior, least_squares
from armlab.estimation.linear_problem import LinearSolution
from armlab.estimation.robust import METHODS, block_seconds
from armlab.estimation.tsqr import one_thread
from armlab.identify.drives.ripple import highest_seen, strongest_line
from armlab.identify.friction_structure import Chooser, choose_here
from armlab.identify.plausibility import check_gains, check_torques
from armlab.identify.record import (
    Record,
    check_blocks,
    delay_text,
    prepare,
    prepare_share,
    resting,
    torque_outliers,
    without_outliers,
)
from armlab.identify.regression import MIN_CYCLES, Design
from armlab.identify.solve import (
    ROBUST,
    alternate,
    best_cutoff,
    calibrated,
    covariance,
    gain_share,
    linearised,
    refined,
    short_blocks,
)
from armlab.identify.validation import FIFTHS, assess, places_of_joints, report, training
from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.friction import FrictionBound
from armlab.models.torque import Quality
from armlab.robots import Robot

CUTOFF = 10.0  # Hz, cut-off of the estimator's causal filter
FEWEST = 8.0  # independent segments needed to identify a nonlinear friction parameter
NO_LOAD = 0.02  # SD of the load friction of joints without a load term
UNKNOWN = 1e3  # SD of a parameter that is not in the prior
BAND, SLOW, QUANTILE = 5.0, 1.0, 0.99  # for `fit_gravity`: Hz; largest acceleration [rad/s^2, m/s^2] at this quantile

Progress = Callable[[int, int, str], None]


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
    cutoff: float | None = None,
    force: bool = False,
) -> Fit[TorqueModel]:
    """Identify the torque model of an arm from one or several logs of free motion.

    Parameters
    ----------
    table : Table or sequence of Table
        Logs with columns q, qd, tau (N, n) on the robot's clock, without contact.
    robot : Robot
        The arm that was recorded.
    method : {"irls", "lts", "wls", "ols"}
        "irls": joints weighted by their inverse residual standard deviation, rows by Huber's loss; isolated torque
        outliers are replaced. "lts": the same with least trimmed squares over blocks of a quarter of a second. "wls",
        "ols": not robust, with and without joint weights.
    seed : int
        Seed of the block bootstrap and of the random starts of "lts".
    progress : callable, optional
        Called with (done, total, what).
    prior : Fit of TorqueModel, optional
        Earlier fit of the same robot: its values are kept along directions that the log does not excite, and the report
        lists these directions. Without a prior, logs that leave a direction unexcited raise an error.
    joints : sequence of int, optional
        Zero-based indices of the joints with measured torque; all joints may move. Default: all. Estimators ignore the
        other joints, and momentum methods are unavailable for such a model.
    cutoff : float, optional, Hz
        Cut-off of the low-pass filter for torque and regressor. Default: selected by cross-validation from a tenth of
        the sampling rate (at most 25 Hz), 12 Hz and 6 Hz; the report states the reason. If the cut-off is below 10 Hz,
        the model's own filter has the same cut-off.
    force : bool
        Fit implausible torques and report the reasons as doubts. By default, implausible torques raise an error.

    Returns
    -------
    Fit of TorqueModel
        Parameters: the base parameters, then per joint viscous and Coulomb friction (one number, or one per direction),
        offset, and, if selected, stribeck, root, load and two ripple amplitudes. Rotor inertia and viscous, Coulomb and
        load friction are non-negative.

    Raises
    ------
    ShapeError
        NaN rows, a wrong number of joints, or a velocity that is not the derivative of the position. Torques that have
        the wrong sign, or differ by more than a factor of 3 from those implied by the masses in the robot file or by
        the other joints; the message lists the joints.
    NotExcited
        Joints or directions that the log does not determine; the message names them.
    UnknownName
        Unknown method.
    ModelMismatchError
        The prior belongs to another robot.

    References
    ----------
    Gautier (1991) (base parameters); Huber (1964); Rousseeuw (1984); Dahl (1968) (presliding); Kunsch (1989) (block
    bootstrap).
    """
    measured = None if joints is None else tuple(measured_joints(robot, joints))
    tell = progress or (lambda done, total, what: None)
    settings = FitSettings("torque model", method, seed, tell, prior, measured, cutoff=cutoff, force=force)
    return fit_model(table, robot, base_parameters(robot, joints=measured), settings)


@one_thread()
def fit_gravity(
    table: Table | Sequence[Table],
    robot: Robot,
    *,
    method: str = "irls",
    seed: int = 0,
    progress: Progress | None = None,
    prior: Fit[TorqueModel] | None = None,
    cutoff: float | None = None,
    force: bool = False,
) -> Fit[TorqueModel]:
    """Identify gravity, friction and offsets from one or several logs of slow free motion.

    Parameters
    ----------
    table : logs with columns q, tau (N, n), and qd if measured, without contact.
    robot : recorded arm, with the gravity vector of its mounting.
    method, seed, progress, prior, cutoff, force : as in `fit_dynamics`.

    Returns
    -------
    Fit of a quasi-static `models.TorqueModel`, without torques from link accelerations or velocities.

    Raises
    ------
    ShapeError : logs that `fit_dynamics` rejects, or motion so fast that inertia would be fitted as gravity.
    NotExcited : joints or directions that the log does not determine; the message names them.
    UnknownName : unknown method.

    References
    ----------
    Bagge Carlson and Haage (2017), YuMi low-level motion guidance, TFRT-7651, section 4.
    """
    tell = progress or (lambda done, total, what: None)
    settings = FitSettings("gravity model", method, seed, tell, prior, cutoff=cutoff, force=force)
    return fit_model(
        table, robot, base_parameters(robot, quasi_static=True), settings, lambda data: _check_slow(data, robot)
    )


def _check_slow(data: Record, robot: Robot) -> None:
    """Raise an error if the inertial torques of the motion are not negligible."""
    band = min(BAND, data.rate / 10.0)
    acceleration = np.quantile(np.abs(data.filter(data.differentiate(data.qd), band)), QUANTILE, axis=0)
    fast = np.flatnonzero(acceleration > SLOW)
    if len(fast):
        listed = ", ".join(f"{robot.joint_names[i]} ({acceleration[i]:.2g})" for i in fast)
        raise ShapeError(
            f"Expected slow motion with accelerations below {SLOW:g} rad/s^2 "
            f"or m/s^2, got higher accelerations for {listed}. Inertia "
            "would be fitted as gravity. Use fit_dynamics for this log, or record a slower motion."
        )


def fit_model(
    table: Table | Sequence[Table],
    robot: Robot,
    base: BaseParameters,
    settings: FitSettings,
    check: Callable[[Record], None] = lambda data: None,
) -> Fit[TorqueModel]:
    """Run the five stages for `fit_dynamics` and `fit_gravity`; `check` raises an error for unsuitable records."""
    settings.check(robot)
    settings.tell(0, 5, "checking the log")
    record, settings, rest = _moving(table, robot, settings)
    check(record)
    problem = make_problem(record, robot, base, settings)
    design, sums, solution = problem.design, problem.sums, problem.sums.solution
    cov, drift, between = covariance(design, solution, problem.length, settings.seed)
    settings.tell(4, 5, "held-out residuals")
    model = model_of(design, solution.x, cov, problem.gain_cov, drift)
    folds = fold_models(model, design, sums, problem.block, problem.length)
    before = None if settings.prior is None else settings.prior.value
    model = assess(model, folds, design.data, design.joints, before=before, drift=between)
    settings.tell(5, 5, "done")
    cov = cov + gain_share(solution, problem.gain_cov)
    fit = fit_of(model, design, solution, cov, record.measured, problem.band, problem.doubts)
    return _with_resting(fit, settings.prior, rest) if settings.prior is not None and rest.any() else fit


def _moving(
    table: Table | Sequence[Table], robot: Robot, settings: FitSettings
) -> tuple[Record, FitSettings, np.ndarray]:
    """Return the record, the settings for its moving joints, and a mask (n,) of resting joints covered by a prior."""
    none = np.zeros(len(robot.joint_names), dtype=bool)
    if settings.prior is None:
        return prepare(table, robot, settings.joints), settings, none
    record = prepare_share(table, robot, settings.joints)
    rest = resting(record.q, robot.prismatic)
    rest &= np.isin(np.arange(len(rest)), measured_joints(robot, settings.joints))
    if not rest.any():
        return record, settings, none
    moved = [i for i in measured_joints(robot, settings.joints) if not rest[i]]
    if not moved:
        return prepare(table, robot, settings.joints), settings, none  # raises
    return record, replace(settings, joints=tuple(moved)), rest


def _with_resting(fit: Fit[TorqueModel], prior: Fit[TorqueModel], rest: np.ndarray) -> Fit[TorqueModel]:
    """Return the fit, with the prior's parameters for the joints at rest (mask (n,)), and a note."""
    own, known, n = places_of_joints(fit), places_of_joints(prior), len(rest)
    if len(known) != n or len(own) != n - np.count_nonzero(rest):
        return fit
    size, found = len(fit.names), iter(own)
    order = np.concatenate([
        np.arange(len(fit.value.base_names)),
        *(size + known[i] if rest[i] else next(found) for i in range(n)),
        np.arange(own[-1][-1] + 1, size),
    ])  # fmt: skip
    cov = np.zeros((size + len(prior.names),) * 2)
    cov[:size, :size], cov[size:, size:] = fit.cov, prior.cov
    formal = cov.copy()
    formal[:size, :size] = fit.cov if fit.formal_cov is None else fit.formal_cov
    names, units = (*fit.names, *prior.names), (*fit.units, *prior.units)
    listed = ", ".join(str(i + 1) for i in np.flatnonzero(rest))
    return replace(
        fit,
        names=tuple(names[k] for k in order),
        units=tuple(units[k] for k in order),
        parameters=np.concatenate([fit.parameters, prior.parameters])[order],
        cov=cov[np.ix_(order, order)],
        formal_cov=formal[np.ix_(order, order)],
        notes=(*fit.notes, f"at rest, with friction from the prior: joint{'s' * int(rest.sum() > 1)} {listed}"),
    )


@dataclass(frozen=True, eq=False)
class FitSettings:
    """Options of a fit.

    `tell`: progress callback (done, total, what). `joints`: joints with measured torque; None for all. `chooser`:
    selects the friction structure, see `Design.choose_structure`. `cutoff`: cut-off frequency of the regression filter
    [Hz]; None selects it automatically. `force`: fit despite implausible torques.
    """

    what: str
    method: str
    seed: int
    tell: Progress
    prior: Fit[TorqueModel] | None = None
    joints: tuple[int, ...] | None = None
    chooser: Chooser = choose_here
    cutoff: float | None = None
    force: bool = False

    def corner(self, data: Record) -> float | None:
        """Return the given regression cut-off [Hz], if any; raise an error above a quarter of the rate."""
        if self.cutoff is None:
            return None
        corner, most = positive(self.cutoff, "cut-off [Hz]"), data.rate / 4.0
        if corner > most:
            raise ShapeError(
                f"Expected a cut-off frequency of at most {most:.4g} "
                f"Hz, a quarter of the sampling rate, got {corner:g} Hz. "
                "Reduce cutoff, or omit it to select the cut-off by cross-validation."
            )
        return corner

    def check(self, robot: Robot) -> None:
        """Raise an error for an unknown method, or a prior that is not a fit of this robot."""
        if self.prior is not None:
            if not isinstance(getattr(self.prior, "value", None), TorqueModel):
                found = type(self.prior).__name__
                raise ModelMismatchError(f"Expected an earlier fit as prior, got {found}. See Fit.load.")
            self.prior.value.check_robot(robot)
        check_name(self.method, "method of identification", METHODS)

    def solve(self, design: Design, block: np.ndarray) -> LinearSolution:
        """Solve for the linear parameters; `block` (M,) is the time block of each kept row."""
        limits = {
            "lower": design.layout.lower,
            "upper": design.layout.upper,
            "prior": self._prior(design),
            "seed": self.seed,
        }
        return least_squares(design.stream(block), design.layout.heads, what=self.what, method=self.method, **limits)

    def _prior(self, design: Design) -> Prior | None:
        if self.prior is None:
            return None
        known = dict(zip(self.prior.names, zip(self.prior.parameters, self.prior.sd)))
        values = [known.get(name, (0.0, UNKNOWN)) for name in design.layout.names]
        values = [(0.0, 1.0) if slope else value for value, slope in zip(values, design.layout.slopes)]
        return Prior(np.array([v for v, _ in values]), np.array([max(sd, 1e-12) for _, sd in values]))


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Regression with fixed nonlinear parameters, and the sums of its blocks.

    `gain_cov`: (J, J) covariance of the gains. `block`: (N,) block number of each sample; `length` blocks form one
    independent segment. `theta`: (p,) parameters at which the design was linearised. `band`: reason for the choice of
    the cut-off frequency. `doubts`: doubts about the torques, one sentence each.
    """

    design: Design
    gain_cov: np.ndarray
    sums: BlockSums
    block: np.ndarray
    length: int
    theta: np.ndarray
    band: str
    doubts: tuple[str, ...]


def make_problem(record: Record, robot: Robot, base: BaseParameters, settings: FitSettings) -> FitProblem:
    """Run stages 2 to 4: build the regression, select the friction structure, solve.

    Torque outliers are replaced twice; the second replacement uses the torque of the first fit.
    """
    method, prior = settings.method, settings.prior
    known = None if prior is None else (prior.value.gains, prior.value.gain_cov)
    used = np.isin(np.arange(len(robot.joint_names)), measured_joints(robot, settings.joints))
    doubts = check_torques(record, robot, used, settings.force)
    outliers = torque_outliers(record) if method in ROBUST else np.zeros(record.tau.shape, dtype=bool)
    first = replace(record, tau=without_outliers(record, outliers)) if outliers.any() else record

    settings.tell(1, 5, "building the regressor")
    design = Design.build(first, robot, base, joints=settings.joints, cutoff=settings.corner(record))
    band = "as given"
    if settings.cutoff is None:
        corner, band = best_cutoff(design, method)
        if corner < design.decimation.cutoff:
            design = Design.build(first, robot, base, joints=settings.joints, cutoff=corner, lines=design.lines)
    design = calibrated(design, method, known)[0]

    settings.tell(2, 5, "selecting the friction structure")
    design, theta, trust = alternate(design, method, settings.seed, chooser=settings.chooser)
    lines = _searched_lines(design, theta)
    if len(lines):
        kept = {"cutoff": design.decimation.cutoff, "structure": design.structure, "lines": lines}
        design = Design.build(design.data, robot, base, joints=settings.joints, **kept).with_gains(design.gains)
        design, theta, trust = alternate(design, method, settings.seed, chooser=settings.chooser, again=True)
    if outliers.any():
        model = model_of(design, theta, np.zeros((len(theta), len(theta))))
        design = design.with_torque(without_outliers(record, outliers, model))
        design, theta, trust = alternate(design, method, settings.seed, chooser=settings.chooser, again=True)
    design, theta = refined(design, theta, trust, method)
    design, theta, gain_cov = calibrated(design, method, known)
    doubts = doubts or check_gains(design, method, settings.force)

    settings.tell(3, 5, "covariance by block bootstrap")
    block, length = _blocks(design, theta, method)
    design, sums = _solved(design, theta, settings, block, length)
    return FitProblem(design, gain_cov, sums, block, length, theta, band, doubts)


LOWEST, HIGHEST, WAVES = 20.0, 500.0, 6.0  # rad/rad; minimum periods in a joint's range, to exclude gravity torques
HIGHEST_SLIDING = 3000.0  # rad/m
WORTH = 0.1  # minimum share of the residual power that a line must explain
AT_MOST = 20_000  # maximum samples per search


def _searched_lines(design: Design, theta: np.ndarray) -> np.ndarray:
    """Return the strongest ripple line (J,) of joints with unknown gears, or (0,) if no line was found."""
    data, joints = design.data, design.joints
    if design.geared or not np.any(design.cycles < MIN_CYCLES):
        return np.zeros(0)
    model = model_of(design, theta, np.zeros((len(theta), len(theta))))
    qdd, left = data.filter(data.differentiate(data.qd), data.rate / 10.0), np.empty_like(data.q)
    for a, b in data.segments:
        left[a:b] = data.tau[a:b] - model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b])
    some = slice(None, None, -(-len(left) // AT_MOST))
    lines, found = np.empty(len(joints)), False
    for i, joint in enumerate(joints):
        q, qd, y = data.q[some, joint], data.qd[some, joint], left[some, joint]
        most = HIGHEST_SLIDING if design.robot.prismatic[joint] else HIGHEST
        most = min(most, highest_seen(qd, data.rate))
        least = max(LOWEST, 2 * np.pi * WAVES / max(float(np.ptp(q)), 1e-9))
        line, share = strongest_line(q, qd, y, data.rate, least, most)
        lines[i] = line if share >= WORTH else most
        found |= share >= WORTH
    return lines if found else np.zeros(0)


def _solved(
    design: Design, theta: np.ndarray, settings: FitSettings, block: np.ndarray, length: int
) -> tuple[Design, BlockSums]:
    """Return the design with Jacobian columns and its block sums; poorly identified nonlinear parameters are fixed."""
    sloped, _ = linearised(design, theta, settings.method)
    sums = BlockSums.of(settings.solve(sloped, block[design.rows]))
    spread = sums.spread(length)[sloped.layout.slopes] >= FEWEST
    if spread.all():
        return sloped, sums
    free = sloped.free.copy()
    free[sloped.free] = spread
    sloped = design.with_slopes(theta, free)
    return sloped, BlockSums.of(settings.solve(sloped, block[design.rows]))


def _blocks(design: Design, theta: np.ndarray, method: str) -> tuple[np.ndarray, int]:
    """Return the block number (N,) of each sample, and the number of blocks per segment (several for "lts")."""
    data = design.data
    step = float(np.median(np.diff(data.t[design.rows])))
    seconds = min(block_seconds(design.residuals(theta), step), data.seconds / 20.0)
    block = data.blocks(short_blocks(data) if method == "lts" else seconds)
    count = int(block[-1]) + 1
    length = max(1, round(seconds * count / data.seconds))
    check_blocks(count // length, seconds, data)
    return block, length


def model_of(
    design: Design,
    theta: np.ndarray,
    cov: np.ndarray,
    gain_cov: np.ndarray | None = None,
    drift: np.ndarray | None = None,
) -> TorqueModel:
    """Convert linear parameters and the friction structure to a model; its covariance and quality are provisional.

    `drift`: (p, p) covariance of the parameter change until the next log; without it, the model does not contain the
    parameter covariance.
    """
    data, robot, base = design.data, design.robot, design.base
    n, p = len(robot.joint_names), len(base.names)
    unknown = np.full(n, np.nan)
    links, rotor = base.links_and_rotors(theta[:p])
    friction, ripple = design.drives(theta)
    tiny = np.full(n, 1e-18)
    gains, spread, load_sd = np.ones(n), np.zeros((n, n)), np.zeros(n)
    gains[design.joints] = design.gains
    load_sd[design.joints] = np.nan_to_num(design.load_sd(cov), nan=NO_LOAD)
    if gain_cov is not None:
        spread[np.ix_(design.joints, design.joints)] = gain_cov
    return TorqueModel(
        robot_name=robot.name,
        robot_hash=robot.hash,
        frames=robot.frames,
        prismatic=robot.prismatic,
        gravity=robot.gravity,
        link_parameters=links,
        rotor=rotor,
        friction=friction,
        ripple=ripple,
        covariance=velocity_covariance("const", tiny, tiny),
        bound=FrictionBound.of(friction),
        cutoff=min(CUTOFF, design.decimation.cutoff),
        base_names=base.names,
        base_values=theta[:p],
        base_cov=cov[:p, :p],
        gains=gains,
        gain_cov=spread,
        load_sd=load_sd,
        quality=Quality(np.std(data.tau, axis=0), rms=unknown, rms_cv=unknown, coverage=unknown, seconds=data.seconds),
        training=training(data.t, data.q, data.qd, data.segments),
        sources=data.sources,
        coupled=design.coupled(theta),
        quasi_static=base.quasi_static,
        parameters=None if drift is None else design.parameter_covariance(cov + drift),
    )


def fold_models(
    model: TorqueModel, design: Design, sums: BlockSums, block: np.ndarray, length: int
) -> list[tuple[TorqueModel, np.ndarray]]:
    """Return, for each fifth of the segments, the model fitted without it and a mask (N,) of its samples."""
    folds, block = [], np.minimum(block, len(sums.rows) - 1)  # the last block may have no kept rows
    for k in range(FIFTHS):
        kept = np.arange(len(sums.rows)) // length % FIFTHS != k
        theta = sums.solve(kept.astype(float))
        folds.append((replace(model_of(design, theta, sums.solution.cov), base_cov=model.base_cov), ~kept[block]))
    return folds


def fit_of(
    model: TorqueModel,
    design: Design,
    solution: LinearSolution,
    cov: np.ndarray,
    n: int,
    band: str,
    doubts: tuple[str, ...],
) -> Fit[TorqueModel]:
    """Return the fit of a model, with parameters in their units, notes and doubts."""
    late = tuple(delay_text(name, delay) for name, delay in design.data.delays.items())
    corner = f"regression below {design.decimation.cutoff:g} Hz ({band})"
    parameters, in_units, formal = design.in_units(solution.x, cov, solution.cov)
    return Fit(
        value=model,
        names=design.layout.names,
        units=design.layout.units,
        parameters=parameters,
        cov=in_units,
        formal_cov=formal,
        sigma=solution.sigma,
        residuals=design.residuals(solution.x),
        n=n,
        excitation=solution.excitation,
        summary=lambda fit: "\n".join([report(fit, solution), *fit.notes, *fit.doubts]),
        notes=(*design.data.notes, corner),
        doubts=(*doubts, *late),
    )

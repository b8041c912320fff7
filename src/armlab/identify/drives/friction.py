"""Drive terms in addition to the friction of `fit_dynamics`, fitted to its residuals and kept if they improve the fit.

The terms are warm-up (if one log lasts 20 minutes or more), torque ripple, and friction as a function of position and
speed. Each term is fitted per joint to the unfiltered residual of the preceding terms. Ripple with a period above twice
the spacing of the centres is modelled by the friction map instead. Theory: docs/theory/friction.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab._numbers import numbers
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.estimation.fit import value_of
from armlab.estimation.robust import block_seconds
from armlab.identify.drives.regularised import RIDGE as LINE_RIDGE
from armlab.identify.drives.regularised import held_out_error, refit, ridge_solution
from armlab.identify.drives.ripple import (
    GAIN,
    highest_seen,
    refine_lines,
    ripple_amplitudes,
    ripple_lines,
    ripple_regressor,
    select_lines,
    warn_of_fast_lines,
)
from armlab.identify.drives.warm_up import MIN_SECONDS, fit_warm_up
from armlab.identify.record import resting
from armlab.identify.residuals import ModelResiduals, model_residuals
from armlab.identify.validation import FIFTHS, assess_again, fold_of
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import FrictionMap, RadialBasis, RippleLines, speed_basis

SLOWEST = 0.02  # fraction of the peak speed below which samples are ignored for centres


def rbf_centres(q: np.ndarray, qd: np.ndarray, positions: int = 8, speeds: int = 5) -> RadialBasis:
    """Return centres that are evenly spaced over the position range and over the quantiles of speed for every joint.

    The widths are the distances between neighbouring centres.

    Parameters
    ----------
    q, qd : (N, n) positions [rad] and velocities [rad/s] of a record.
    positions, speeds : numbers of centres, at least 2.

    Raises
    ------
    ShapeError : inconsistent shapes, NaN, or fewer than 2 centres.
    NotExcited : a joint that does not move.
    """
    q, qd = _record(q, qd)
    if min(positions, speeds) < 2:
        raise ShapeError(f"Expected at least 2 positions and speeds, got {positions} and {speeds}.")
    peak = np.abs(qd).max(axis=0)
    still = np.flatnonzero((np.ptp(q, axis=0) <= 0) | (peak <= 0))
    if len(still):
        names = [f"joint {i + 1}" for i in still]
        raise NotExcited(
            f"Expected every joint to move, got no motion of {', '.join(names)}. Record a motion of all joints.",
            names,
            ["rest"] * len(names),
        )
    grid = np.linspace(q.min(axis=0), q.max(axis=0), positions, axis=1)
    levels = np.linspace(0.1, 1.0, speeds)
    quantiles = np.empty((q.shape[1], speeds))
    for i in range(q.shape[1]):
        speed = np.abs(qd[:, i])
        speed = np.quantile(speed[speed > SLOWEST * peak[i]], levels)
        apart = np.all(np.diff(speed) > SLOWEST * peak[i])  # the quantiles of a constant speed coincide
        quantiles[i] = speed if apart else peak[i] * levels
    widths, speed_widths = (np.asarray(np.gradient(centres, axis=1)) for centres in (grid, quantiles))
    return RadialBasis(grid, widths, quantiles, speed_widths)


def rbf_regressor(q: np.ndarray, qd: np.ndarray, basis: RadialBasis, z: np.ndarray | None = None) -> np.ndarray:
    """Return the basis functions of every joint (N, n, 2 P S), positive direction first; friction is regressor times k.

    Parameters
    ----------
    q, qd : (N, n) positions [rad] and velocities [rad/s].
    basis : radial basis of the same n joints.
    z : (N, n) presliding state; default: the sign of qd.

    Raises
    ------
    ShapeError : inconsistent shapes, NaN.
    """
    q, qd = _record(q, qd)
    z = np.sign(qd) if z is None else np.asarray(z, dtype=float)
    if q.shape[1] != basis.n or z.shape != q.shape or not np.isfinite(z).all():
        raise ShapeError(f"Expected finite q, qd and z of {basis.n} joints, got shapes {q.shape} and {z.shape}.")
    joints = [basis.functions(i, *(np.ascontiguousarray(x[:, i]) for x in (q, qd, z))) for i in range(basis.n)]
    return np.stack(joints, axis=1)


def _record(q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q, qd = numbers(q, "q", ShapeError), numbers(qd, "qd", ShapeError)
    if q.ndim != 2 or q.shape != qd.shape or not len(q) or not np.isfinite(q).all() or not np.isfinite(qd).all():
        raise ShapeError(
            f"Expected finite q and qd of equal shape (N, n), got {q.shape} and {qd.shape}. Drop NaN rows first."
        )
    return q, qd


RIDGE = 1e-3  # ridge of the friction map, relative to the mean diagonal
SHORTEST = 0.5  # s, shortest block
MOST_OF = 20  # minimum number of blocks
ROWS = 20000  # maximum rows per joint; longer records are decimated
SPEEDS = 8
HIGHEST = 1.25  # highest line of the search, relative to the model's ripple line at twice the gear ratio


@dataclass(frozen=True, eq=False)
class _DrivePart:
    """Coefficients (p,) of one joint, lines (L,), their covariance, and leave-one-fifth-out coefficients (5, p)."""

    name: str
    k: np.ndarray
    cycles: np.ndarray
    cov: np.ndarray
    folds: np.ndarray

    @property
    def names(self) -> list[str]:
        of_lines = [f"{self.name} line {number + 1}" for number in range(len(self.cycles))]
        return [f"{self.name} [{number}]" for number in range(len(self.k))] + of_lines

    @property
    def units(self) -> list[str]:
        return ["N m"] * len(self.k) + ["cycles/rev"] * len(self.cycles)


@dataclass(frozen=True, eq=False)
class _JointRows:
    """Decimated rows of one joint; for each row, the index of its half-second interval and of its fifth of the log."""

    q: np.ndarray
    qd: np.ndarray
    s: np.ndarray
    half: np.ndarray
    fifth: np.ndarray
    rate: float  # sampling rate of the log
    step: float  # s, interval between decimated rows

    def of(self, use: np.ndarray) -> _JointRows:
        """Return the selected rows (M,)."""
        parts = self.q[use], self.qd[use], self.s[use], self.half[use], self.fifth[use]
        return _JointRows(*parts, self.rate, self.step)

    def blocks(self, left: np.ndarray) -> np.ndarray:
        """Return the block number (M,) of each row; blocks are longer than the correlation time of the residual, but
        there are at least 20 of them."""
        count = int(np.ceil(block_seconds(left[:, None], self.step) / SHORTEST))
        return self.half // max(1, min(count, (int(self.half[-1]) + 1) // MOST_OF))

    def refit(
        self, A: np.ndarray, y: np.ndarray, ridge: float, slopes: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return coefficients and covariance; block lengths follow from the autocorrelation of residuals, not of y."""
        return refit(A, y, self.blocks(y - A @ ridge_solution(A, y, ridge)[0]), ridge, slopes)

    def folds(self, A: np.ndarray, others: np.ndarray, ridge: float) -> np.ndarray:
        """Fit coefficients (5, p), each leaving out one fifth, to `others` (5, M), the residuals of models fitted
        without that fifth."""
        used = [self.fifth != number for number in range(FIFTHS)]
        return np.array([ridge_solution(A[use], y[use], ridge)[0] for use, y in zip(used, others)])


def fit_friction(table: Table | Sequence[Table], model: TorqueModel | Fit[TorqueModel]) -> Fit[TorqueModel]:
    """Fit warm-up, torque ripple and position-dependent friction to model residuals, and keep the terms that reduce
    them.

    Parameters
    ----------
    table : one or several logs of free motion with columns q, qd, tau (N, n); warm-up needs a log of 20 minutes. Joints
        at rest, as in `friction_run`, keep their current terms.
    model : identified torque model of the recorded arm, or its fit.

    Returns
    -------
    Fit of `models.TorqueModel`: the model with the terms that improve it, or the unchanged model. Torque covariance
    and quality are reassessed: terms fitted without a fifth of the log are validated on that fifth. If the given model
    was identified from the same log, its excess squared error on held-out rows is added to the squared errors. The
    parameters are the coefficients of the terms, in N m, and the ripple lines; their covariance combines the scatter
    between blocks and the ridge bias. For the parameters of warm-up, see `fit_warm_up`.

    Raises
    ------
    ShapeError : NaN rows, a wrong joint count, or a velocity that is not the derivative of position.
    NotExcited : a short log, all joints at rest, or a joint that rarely slides beyond its presliding distance.

    References
    ----------
    Bagge Carlson, Robertsson and Johansson (IROS 2015; ACC 2017, LPV spectral estimation).
    """
    model = value_of(model)
    found = model_residuals(table, model)
    data = found.data
    if len(data.segments) == 1 and data.seconds >= MIN_SECONDS:
        model = fit_warm_up(table, model).value
        found = model_residuals(table, model)
    half = data.blocks(SHORTEST)
    rest, anywhere = resting(data.q, model.prismatic), np.linspace(-1.0, 1.0, len(data.t))[:, None]
    basis = rbf_centres(np.where(rest, anywhere, data.q), np.where(rest, anywhere, data.qd))
    fifth, peaks = fold_of(data), np.where(rest, 1.0, np.abs(data.qd).max(axis=0))
    spread = [speed_basis(0.0, float(peak), SPEEDS) for peak in peaks]
    lines: dict[int, _DrivePart] = {}
    maps: dict[int, _DrivePart] = {}
    every = max(1, len(data.t) // ROWS)
    highest = _highest(model, data.qd[::every], data.rate)
    for i in np.flatnonzero(~rest).tolist():
        q, qd, s, y = (np.ascontiguousarray(x[::every, i]) for x in (data.q, data.qd, found.s, found.y))
        rows = _JointRows(q, qd, s, half[::every], fifth[::every], data.rate, every / data.rate)
        lowest = np.pi / float(basis.position_widths[i, 0])
        others = np.tile(y, (FIFTHS, 1))
        over = basis.functions(i, q, qd, s)
        clean = y - over @ ridge_solution(over, y, RIDGE)[0]
        ripple = _ripple(rows, y, clean, (lowest, float(highest[i])), float(peaks[i]), f"ripple joint {i + 1}")
        if ripple is not None:
            part, spread[i] = ripple
            lines[i] = part
            A = ripple_regressor(q, qd, s, part.cycles, *spread[i])
            y, others = y - A @ part.k, others - part.folds @ A.T
        block = rows.blocks(y)
        if held_out_error(over, y, block, RIDGE) < (1.0 - GAIN) * held_out_error(over[:, :0], y, block):
            k, cov = rows.refit(over, y, RIDGE)
            maps[i] = _DrivePart(f"map joint {i + 1}", k, np.zeros(0), cov, rows.folds(over, others, RIDGE))

    def with_parts(pick: Callable[[_DrivePart], np.ndarray]) -> TorqueModel:
        of_lines = {i: (part.cycles, pick(part)) for i, part in lines.items()}
        own_map = _map(basis, {i: pick(part) for i, part in maps.items()}, model, rest) if maps else model.friction_map
        return replace(model, lines=_lines(of_lines, spread) if lines else model.lines, friction_map=own_map)

    extended = model
    if lines or maps:
        folds = [with_parts(lambda part, number=number: part.folds[number]) for number in range(FIFTHS)]
        extended = assess_again(model, with_parts(lambda part: part.k), folds, data)
    return _fit(table, extended, [*lines.values(), *maps.values()], found)


def _highest(model: TorqueModel, qd: np.ndarray, rate: float) -> np.ndarray:
    """Return the highest ripple line (n,) to search for in each joint; warn of aliasing above this line."""
    wanted = HIGHEST * model.ripple.cycles
    seen = np.array([highest_seen(column, rate) for column in qd.T])
    hidden = np.flatnonzero(seen < wanted)
    if len(hidden):
        warn_of_fast_lines({f"joint {i + 1}": float(seen[i]) for i in hidden}, rate)
    return np.minimum(wanted, seen)


def _ripple(
    rows: _JointRows,
    y: np.ndarray,
    clean: np.ndarray,
    ends: tuple[float, float],
    peak: float,
    name: str,
) -> tuple[_DrivePart, tuple[np.ndarray, np.ndarray]] | None:
    """Return the selected ripple lines of one joint, with their coefficients and Gaussian kernels over speed.

    Lines are selected from `clean`, the residual after position-dependent friction, and fitted to the rows in which no
    line aliases. These rows limit the speed range of the Gaussians.
    """
    cycles = ripple_lines(rows.q, rows.qd, clean, rows.rate, ends[1], max(ends[0], 1.0))
    if not len(cycles):
        return None
    fastest = 0.5 * np.pi * rows.rate / float(cycles.max())
    slow, spread = np.abs(rows.qd) < fastest, speed_basis(0.0, min(peak, fastest), SPEEDS)
    rows, y, clean = rows.of(slow), y[slow], clean[slow]
    amplitudes = ripple_amplitudes(rows.qd, rows.s, *spread)
    A = ripple_regressor(rows.q, rows.qd, rows.s, cycles, *spread)
    kept = select_lines(A, clean, amplitudes.shape[1] * 2, rows.blocks(clean))
    if not kept.any():
        return None
    cycles, A, slopes = refine_lines(rows.q, amplitudes, y, cycles[kept])
    k, cov = rows.refit(A, y, LINE_RIDGE, slopes)
    return _DrivePart(name, k, cycles, cov, rows.folds(A, np.tile(y, (FIFTHS, 1)), LINE_RIDGE)), spread


def _lines(
    lines: dict[int, tuple[np.ndarray, np.ndarray]], spread: Sequence[tuple[np.ndarray, np.ndarray]]
) -> RippleLines:
    return RippleLines(
        joint=np.concatenate([np.full(len(cycles), i) for i, (cycles, _) in lines.items()]),
        cycles=np.concatenate([cycles for cycles, _ in lines.values()]),
        speeds=np.stack([speeds for speeds, _ in spread]),
        widths=np.stack([widths for _, widths in spread]),
        coefficients=np.concatenate([k.reshape(-1, 2, SPEEDS, 2) for _, k in lines.values()]),
    )


def _map(basis: RadialBasis, maps: dict[int, np.ndarray], model: TorqueModel, rest: np.ndarray) -> FrictionMap:
    """Return the friction map of the moving joints; those at rest (mask (n,)) keep the model's map."""
    before = model.friction_map
    kept = rest if before is not None and before.basis.size == basis.size else np.zeros_like(rest)
    if before is not None and kept.any():
        both = zip(vars(basis).items(), vars(before.basis).values())
        basis = RadialBasis(**{name: np.where(kept[:, None], old, new) for (name, new), old in both})
    coefficients = np.zeros((basis.n, 2, basis.positions.shape[1], basis.speeds.shape[1]))
    for i, k in maps.items():
        coefficients[i] = k.reshape(coefficients[i].shape)
    if before is not None:
        coefficients[kept] = before.coefficients[kept]
    return FrictionMap(basis, coefficients)


def _fit(
    table: Table | Sequence[Table], model: TorqueModel, parts: list[_DrivePart], before: ModelResiduals
) -> Fit[TorqueModel]:
    names = tuple(name for part in parts for name in part.names)
    cov, at = np.zeros((len(names), len(names))), 0
    for part in parts:
        size = len(part.cov)
        cov[at : at + size, at : at + size] = part.cov
        at += size
    residuals = model_residuals(table, model).y
    started = np.std(before.y, axis=0)

    def report(fit: Fit[TorqueModel]) -> str:
        lines, part = fit.value.lines, fit.value.friction_map
        rows = ["joint  residual before  after [N m]  ripple lines [cycles/rev]  over position"]
        for i in range(fit.value.n):
            cycles = [] if lines is None else [f"{c:.1f}" for c in lines.cycles[lines.joint == i]]
            over = "yes" if part is not None and part.coefficients[i].any() else "-"
            after = np.std(fit.residuals[:, i])
            rows.append(f"{i + 1:5}  {started[i]:15.4f}  {after:11.4f}  {', '.join(cycles) or '-':>25}  {over:>13}")
        return "\n".join(rows)

    return Fit(
        value=model,
        names=names,
        units=tuple(unit for part in parts for unit in part.units),
        parameters=np.concatenate([np.zeros(0), *(np.append(part.k, part.cycles) for part in parts)]),
        cov=cov,
        sigma=np.std(residuals, axis=0),
        residuals=residuals,
        n=len(residuals),
        excitation=Excitation.of_covariance(cov, names),
        summary=report,
    )

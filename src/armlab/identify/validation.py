"""How good a torque model is: held-out residuals, their covariance over velocity, and the report per joint."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import ModelMismatchError, NotExcited, ShapeError
from armlab.estimation import Fit
from armlab.estimation.linear_problem import LinearSolution
from armlab.identify.record import Record, pieces, torque_outliers, with_velocity, without_outliers
from armlab.identify.residuals import begun, fit_velocity_covariance, momentum_noise, stretches
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import FrictionBound
from armlab.models.torque import SPEED_EDGES, Training, VelocityCovariance
from armlab.signals import central_diff, lowpass_offline

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.models import TorqueModel


# Whether a log asks a model for what it was never shown: positions, speeds and rest outside the training data.
#
# A held-out error belongs to data like the training data. Per joint it is counted how often a log leaves the trained
# range of position and the trained speeds; and, for the arm as a whole, how much it rests: friction at rest is anything
# within its bounds, and a model trained in motion says nothing about it.


BESIDE = 0.02  # of the trained range, that position may go beyond it
RARE = 0.005  # share of training below which a bin of speed was not trained
ALLOWED = 0.05  # share of samples outside that need no warning
MORE, LONGER = 3.0, 2.0  # times the share, and the length, of rest in training
REST = 0.01  # of the peak speed; all joints below it are at rest


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """Differences between a log and the data that a model was fitted to.

    Attributes
    ----------
    joint_names : tuple of str, length n
        Names of the joints.
    outside : array, shape (n,)
        Share of samples outside the trained range of position by more than 2 % of it.
    unseen_speed : array, shape (n,)
        Share of samples at speeds that hold less than 0.5 % of the training data.
    rest_share : float
        Share of rest in this log.
    longest_rest : float, s
        Longest rest in this log.
    trained_rest_share : float
        Share of rest in the training data.
    trained_longest_rest : float, s
        Longest rest in the training data.
    warnings : tuple of str
        Sentences; empty when the model may be used on this log.
    """

    joint_names: tuple[str, ...]
    outside: np.ndarray
    unseen_speed: np.ndarray
    rest_share: float
    longest_rest: float
    trained_rest_share: float
    trained_longest_rest: float
    warnings: tuple[str, ...]

    def text(self) -> str:
        """Return a table per joint, a line about rest, and the warnings."""
        width = max(map(len, self.joint_names))
        lines = [f"{'joint':>{width}}  position outside  speed not trained"]
        for name, outside, unseen in zip(self.joint_names, self.outside, self.unseen_speed):
            lines.append(f"{name:>{width}}  {100 * outside:14.1f} %  {100 * unseen:15.1f} %")
        lines.append(
            f"at rest {100 * self.rest_share:.0f} % (longest {self.longest_rest:.2f} s); "
            f"in training {100 * self.trained_rest_share:.0f} % (longest {self.trained_longest_rest:.2f} s)"
        )
        return "\n".join([*lines, *(f"warning: {sentence}" for sentence in self.warnings)])


def training(
    t: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    segments: tuple[tuple[int, int], ...],
    peak: np.ndarray | None = None,
) -> Training:
    """Return the ranges of the data that a model is fitted to.

    `t`: (N,) time [s]. `q`, `qd`: (N, n) position and velocity. `segments`: (start, stop) rows of each piece without a
    gap. `peak`: (n,) speed that counts as the largest; that of the data when left out.
    """
    scale = np.abs(qd).max(axis=0) if peak is None else peak
    rest_share, longest = _rest(t, qd, scale, segments)
    return Training(q.min(axis=0), q.max(axis=0), scale, _bins(qd, scale), rest_share, longest)


def extrapolation(model: TorqueModel, table: Table) -> Extrapolation:
    """Compare a log with the data that `model` was fitted to.

    Warned is of joints with more than 5 % of the samples outside the trained positions or speeds, and of a log that
    rests three times the share of training with a stretch twice as long as any in it.

    Parameters
    ----------
    model : identified torque model.
    table : log with q (N, n), and qd where it was measured.

    Raises
    ------
    ShapeError : another number of joints, NaN rows, fewer than two rows.
    """
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    table = with_velocity(table)
    q, qd, t, known = table["q"], table["qd"], table.t, model.training
    if q.shape[1:] != (model.n,) or qd.shape != q.shape or len(t) < 2:
        raise ShapeError(
            f"Expected q and qd of {model.n} joints in at least two rows, got {q.shape} and {qd.shape}. "
            "Give a log of the robot that the model belongs to."
        )
    bad = np.flatnonzero(~(np.isfinite(q) & np.isfinite(qd)).all(axis=1))
    if len(bad):
        raise ShapeError(
            f"Expected finite q and qd, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}. "
            "Drop them with table.dropna; without qd it takes 100 rows without a gap to compute it."
        )
    margin = BESIDE * (known.q_max - known.q_min)
    outside = np.mean((q < known.q_min - margin) | (q > known.q_max + margin), axis=0)
    unseen = np.sum(np.where(known.speed_share < RARE, _bins(qd, known.qd_peak), 0.0), axis=1)
    cuts = np.flatnonzero(np.diff(t) > 1.5 * np.median(np.diff(t))) + 1
    edges = [0, *cuts.tolist(), len(t)]
    rest, longest = _rest(t, qd, known.qd_peak, tuple(pairwise(edges)))
    names = table.columns["q"].labels or tuple(f"joint {i + 1}" for i in range(model.n))
    warned = _warnings(names, outside, unseen, (rest, longest), known)
    return Extrapolation(names, outside, unseen, rest, longest, known.rest_share, known.longest_rest, warned)


def _warnings(
    names: tuple[str, ...], outside: np.ndarray, unseen: np.ndarray, rest: tuple[float, float], known: Training
) -> tuple[str, ...]:
    found = []
    for shares, what in ((outside, "outside the trained positions"), (unseen, "at speeds that were not trained")):
        far = np.flatnonzero(shares > ALLOWED)
        if len(far):
            listed = ", ".join(f"{names[i]} ({100 * shares[i]:.0f} %)" for i in far)
            found.append(
                f"Expected motion like that of training, got samples {what}: {listed}. Train with such motion."
            )
    if rest[0] > MORE * known.rest_share and rest[1] > LONGER * known.longest_rest:
        found.append(
            f"Expected as little rest as in training ({100 * known.rest_share:.0f} %, longest "
            f"{known.longest_rest:.2f} s), got {100 * rest[0]:.0f} %, longest {rest[1]:.2f} s: friction at rest is "
            "only known to lie inside bounds. Judge the model by the rows in motion, or train with rest."
        )
    return tuple(found)


def _bins(qd: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """Return the share (n, 2 bins) of samples in each bin of speed, negative direction first, slowest bin first."""
    bins = len(SPEED_EDGES)
    number = np.searchsorted(SPEED_EDGES[1:], np.abs(qd) / np.where(peak > 0, peak, 1.0), side="left")
    number = number + bins * (qd > 0)
    return np.stack([np.bincount(column, minlength=2 * bins) for column in number.T]) / len(qd)


def _rest(
    t: np.ndarray, qd: np.ndarray, peak: np.ndarray, segments: tuple[tuple[int, int], ...]
) -> tuple[float, float]:
    """Return the share of samples at which all joints rest, and the longest stretch of them [s]."""
    still = np.all(np.abs(qd) < REST * peak, axis=1)
    longest = 0.0
    for a, b in segments:
        ends = np.flatnonzero(np.diff(np.concatenate([[0], still[a:b].astype(int), [0]])))
        for first, stop in ends.reshape(-1, 2) + a:
            longest = max(longest, float(t[stop - 1] - t[first]))
    return float(np.mean(still)), longest


# The parameters of a torque model: value, deviation, unit, and the combination that each stands for.


def parameter_rows(fit: Fit[TorqueModel]) -> list[tuple[str, str, str, str]]:
    """Return value, deviation, unit and name of each parameter as words: base parameters, then those of the drives."""
    columns = zip(fit.parameters, fit.sd, fit.units, fit.names, strict=True)
    return [(f"{value:.4g}", f"{sd:.2g}", unit, name) for value, sd, unit, name in columns]


def parameter_text(fit: Fit[TorqueModel]) -> str:
    """Return one line per parameter; numbers first, since the combinations are of any length."""
    head, rows = ("value", "sd", "unit", "parameter"), parameter_rows(fit)
    value, sd, unit = (max(map(len, column)) for column in list(zip(head, *rows))[:3])
    lines = [f"{head[0]:>{value}}    {head[1]:<{sd}}  {head[2]:<{unit}}  {head[3]}"]
    lines += [f"{x:>{value}} +- {deviation:<{sd}}  {of:<{unit}}  {name}" for x, deviation, of, name in rows]
    return "\n".join(lines)


FIFTHS, STRETCHES = 5, 20

SETTLED = 0.01  # variance of the presliding state below which friction is known from motion
ALPHA2_BOUNDS = (0.25, 25.0)
HALF = 1.0  # s, stretches of the two halves on which the coverage is judged
UNMEASURED = 1e12  # (N m)^2 of a joint whose torque is not measured
FEWEST = 100  # rows of sliding in either half
FAST = 0.1  # rad/s: above it the bound on friction holds the model's error in motion


def held_out(folds: list[tuple[TorqueModel, np.ndarray]], data: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return causal residuals (N, n) of models that did not see the row, and a mask (N, n) of joints in motion.

    A joint is in motion when it has slid far enough since its last reversal or rest that its friction is known.

    `folds`: models and the rows (N,) that each did not see.
    """
    residuals = np.full(data.q.shape, np.nan)
    moving = np.zeros(data.q.shape, dtype=bool)
    for model, rows in folds:
        torque, variance = _causal(model, data, rows)
        residuals[rows] = torque[rows]
        moving[rows] = variance[rows] <= SETTLED * model.friction.static**2
    return residuals, moving & np.isfinite(residuals)


def _causal(model: TorqueModel, data: Record, rows: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Run the estimator's own residual filter; return filtered residuals and the variance from unknown friction.

    Of a log long enough for warm-up only the stretches with the rows (N,) are run, as warm as the log before made them.
    """
    torque, variance = np.full((2, *data.q.shape), np.nan)
    pieces = data.segments if rows is None or model.warm_up is None else stretches(rows, data)
    for one, a, b in begun(model, data, pieces):
        found = one.estimator_kernel(np.ones(6)).run(data.q[a:b], data.qd[a:b], data.tau[a:b], data.dt[a:b])
        torque[a:b], variance[a:b] = found[3], found[4]
    return torque, variance


def assess(
    model: TorqueModel,
    folds: list[tuple[TorqueModel, np.ndarray]],
    data: Record,
    joints: np.ndarray | None = None,
    unseen: np.ndarray | None = None,
) -> TorqueModel:
    """Return the model with its torque covariance and quality figures.

    Both residuals of the quality, of the fit and held out, pass the estimator's causal filter and count each joint
    while it moves: so they may be compared. The coverage is honest: covariance and scale are fitted to one half of the
    stretches of time and judged on the other, both ways; the model gets those of all. Joints whose torque is not
    measured have no figures, and a deviation so large that no estimator listens to them.

    `joints`: whose torque is measured; all when left out. `unseen`: (n,) variance [(N m)^2] that held-out residuals
    have beyond those of `folds`, whose models share a part that was fitted to these rows too.
    """
    errors, moving = held_out(folds, data)
    if unseen is not None:
        count = np.maximum(moving.sum(axis=0), 1)
        power = np.sum(errors**2, axis=0, where=moving) / count
        errors = errors * np.sqrt(1.0 + unseen / np.maximum(power, 1e-300))
    measured = np.ones(model.n, dtype=bool) if joints is None else np.isin(np.arange(model.n), joints)
    moving &= measured
    odd = (data.blocks(HALF) % 2 == 1)[:, None]
    halves = moving & odd, moving & ~odd
    _check_sliding(measured, np.min([half.sum(axis=0) for half in halves], axis=0))
    covariance = _covariance(errors, data.qd, moving)
    inside = np.zeros(model.n)
    for half in halves:
        other = _covariance(errors, data.qd, moving & ~half)
        inside += np.sum(half & (errors**2 < 4.0 * other.variance(data.qd)), axis=0)
    count = np.where(measured, moving.sum(axis=0), np.nan)
    quality = replace(
        model.quality,
        rms=np.sqrt(np.sum(_causal(model, data)[0] ** 2, axis=0, where=moving) / count),
        rms_cv=np.sqrt(np.sum(errors**2, axis=0, where=moving) / count),
        coverage=inside / count,
    )
    bound = _bound(model, covariance, errors, data.qd, moving)
    judged = replace(model, covariance=covariance, bound=bound, quality=quality)
    if not measured.all():
        return judged  # the momentum of an arm takes all torques
    return replace(judged, momentum=momentum_noise(judged, folds, np.where(moving, errors, np.nan), data))


def assess_again(before: TorqueModel, model: TorqueModel, folds: list[TorqueModel], data: Record) -> TorqueModel:
    """Return a model with parts added to one that was identified before, with torque covariance and quality of its own.

    Where `before` was identified from one of these logs, its own parameters have seen the rows that `folds` have not:
    what it lost on held-out rows, ``rms_cv^2 - rms^2``, is added to their errors.

    `folds`: with the parts fitted without each fifth of `fold_of`. `data`: the record; single spikes of its torque do
    not count, as in `fit_dynamics`.
    """
    data = replace(data, tau=without_outliers(data, torque_outliers(data), before))
    fold, quality = fold_of(data), before.quality
    known = np.isfinite(quality.rms_cv)
    measured = np.flatnonzero(known) if known.any() else None
    lost = np.where(known, np.maximum(quality.rms_cv**2 - quality.rms**2, 0.0), 0.0)
    seen = not set(data.sources).isdisjoint(before.sources)
    quality = replace(quality, torque_sd=np.std(data.tau, axis=0), seconds=data.seconds)
    sources = (*before.sources, *(source for source in data.sources if source not in before.sources))
    pairs = [(one, fold == k) for k, one in enumerate(folds)]
    model = replace(model, quality=quality, sources=sources)
    return assess(model, pairs, data, measured, lost if seen else None)


def fold_of(data: Record) -> np.ndarray:
    """Return which fifth (N,), from 0, each row is in: twenty stretches of time go to the fifths in turn."""
    return data.blocks(data.seconds / STRETCHES) % FIFTHS


def _check_sliding(measured: np.ndarray, rows: np.ndarray) -> None:
    """Refuse joints whose friction is hardly ever known: fewer than 100 rows in either half of the log."""
    few = np.flatnonzero(measured & (rows < FEWEST))
    if len(few):
        names = [f"joint {i + 1}" for i in few]
        spread = [f"{rows[i]} rows" for i in few]
        listed = ", ".join(f"{name} ({got})" for name, got in zip(names, spread))
        raise NotExcited(
            f"Expected every joint to slide, past its presliding, in {2 * FEWEST} rows at least, evenly over the log, "
            f"got less for {listed}: its errors in motion cannot be judged. Let it move further between "
            "its reversals.",
            names,
            spread,
        )


def _covariance(errors: np.ndarray, qd: np.ndarray, moving: np.ndarray) -> VelocityCovariance:
    """Return the covariance over velocity of each joint from its rows in motion, scaled so that 2 sigma hold 95.4 %."""
    unknown = VelocityCovariance("exp", np.array([UNMEASURED]), np.array([UNMEASURED]), np.ones(1))
    parts = [
        fit_velocity_covariance(errors[rows, i : i + 1], qd[rows, i : i + 1], "exp").value if rows.any() else unknown
        for i, rows in enumerate(moving.T)
    ]
    C0, Cinf, shape = (np.concatenate([getattr(part, name) for part in parts]) for name in ("C0", "Cinf", "shape"))
    plain = VelocityCovariance("exp", C0, Cinf, shape)
    ratio = (errors**2 / plain.variance(qd))[moving]
    return replace(plain, alpha2=float(np.clip(np.quantile(ratio, 0.954) / 4.0, *ALPHA2_BOUNDS)))


def _bound(
    model: TorqueModel, covariance: VelocityCovariance, e: np.ndarray, qd: np.ndarray, moving: np.ndarray
) -> FrictionBound:
    """Return the bound on friction near rest; its floor is what 99 % of the errors in motion have beyond 2 sigma."""
    fast = np.where(moving & (np.abs(qd) > FAST), np.abs(e), np.nan)
    sigma = np.sqrt(covariance.alpha2 * covariance.Cinf)
    known = np.isfinite(fast).any(axis=0)
    largest = np.where(known, np.nanquantile(np.where(known, fast, 0.0), 0.99, axis=0), 0.0)
    return FrictionBound.of(model.friction, np.maximum(largest - 2.0 * sigma, 0.0))


def predict(model: TorqueModel, table: Table) -> Table:
    """Return the log with tau, tau_model and tau_sigma (N, n) [N m]: measured, modelled, and how surely.

    Measured and modelled torque pass a zero-phase low-pass at the model's cut-off: to that band its covariance belongs.
    Where the arm has rested, tau_sigma holds what static friction may do, as in the estimator. The notes of the result
    say where the log leaves the training data.

    Parameters
    ----------
    model : identified torque model.
    table : log with columns q, tau (N, n), and qd where it was measured. Pieces between gaps are filtered each by
        itself; in pieces of fewer than 100 rows tau and tau_model are missing (NaN).

    Raises
    ------
    ShapeError : no piece of 100 rows without a gap, NaN rows, wrong joint count.
    """
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    parts, table = pieces(table.t), with_velocity(table)
    qdd, tau, modelled = np.full((3, *table["q"].shape), np.nan)
    for a, b in parts:
        qdd[a:b] = central_diff(table["qd"][a:b], table.t[a:b])
    torque = model.torque(table["q"], table["qd"], qdd, table.dt)
    for a, b in parts:
        rate = 1.0 / float(np.median(np.diff(table.t[a:b])))
        tau[a:b] = lowpass_offline(table["tau"][a:b], rate, model.cutoff)
        modelled[a:b] = lowpass_offline(torque[a:b], rate, model.cutoff)
    variance = model.estimator_kernel(np.ones(6)).run(table["q"], table["qd"], table["tau"], table.dt)[4]
    warned = extrapolation(model, table).warnings
    return (
        replace(table, notes=(*table.notes, *warned))
        .with_column("tau", tau)
        .with_column("tau_model", modelled)
        .with_column("tau_sigma", model.gains * np.sqrt(variance))
    )


def report(fit: Fit[TorqueModel], solution: LinearSolution | None = None) -> str:
    """Return all parameters, then per joint: torque, residuals in % of its deviation, friction with deviations.

    `solution`: behind the fit: bounds that hold a parameter are listed, with what they cost.
    """
    model, q = fit.value, fit.value.quality
    header = ("joint", "torque sd", "rms", "fit", "held-out", "viscous", "coulomb +", "coulomb -", "sign", "in 2 sigma")
    units = ("", "", "", "% of sd", "% of sd", "", "", "", "", "%")
    rows, judged = [], np.flatnonzero(np.isfinite(q.rms_cv))  # joints whose torque was measured
    for i, own in zip(judged, _deviations(fit)):
        both = own.get("coulomb", 0.0)
        rows.append(
            (
                f"{i + 1}",
                f"{q.torque_sd[i]:.3f}",
                f"{q.rms[i]:.3f}",
                f"{100 * q.rms[i] / q.torque_sd[i]:.2f}",
                f"{100 * q.rms_cv[i] / q.torque_sd[i]:.2f}",
                f"{model.friction.viscous[i]:.3f} +- {own.get('viscous', 0.0):.3f}",
                f"{model.friction.coulomb_pos[i]:.3f} +- {own.get('coulomb+', both):.3f}",
                f"{model.friction.coulomb_neg[i]:.3f} +- {own.get('coulomb-', both):.3f}",
                _sign(model, i),
                f"{100 * q.coverage[i]:.1f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(header, units, *rows)]
    lines = ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths)) for row in (header, units, *rows)]
    lines += ["torque in N m, friction in N m and N m s/rad (joints that slide: N and m); sign: its distance or speed"]
    lines += [f"torque as it is read over true torque, what all have in common unknown: {_gains(model, judged)}"]
    if solution is not None and solution.active:
        lines += [bound.text() for bound in solution.active]
        lines += [f"bounds let the residual grow by {100 * solution.growth:.2g} %"]
    last = (f"{fit.n} samples, {q.seconds:.1f} s", fit.excitation.text())
    return "\n".join([parameter_text(fit), "", *lines, *last])


def _gains(model: TorqueModel, joints: np.ndarray) -> str:
    """Return the gains of joints with deviations, without what all have in common."""
    apart = np.eye(len(joints)) - 1.0 / len(joints)
    sd = np.sqrt(np.diag(apart @ model.gain_cov[np.ix_(joints, joints)] @ apart.T))
    return ", ".join(f"{gain:.3f} +- {deviation:.3f}" for gain, deviation in zip(model.gains[joints], sd))


def _deviations(fit: Fit[TorqueModel]) -> list[dict[str, float]]:
    """Return the deviations of each joint's own parameters by their kind; those of a joint begin with viscous."""
    joints: list[dict[str, float]] = []
    first = len(fit.value.base_names)
    for name, sd in zip(fit.names[first:], fit.sd[first:]):
        kind = name.split()[0]
        if kind == "viscous":
            joints.append({})
        joints[-1].setdefault(kind, float(sd))
    return joints[: fit.value.n]


def _sign(model: TorqueModel, i: int | np.intp) -> str:
    """Return the shape of a joint's friction in words."""
    f = model.friction
    words = f"tanh {f.smooth_speed[i]:.2g}" if f.smooth_speed[i] > 0 else f"presliding {f.delta[i]:.1e}"
    words += f", stribeck {f.stribeck_speed[i]:.2g}" if f.stribeck[i] else ""
    return words + (", root" if f.root[i] else "")

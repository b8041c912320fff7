"""Fit of one model to any number of logs: a draft fit of the first minutes, sums for each log, and a fit to all sums.

1. `fit_draft` fits the first few minutes like `fit_dynamics`. The draft determines the nonlinear parameters.
2. `log_sums` reduces one log to triangular factors of its rows, weighted according to their residuals from the draft.
   Logs are independent of each other, so their sums can be computed anywhere, in any order, and cached.
3. `fit_sums` adds the sums in log order and solves the least-squares problem; the result is bit-identical regardless of
   where the sums were computed.

A single reweighting step from a robust draft is as efficient as several (Bickel 1975, One-step Huber estimates).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from armlab.dynamics import BaseParameters, base_parameters
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import BlockSums, Fit
from armlab.estimation.linear_problem import LinearProblem, LinearSolution, solve
from armlab.estimation.robust import HUBER, NORMAL_MAD
from armlab.estimation.tsqr import Factors, factorise, one_thread
from armlab.identify.dynamics import FitProblem, FitSettings, Progress, fit_of, fold_models, make_problem, model_of
from armlab.identify.friction_structure import Chooser, FrictionStructure, choose_here
from armlab.identify.record import Record, prepare, prepare_share, torque_outliers, without_outliers
from armlab.identify.regression import Design
from armlab.identify.solve import covariance, gain_share
from armlab.identify.validation import assess, training
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.torque import Training
from armlab.robots import Robot

SAME_RATE = 1.1
FEWEST_BLOCKS = 60  # minimum number of blocks in all logs together, for the covariance
BIN = 1e-9  # relative margin on the block length


@dataclass(frozen=True, eq=False)
class Pattern:
    """Parts of the draft that are needed to compute the sums of a log; sent to workers.

    `free`: (J, 2) bool, nonlinear parameters with a Jacobian column. `lines`: ripple lines, the same for all logs.
    `gains`: (J,) torque gains. `theta`, `x`: draft parameters without and with nonlinear steps. `limit`: (J,) residual
    above which a row is downweighted [N m]. `rate`, `cutoff`: sampling rate and cut-off of the draft [Hz].
    """

    robot: Robot
    base: BaseParameters
    structure: FrictionStructure
    free: np.ndarray
    lines: np.ndarray
    gains: np.ndarray
    theta: np.ndarray
    x: np.ndarray
    limit: np.ndarray
    rate: float
    cutoff: float
    model: TorqueModel
    blocks: int

    @property
    def sha256(self) -> str:
        """Hash of everything that determines the sums of a log, except the log itself."""
        parts = [np.asarray(getattr(self.structure, field.name)) for field in fields(self.structure)]
        peak = self.model.training.qd_peak
        numbers = (
            self.free,
            self.lines,
            self.gains,
            self.theta,
            self.x,
            self.limit,
            self.rate,
            self.cutoff,
            self.blocks,
            peak,
        )
        digest = hashlib.sha256(self.robot.hash.encode())
        for values in (*parts, *map(np.asarray, numbers)):
            digest.update(f"{values.dtype} {values.shape} {values.tolist()}".encode())
        return digest.hexdigest()

    def design(self, data: Record) -> Design:
        """Return the regression problem of a record, with the draft's gains, structure and Jacobian columns."""
        kept = {"structure": self.structure, "lines": self.lines, "cutoff": self.cutoff}
        built = Design.build(data, self.robot, self.base, **kept)
        return built.with_load(self.theta).with_gains(self.gains).with_slopes(self.theta, self.free)


@dataclass(frozen=True, eq=False)
class LogSums:
    """Least-squares sums of one log.

    `weight`: sum of the row weights. `inside`: number of rows with weight 1.
    """

    factors: Factors
    weight: float
    inside: int
    n: int
    seconds: float
    training: Training
    source: str


@one_thread()
def fit_draft(
    tables: Sequence[Table],
    robot: Robot,
    logs: int,
    progress: Progress = lambda done, total, what: None,
    chooser: Chooser = choose_here,
) -> tuple[FitProblem, Pattern]:
    """Fit the first few logs to determine the nonlinear parameters."""
    job = FitSettings("torque model", "irls", 0, progress, chooser=chooser)
    base = base_parameters(robot)
    draft = make_problem(prepare(tables, robot), robot, base, job)
    design, solution = draft.design, draft.sums.solution
    pattern = Pattern(
        robot=robot,
        base=base,
        structure=design.structure,
        free=design.free,
        lines=design.lines,
        gains=design.gains,
        theta=draft.theta,
        x=solution.x,
        limit=HUBER / NORMAL_MAD * np.median(np.abs(design.residuals(solution.x)), axis=0),
        rate=design.data.rate,
        cutoff=design.decimation.cutoff,
        model=model_of(design, solution.x, solution.cov),
        blocks=max(1, -(-FEWEST_BLOCKS // logs)),
    )
    return draft, pattern


@one_thread()
def log_sums(table: Table, pattern: Pattern) -> LogSums:
    """Reduce one log to least-squares sums; joints may be at rest throughout the log."""
    data = prepare_share(table, pattern.robot)
    spikes = torque_outliers(data)
    if spikes.any():
        data = replace(data, tau=without_outliers(data, spikes, pattern.model))
    if not same_rate(data.rate, pattern.rate):
        raise ShapeError(
            f"Expected the same sampling rate as in the first logs, {pattern.rate:.4g} Hz, got {data.rate:.4g} Hz. "
            "Resample the log."
        )
    design = pattern.design(data)
    away = np.abs(design.residuals(pattern.x))
    weights = np.divide(pattern.limit, away, out=np.ones_like(away), where=away > pattern.limit)
    block = _block(data, pattern.blocks)[design.rows]
    factors = factorise(design.stream(block, np.sqrt(weights)), len(pattern.x))
    return LogSums(
        # Use the same memory layout as arrays from a worker or a file, so that sums are added in the same order.
        factors=replace(factors, R=tuple(map(np.ascontiguousarray, factors.R))),
        weight=float(weights.sum()),
        inside=int(np.count_nonzero(away <= pattern.limit)),
        n=len(data.t),
        seconds=data.seconds,
        training=training(data.t, data.q, data.qd, data.segments, pattern.model.training.qd_peak),
        source=data.sources[0],
    )


@one_thread()
def fit_sums(draft: FitProblem, pattern: Pattern, sums: Sequence[LogSums], first: Sequence[int]) -> Fit[TorqueModel]:
    """Fit the model to the sum of all logs."""
    solution, block_sums = _solved(draft.design, sums)
    design = draft.design
    cov, drift, between = covariance(design, solution, 1)
    model = model_of(design, solution.x, cov, draft.gain_cov, drift)
    block = _blocks_of_draft(design.data, pattern.blocks, sums, first)
    folds = fold_models(model, design, block_sums, block, 1)
    model = assess(model, folds, design.data, design.joints, drift=between)
    model = replace(
        model,
        training=_trained([one.training for one in sums], np.array([one.n for one in sums], dtype=float)),
        quality=replace(model.quality, seconds=sum(one.seconds for one in sums)),
        sources=tuple(one.source for one in sums),
    )
    cov, rows = cov + gain_share(solution, draft.gain_cov), sum(one.n for one in sums)
    return fit_of(model, design, solution, cov, rows, f"{draft.band}, first logs", draft.doubts)


def same_rate(one: float, other: float) -> bool:
    """Return whether two sampling rates [Hz] are close enough to share one filter."""
    return 1.0 / SAME_RATE < one / other < SAME_RATE


def _solved(design: Design, sums: Sequence[LogSums]) -> tuple[LinearSolution, BlockSums]:
    parts = [one.factors for one in sums]
    R = tuple(np.concatenate(of_class) for of_class in zip(*(one.R for one in parts), strict=True))
    factors = Factors(parts[0].size, parts[0].columns, R, np.concatenate([one.rows for one in parts]))
    if len(factors.rows) < 8:
        raise NotExcited(
            f"Expected logs of at least 8 segments for a covariance, got {len(factors.rows)}. Record longer logs.",
            ["covariance"],
            [f"{len(factors.rows)} segments"],
        )
    found = solve(
        LinearProblem.of(design.layout.heads, "torque model", lower=design.layout.lower, upper=design.layout.upper),
        factors,
    )
    stretch = sum(one.weight for one in sums) / max(sum(one.inside for one in sums), 1)
    found = replace(found, stretch=stretch)
    return found, BlockSums.of(found)


def _block(data: Record, count: int) -> np.ndarray:
    """Return the segment number (N,) of each sample, with about `count` segments per log."""
    return data.blocks(data.seconds / count * (1.0 + BIN))


def _blocks_of_draft(data: Record, count: int, sums: Sequence[LogSums], first: Sequence[int]) -> np.ndarray:
    """Return the segment number (N,) of each sample of the draft, counted over all logs."""
    starts = np.cumsum([0, *(len(one.factors.rows) for one in sums)])
    numbers, row = [], 0
    for k in first:
        stop = row + sums[k].n
        segments = tuple((a - row, b - row) for a, b in data.segments if row <= a < stop)
        part = replace(data, t=data.t[row:stop], segments=segments)
        numbers.append(starts[k] + _block(part, count))
        row = stop
    return np.concatenate(numbers)


def _trained(parts: Sequence[Training], n: np.ndarray) -> Training:
    """Combine the training ranges of all logs; shares are averaged over all samples, in the speed bins of the draft."""
    share = n / n.sum()
    return Training(
        q_min=np.min([one.q_min for one in parts], axis=0),
        q_max=np.max([one.q_max for one in parts], axis=0),
        qd_peak=parts[0].qd_peak,
        speed_share=np.einsum("k,kij->ij", share, np.stack([one.speed_share for one in parts])),
        rest_share=float(share @ np.array([one.rest_share for one in parts])),
        longest_rest=max(one.longest_rest for one in parts),
    )

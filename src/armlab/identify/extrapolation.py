"""Whether a log asks a model for what it was never shown: positions, speeds and rest outside the training data.

A held-out error belongs to data like the training data. Per joint it is counted how often a log leaves the trained
range of position and the trained speeds; and, for the arm as a whole, how much it rests: friction at rest is anything
within its bounds, and a model trained in motion says nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from armlab.errors import ModelMismatchError, ShapeError
from armlab.identify.preparation import with_velocity
from armlab.log import Table
from armlab.models import SPEED_EDGES, TorqueModel, Training

__all__ = ["Extrapolation", "extrapolation", "training"]

BESIDE = 0.02  # of the trained range, that position may go beyond it
RARE = 0.005  # share of training below which a bin of speed was not trained
ALLOWED = 0.05  # share of samples outside that need no warning
MORE, LONGER = 3.0, 2.0  # times the share, and the length, of rest in training
REST = 0.01  # of the peak speed; all joints below it are at rest


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """How a log differs from the data that a model was fitted to.

    Attributes
    ----------
    joint_names : for messages.
    outside : (n,) share of samples more than 2 % of the trained range outside it.
    unseen_speed : (n,) share of samples at speeds that hold less than 0.5 % of the training data.
    rest_share, longest_rest : share of rest and its longest stretch [s] in this log.
    trained_rest_share, trained_longest_rest : the same in training.
    warnings : sentences; empty when the model may be used on this log.
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

    Parameters
    ----------
    t : (N,) time [s]. q, qd : (N, n) position and velocity.
    segments : (start, stop) rows of each piece without a gap.
    peak : (n,) speed that counts as the largest; that of the data when left out.
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

"""What an identified model predicts for a log, how surely, and whether the log asks for more than was trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from armlab.errors import ModelMismatchError, ShapeError
from armlab.identify.record import check_finite, pieces, with_velocity
from armlab.identify.validation import rests, speed_shares
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.torque import Training
from armlab.signals import central_diff, lowpass_offline

# Whether a log asks a model for what it was never shown: positions, speeds and rest outside the training data.
#
# A held-out error belongs to data like the training data. Per joint it is counted how often a log leaves the trained
# range of position and the trained speeds; and, for the arm as a whole, how much it rests: friction at rest is anything
# within its bounds, and a model trained in motion says nothing about it.


BESIDE = 0.02  # of the trained range, that position may go beyond it
RARE = 0.005  # share of training below which a bin of speed was not trained
ALLOWED = 0.05  # share of samples outside that need no warning
MORE, LONGER = 3.0, 2.0  # times the share, and the length, of rest in training


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
    advice = "Drop them with table.dropna; without qd it takes 100 rows without a gap to compute it."
    check_finite("q and qd", q, qd, advice=advice)
    margin = BESIDE * (known.q_max - known.q_min)
    outside = np.mean((q < known.q_min - margin) | (q > known.q_max + margin), axis=0)
    unseen = np.sum(np.where(known.speed_share < RARE, speed_shares(qd, known.qd_peak), 0.0), axis=1)
    cuts = np.flatnonzero(np.diff(t) > 1.5 * np.median(np.diff(t))) + 1
    edges = [0, *cuts.tolist(), len(t)]
    rest, longest = rests(t, qd, known.qd_peak, tuple(pairwise(edges)))
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

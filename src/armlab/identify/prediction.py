"""Torque predictions of an identified model with uncertainty, and extrapolation checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from armlab._display import Shown
from armlab.errors import ModelMismatchError, ShapeError
from armlab.estimation.fit import Fit, value_of
from armlab.identify.record import check_finite, pieces, with_velocity
from armlab.identify.validation import rests, speed_shares
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.torque import Training
from armlab.signals import central_diff, lowpass_offline

# Extrapolation: positions, speeds and standstill outside the training data.
#
# Held-out errors are valid only for data similar to the training data. For each joint, samples outside the trained
# positions and speeds are counted. For the arm as a whole, the share of standstill is compared, because friction at
# rest is only bounded and a model trained in motion does not predict it.


BESIDE = 0.02  # tolerance relative to the trained position range
RARE = 0.005  # share of training data below which a speed bin is untrained
ALLOWED = 0.05  # share of samples outside the trained ranges above which a warning is issued
MORE, LONGER = 3.0, 2.0  # ratios of the share and duration of standstill to those of the training data


@dataclass(frozen=True, eq=False, repr=False)
class Extrapolation(Shown):
    """Differences between a log and the training data of a model.

    Attributes
    ----------
    joint_names : tuple of str, length n
        Joint names.
    outside : array, shape (n,)
        Share of samples outside the trained position range by more than 2 % of that range.
    unseen_speed : array, shape (n,)
        Share of samples at speeds with less than 0.5 % of the training data.
    rest_share : float
        Share of samples at rest in this log.
    longest_rest : float, s
        Longest standstill in this log.
    trained_rest_share : float
        Share of samples at rest in the training data.
    trained_longest_rest : float, s
        Longest standstill in the training data.
    warnings : tuple of str
        Warnings, one sentence each; empty if the model is valid for this log.
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
        """Return a table with one row per joint, a line about standstill, and the warnings."""
        width = max(map(len, self.joint_names))
        lines = [f"{'joint':>{width}}  position outside  untrained speed"]
        for name, outside, unseen in zip(self.joint_names, self.outside, self.unseen_speed):
            lines.append(f"{name:>{width}}  {100 * outside:14.1f} %  {100 * unseen:15.1f} %")
        lines.append(
            f"at rest {100 * self.rest_share:.0f} % (longest {self.longest_rest:.2f} s); "
            f"in training {100 * self.trained_rest_share:.0f} % (longest {self.trained_longest_rest:.2f} s)"
        )
        return "\n".join([*lines, *(f"warning: {sentence}" for sentence in self.warnings)])


def extrapolation(model: TorqueModel | Fit[TorqueModel], table: Table) -> Extrapolation:
    """Compare a log with the training data of `model`.

    Warn about joints with more than 5 % of the samples outside the trained positions or speeds. Also warn if,
    compared with the training data, the fraction of time at rest is more than three times as large and the longest rest
    more than twice as long.

    Parameters
    ----------
    model : identified torque model, or its fit.
    table : log with q (N, n), and qd if measured.

    Raises
    ------
    ShapeError : wrong number of joints, NaN rows, fewer than two rows.
    """
    model = value_of(model)
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    table = with_velocity(table)
    q, qd, t, known = table["q"], table["qd"], table.t, model.training
    if q.shape[1:] != (model.n,) or qd.shape != q.shape or len(t) < 2:
        raise ShapeError(
            f"Expected q and qd of {model.n} joints in at least two rows, got {q.shape} and {qd.shape}. "
            "Pass a log of the model's robot."
        )
    advice = "Drop these rows with table.dropna; computing qd requires 100 rows without a gap."
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
    for shares, what in ((outside, "outside the trained positions"), (unseen, "at untrained speeds")):
        far = np.flatnonzero(shares > ALLOWED)
        if len(far):
            listed = ", ".join(f"{names[i]} ({100 * shares[i]:.0f} %)" for i in far)
            found.append(
                f"Expected motion like that in the training data, got samples {what}: {listed}. Include such motion "
                "in the training data."
            )
    if rest[0] > MORE * known.rest_share and rest[1] > LONGER * known.longest_rest:
        found.append(
            f"Expected as little standstill as in training ({100 * known.rest_share:.0f} %, longest "
            f"{known.longest_rest:.2f} s), got {100 * rest[0]:.0f} %, longest "
            f"{rest[1]:.2f} s: at rest, only the bounds of friction are known. Assess "
            "the model only in motion, or include standstill in the training data."
        )
    return tuple(found)


def predict(model: TorqueModel | Fit[TorqueModel], table: Table) -> Table:
    """Return the log with tau, tau_model and tau_sigma (N, n) [N m]: measured torque, modelled torque and its SD.

    Measured and modelled torque are low-passed with zero phase at the model's cut-off, for which the model covariance
    is valid. After a stop, tau_sigma includes the possible static friction, as in the estimator. Extrapolation is
    reported in the notes of the result.

    Parameters
    ----------
    model : identified torque model, or its fit.
    table : log with columns q, tau (N, n), and qd if measured. Segments between gaps are filtered separately; in
        segments of fewer than 100 rows, tau and tau_model are missing (NaN).

    Raises
    ------
    ShapeError : NaN rows, a wrong joint count, or no gap-free segment of at least 100 rows.
    """
    model = value_of(model)
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

"""What a load adds to the torques of a log, as a linear regression: filtered, thinned, and less a log without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.identify.model_error import ModelError
from armlab.identify.preparation import MIN_SECONDS, MIN_SLIDE, MIN_TURN, Prepared, check_once, log_name
from armlab.identify.residuals import model_residuals
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot, inertia

__all__ = ["LoadRecord", "moving_joints"]

CHUNK = 4096  # rows whose whole regressor is held at once
EVERY = 4  # rows apart that are kept; the filter's corner is at a tenth of the rate
APART = 0.02  # rad or m, RMS; records further apart are not of one motion


@dataclass(frozen=True, eq=False)
class LoadRecord:
    """Regression ``y = A pi + e`` of the torque that a load adds.

    Attributes
    ----------
    data : the record with the load. rows : (M,) rows of it that are kept.
    joints : (j,) those that move; what friction does at rest is not known, and the others are left out.
    A : (M, j, 10) filtered columns of the load, at the flange. y : (M, j) filtered residual of the model [N m].
    error : what is uncertain in the model. against : (j, 10, P) sums of A_i^T C_i per joint, C the slopes of its torque
        over these parameters: how the load takes up what is wrong with them.
    sources : name and SHA-256 of each log.
    """

    data: Prepared
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
        """Build the regression from logs.

        Parameters
        ----------
        table : log or logs with the load. known : model of the arm alone, or its fit. robot : the arm.
        without : log of the same motion without the load; its residual is subtracted.

        Raises
        ------
        ShapeError, NotExcited : logs that `prepare` refuses. ShapeError : two motions that are not the same, or one
            log for both.
        """
        error = ModelError.of(known, robot)
        model = error.model
        tables = [table] if isinstance(table, Table) else table
        joints = moving_joints(tables, robot)
        found = model_residuals(table, model, joints.tolist(), robot)
        data, cutoff = found.data, found.data.rate / 10.0
        rows = np.concatenate([np.arange(a, b, EVERY) for a, b in data.segments])
        y, sources = data.filter(found.y[:, joints], cutoff), data.sources
        columns = data.filter(_at_flange(data, robot)[:, joints], cutoff)
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
        """Return the block number (M,) of each row, from 0, for blocks of about `seconds`."""
        return np.unique(self.data.blocks(seconds)[self.rows], return_inverse=True)[1]


def moving_joints(tables: Sequence[Table], robot: Robot) -> np.ndarray:
    """Return the numbers, from 0, of joints that move enough for their friction to be known; all where none does.

    Parameters
    ----------
    tables : logs with q (N, n). robot : the arm.
    """
    if not tables or any(not isinstance(one, Table) or one["q"].shape[1:] != (robot.n,) for one in tables):
        return np.arange(robot.n)  # `prepare` says what is wrong
    ends = np.array([(np.nanmin(one["q"], axis=0), np.nanmax(one["q"], axis=0)) for one in tables if len(one)])
    least = np.where(robot.prismatic, MIN_SLIDE, MIN_TURN)
    moving = np.flatnonzero(ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0) >= least) if len(ends) else []
    return np.asarray(moving) if len(moving) else np.arange(robot.n)


def _at_flange(data: Prepared, robot: Robot) -> np.ndarray:
    """Return the torque columns (N, n, 10) of a load at the flange, unfiltered."""
    moved = inertia.transform(robot.links[-1], np.eye(10)).T
    qdd = data.differentiate(data.qd)
    parts = [slice(a, a + CHUNK) for a in range(0, len(data.t), CHUNK)]
    regressor = robot.chain.rigid_regressor
    return np.concatenate([regressor(data.q[p], data.qd[p], qdd[p], robot.gravity)[:, :, -10:] @ moved for p in parts])


def _shift(data: Prepared, other: Prepared) -> int:
    """Return by how many rows the record with the load began earlier in the motion; refuse two different motions."""
    if len(data.segments) > 1 or len(other.segments) > 1 or abs(data.rate / other.rate - 1.0) > 1e-3:
        raise ShapeError(
            f"Expected one log with and one without the load, of one rate and without gaps, got "
            f"{len(data.segments)} and {len(other.segments)} pieces at {data.rate:.4g} and {other.rate:.4g} Hz. "
            "Record both again, or leave the log without the load out."
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
            f"{(last - first) / data.rate:.1f} s in which joint {int(apart.argmax()) + 1} is {apart.max():.2g} apart "
            f"(RMS). Run the same motion twice, or leave the log without the load out."
        )
    return shift

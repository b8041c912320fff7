"""Records for identification: validated logs, segments without gaps, and a decimation filter."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from armlab.dynamics.base_parameters import measured_joints
from armlab.errors import NotExcited, ShapeError
from armlab.estimation.robust import NORMAL_MAD
from armlab.identify.clocks import BRIDGED, Clock, Delay, delay_of, earlier, shifts_of
from armlab.kernels import presliding
from armlab.log import Table
from armlab.log.units_check import check_constant, check_position, check_torque, check_velocity
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.signals import central_diff, lowpass_offline

MIN_RATE = 40.0  # Hz: four samples per period of the 10 Hz band of models and estimators
SLOW_SHARE = 0.25  # fraction of the sampling rate above which ripple counts as aliased


def check_rate(period: float) -> None:
    """Raise an error if the sampling rate is below `MIN_RATE`, too low to identify friction."""
    rate = 1.0 / period
    if rate < MIN_RATE * (1.0 - 1e-6):
        hint = " If t is in milliseconds, divide it by 1000." if rate < 10.0 else ""
        raise ShapeError(
            f"Expected a log of at least {MIN_RATE:g} Hz, got {rate:.4g} Hz: at a joint reversal, friction changes "
            f"within one sample.{hint} Record at a higher rate; resampling does not help."
        )


def slow_enough(qd: np.ndarray, rate: float, cycles: np.ndarray) -> np.ndarray:
    """Return the mask (N, n) of samples in which a ripple line (n,) [rad/rad] does not alias."""
    return np.abs(qd) * cycles < 2 * np.pi * SLOW_SHARE * rate


MIN_SECONDS, MIN_BLOCKS = 5.0, 8
MIN_TURN, MIN_SLIDE = np.deg2rad(5.0), 0.02  # rad, m: minimum range of a moving joint
MIN_SEGMENT = 100  # samples; shorter segments between gaps are dropped
BAND = 5.0  # Hz, band for comparing velocity with the derivative of position
ORDER = 4  # order of the low-pass filter, which is run forward and backward
KEPT, MARGIN = 0.99, 10.0  # share of motion power, and ratio of the velocity cut-off to the frequency of that share


@dataclass(frozen=True, eq=False)
class Record:
    """One or several logs combined into one record of gap-free segments.

    `t`: (N,) time [s], increasing within a segment. `q`, `qd`, `tau`: (N, n). `dt`: (N,) step to the previous sample
    [s]; the period at the start of a segment. `segments`: (start, stop) rows of each segment. `rate`: [Hz].
    `resolution`: (n,) half the smallest encoder step [rad]. `sources`: name and SHA-256 of each log. `bridged`: (B,)
    interpolated rows that replace lost rows. `delays`: corrected delays of torque and velocity. `notes`: repairs, one
    sentence each.
    """

    t: np.ndarray
    dt: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    segments: tuple[tuple[int, int], ...]
    rate: float
    resolution: np.ndarray
    sources: tuple[str, ...]
    bridged: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    delays: dict[str, Delay] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def measured(self) -> int:
        """Number of measured rows."""
        return len(self.t) - len(self.bridged)

    @property
    def seconds(self) -> float:
        """Total length of the segments [s]."""
        return float(sum(self.t[b - 1] - self.t[a] for a, b in self.segments))

    def filter(self, x: np.ndarray, cutoff: float) -> np.ndarray:
        """Filter (N, ...) with zero phase within each segment; torque and regressor use the same filter."""
        from scipy.signal import butter, sosfiltfilt

        out, sections = np.empty_like(x), butter(ORDER, cutoff / (self.rate / 2), output="sos")
        for a, b in self.segments:
            out[a:b] = sosfiltfilt(sections, x[a:b], axis=0)
        return out

    def differentiate(self, x: np.ndarray) -> np.ndarray:
        """Differentiate (N, ...) by central differences within each segment."""
        out = np.empty_like(x)
        for a, b in self.segments:
            out[a:b] = np.gradient(x[a:b], self.t[a:b], axis=0, edge_order=2)
        return out

    def blocks(self, seconds: float) -> np.ndarray:
        """Return the block number (N,) of each sample for blocks of `seconds` that do not cross gaps."""
        number = np.empty(len(self.t), dtype=int)
        first = 0
        for a, b in self.segments:
            count = max(1, int((self.t[b - 1] - self.t[a]) / seconds))
            number[a:b] = first + np.minimum(((self.t[a:b] - self.t[a]) / seconds).astype(int), count - 1)
            first += count
        return number


def check_blocks(count: int, seconds: float, data: Record) -> None:
    """Raise an error for fewer than eight independent blocks, too few to estimate the covariance from their scatter."""
    if count < MIN_BLOCKS:
        raise NotExcited(
            f"Expected at least {MIN_BLOCKS} blocks of {seconds:.2g} s for the covariance, got {count}. Record longer.",
            ["covariance"],
            [f"{data.seconds:.1f} s"],
        )


def prepare(table: Table | Sequence[Table], robot: Robot, joints: Sequence[int] | None = None) -> Record:
    """Validate logs and cut them into gap-free segments.

    Parameters
    ----------
    table : one or several logs, each with columns q, tau of `robot`; without qd, the derivative of q is used.
    robot : the recorded arm.
    joints : zero-based indices of the joints whose torque is fitted; only these joints must move and have a valid
        torque. Default: all.

    Raises
    ------
    RobotError : not a Robot.
    UnknownName : no such joint.
    ShapeError : not a Table, a repeated log, wrong joint count, NaN rows (the message lists them), sampling rates that
        differ or are below 40 Hz, only short segments between gaps, positions in degrees or on the motor side,
        velocities inconsistent with positions, or motor torques.
    NotExcited : a short log, joints at rest (the message names them), or constant torque.
    """
    used = np.bincount(measured_joints(robot, joints), minlength=len(robot.joint_names)) > 0
    return _checked(_tables(table), robot, used, used)


def prepare_share(table: Table | Sequence[Table], robot: Robot, joints: Sequence[int] | None = None) -> Record:
    """Validate and cut logs as `prepare` does; joints may be at rest if other logs or a prior cover them."""
    used = np.bincount(measured_joints(robot, joints), minlength=len(robot.joint_names)) > 0
    return _checked(_tables(table), robot, used, np.zeros_like(used))


def resting(q: np.ndarray, prismatic: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of joints that move by less than 5 degrees, or 20 mm, in positions (N, n)."""
    return np.ptp(q, axis=0) < np.where(prismatic, MIN_SLIDE, MIN_TURN)


def _checked(tables: list[Table], robot: Robot, used: np.ndarray, moving: np.ndarray) -> Record:
    """Combine logs into a record; joints in `moving` (n,) must move, and joints in `used` (n,) need a valid torque."""
    prepared = _joined(tables, robot)
    check_position(prepared.q, robot)
    moved = ~resting(prepared.q, robot.prismatic)
    _check_motion(prepared.q, robot, moving & ~moved)
    turned = ~np.all([resting(prepared.q[a:b], robot.prismatic) for a, b in prepared.segments], axis=0)  # within a log
    given = all("qd" in one.values for one in tables)
    prepared, slope = _velocity_on_time(prepared, moved & turned) if given else (prepared, prepared.qd)
    if given:
        check_velocity(slope, prepared.filter(prepared.qd, BAND), moved & turned, robot)
    torques = used & (moving | moved)
    if robot.inertias is None:
        check_torque(prepared.q, prepared.tau, torques, robot)
    else:  # `identify.plausibility` compares the torques with the masses
        check_constant(prepared.tau, torques, robot)
    return torque_on_time(prepared, robot, used & moved & turned)


def _joined(tables: list[Table], robot: Robot) -> Record:
    """Combine the segments of several logs into one record, with times from each log's repaired clock."""
    parts = [_segments(one, robot) for one in tables]
    rate = _common_rate([1.0 / part.clock.period for part in parts])
    pieces = [(part, a, b) for part in parts for a, b in part.segments]
    t, measured = (np.concatenate([getattr(part, name)[a:b] for part, a, b in pieces]) for name in ("t", "measured"))
    q, qd, tau = (np.concatenate([part.columns[k][a:b] for part, a, b in pieces]) for k in range(3))
    lengths = np.cumsum([0, *(b - a for _, a, b in pieces)])
    dt = np.diff(t, prepend=t[0])
    dt[lengths[:-1]] = 1.0 / rate
    said = [(log_name(one, number), part.clock.text()) for number, (one, part) in enumerate(zip(tables, parts), 1)]
    return Record(
        t, dt, q, qd, tau,
        segments=tuple((int(a), int(b)) for a, b in pairwise(lengths)),
        rate=rate,
        resolution=_resolution(q[measured]),
        sources=tuple(f"{one.source or 'table'} sha256:{one.sha256}" for one in tables),
        bridged=np.flatnonzero(~measured),
        notes=tuple(f"{name}: {text}" for name, text in said if text),
    )  # fmt: skip


def _tables(table: Table | Sequence[Table]) -> list[Table]:
    """Return one or several logs as a list; raise an error for other types."""
    tables: list[Any] = list(table) if isinstance(table, (list, tuple)) else [table]
    if not tables:
        raise ShapeError("Expected at least one log, got an empty list. Pass the log of an excitation trajectory.")
    for one in tables:
        if not isinstance(one, Table):
            raise ShapeError.no_table(one)
    check_once([(log_name(one, number), one.sha256) for number, one in enumerate(tables, 1)])
    return tables


def check_once(logs: Iterable[tuple[str, str]]) -> None:
    """Raise an error for a repeated log (name and SHA-256); repeated data would count as additional information."""
    known: dict[str, str] = {}
    for name, sha256 in logs:
        if sha256 in known:
            raise ShapeError(
                f"Expected distinct logs, but {name} repeats the rows "
                f"of {known[sha256]}. Remove the repeated log, because "
                "repeated rows would reduce the reported uncertainty without new information."
            )
        known[sha256] = name


def log_name(table: Table, number: int) -> str:
    """Return the file name of a log, or for example "log 2" for the second log without a file."""
    return table.source[0].partition(" sha256 ")[0] if table.source else f"log {number}"


def with_velocity(table: Table) -> Table:
    """Return the log with qd, either measured or computed as the derivative of q after a zero-phase low-pass filter.

    The cut-off is ten times the frequency below which the motion has 99 % of its power, but at most a tenth of the
    rate. Segments between gaps are filtered separately; in segments of fewer than 100 rows, qd is missing (NaN).

    Parameters
    ----------
    table : log with q (N, n), finite.

    Raises
    ------
    ShapeError : NaN rows; the message lists them.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    if "qd" in table:
        return table
    q, t = table["q"], table.t
    check_finite("q", q)
    qd = np.full(q.shape, np.nan)
    for a, b in _pieces(t):
        rate = 1.0 / float(np.median(np.diff(t[a:b])))
        qd[a:b] = central_diff(lowpass_offline(q[a:b], rate, _corner(q[a:b], rate)), t[a:b])
    return table.with_column("qd", qd)


def _corner(q: np.ndarray, rate: float) -> float:
    """Return the cut-off [Hz] of the low-pass filter that precedes differentiation."""
    speed = np.diff(q, axis=0) * np.hanning(len(q) - 1)[:, None]
    power = np.abs(np.fft.rfft(speed, axis=0)) ** 2
    share = np.cumsum(power, axis=0) / np.maximum(power.sum(axis=0), 1e-300)
    highest = float(np.argmax(share >= KEPT, axis=0).max()) * rate / (len(q) - 1)
    return min(max(MARGIN * highest, 0.01 * rate), 0.1 * rate)


def pieces(t: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of the segments of at least 100 rows without a gap; raise an error if there is none."""
    found = _pieces(t)
    if not found:
        raise _in_pieces(_edges(t))
    return found


def _pieces(t: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of the segments of at least `MIN_SEGMENT` rows without a gap."""
    return [(a, b) for a, b in pairwise(_edges(t)) if b - a >= MIN_SEGMENT]


def _edges(t: np.ndarray) -> list[int]:
    """Return the first row of each segment, followed by the number of rows."""
    return Clock.of(t).pieces if len(t) > 1 else [0, len(t)]


def _in_pieces(edges: list[int]) -> ShapeError:
    """Return the error for a log that has only short segments."""
    return ShapeError(
        f"Expected segments of at least {MIN_SEGMENT} samples without a gap of {BRIDGED + 1} rows, got "
        f"{len(edges) - 2} gaps in {edges[-1]} rows, and a longest segment of {int(np.diff(edges).max())} samples. "
        "Record the log again."
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """One log: time (N,), [q, qd, tau], mask of measured rows (N,), segments without a gap, and its clock."""

    t: np.ndarray
    columns: list[np.ndarray]
    measured: np.ndarray
    segments: list[tuple[int, int]]
    clock: Clock


def _segments(table: Table, robot: Robot) -> _Part:
    """Return one log with a repaired clock, interpolated lost rows, and cuts at longer gaps."""
    known = table.values
    names = [name for name in ("q", "qd", "tau") if name != "qd" or "qd" in known]
    columns = [np.asarray(known[name] if name in known else table[name], dtype=float) for name in names]
    wanted = len(table.t), len(robot.joint_names)
    for name, values in zip(names, columns):
        if values.shape != wanted:
            raise ShapeError(
                f"Expected {name} of shape {wanted} for robot {robot.name!r}, got {values.shape}. "
                "Pass the robot that was recorded."
            )
    t = np.asarray(table.t, dtype=float)
    present = np.any(~np.isnan(np.concatenate(columns, axis=1)), axis=1)
    for name, values in zip(names, columns):
        check_finite(name, np.where(present[:, None], values, 0.0))
    t, columns = t[present], [values[present] for values in columns]  # resampled logs have NaN in lost rows
    if len(t) < MIN_SEGMENT or t[-1] - t[0] < MIN_SECONDS:
        length = t[-1] - t[0] if len(t) else 0.0
        raise NotExcited(
            f"Expected a log of at least {MIN_SECONDS:g} s, got {length:.2f} s in {len(t)} rows. Record longer.",
            ["everything"],
            ["too short"],
        )
    clock = Clock.of(t, *columns[:2]) if len(columns) == 3 else Clock.of(t)
    check_rate(clock.period)
    t, columns, measured, edges = clock.bridged(columns)
    found = [(a, b) for a, b in pairwise(edges) if np.count_nonzero(measured[a:b]) >= MIN_SEGMENT]
    if not found:
        raise _in_pieces(edges)
    if "qd" not in known:
        columns.insert(1, with_velocity(Table(t, {"q": columns[0]}))["qd"])
    return _Part(t, columns, measured, found, clock)


def check_finite(
    what: str,
    *columns: np.ndarray,
    advice: str = "Drop these rows with table.dropna. If torques are missing, record with the research extension; a "
    "simulated arm sends torques if its description has masses.",
) -> None:
    """Raise an error for missing values in columns (N, n), listing the rows."""
    bad = np.flatnonzero(~np.all([np.isfinite(values).all(axis=1) for values in columns], axis=0))
    if len(bad):
        raise ShapeError(
            f"Expected finite {what}, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}. {advice}"
        )


def _common_rate(rates: list[float]) -> float:
    """Return the common sampling rate [Hz] of all logs, which share one filter."""
    if max(rates) > 1.1 * min(rates):
        listed = ", ".join(f"{rate:.4g} Hz" for rate in rates)
        raise ShapeError(
            f"Expected logs with equal sampling rates, got {listed}. Resample the logs to the slowest rate first."
        )
    return float(np.median(rates))


def _resolution(q: np.ndarray) -> np.ndarray:
    """Return half the smallest non-zero step of each joint (n,) [rad]: the dead band of the presliding state."""
    steps = np.abs(np.diff(q, axis=0))
    smallest = np.where(steps > 1e-12, steps, np.inf).min(axis=0)
    return np.where(np.isfinite(smallest), 0.5 * smallest, 0.0)


def _check_motion(q: np.ndarray, robot: Robot, still: np.ndarray) -> None:
    """Raise an error if a fitted joint (n,) hardly moves."""
    if not still.any():
        return
    names = [robot.joint_names[i] for i in np.flatnonzero(still)]
    spread = [
        f"{1e3 * x:.1f} mm" if robot.prismatic[i] else f"{np.rad2deg(x):.2f} deg"
        for i, x in enumerate(np.ptp(q, axis=0))
        if still[i]
    ]
    listed = ", ".join(f"{a} ({b})" for a, b in zip(names, spread))
    raise NotExcited(
        f"Expected every joint to move by at least 5 deg (20 mm), got less for {listed}, so their inertia, gravity "
        "and friction are indistinguishable. Record a motion of "
        "all joints, such as one from identify.design_excitation.",
        names,
        spread,
    )


# Coarse regression of each joint's torque on rigid-body and friction terms of the low-passed motion, at a few rows per
# second. It identifies delays, signs and units before the fit.


SURVEY_BAND, SURVEY_RATE, SURVEY_ROWS = 8.0, 25.0, 2000  # Hz, rows per second, and maximum rows
DELTAS = (1e-4, 1e-3, 1e-2)  # rad, presliding distances: friction lags the motion and peaks at reversals
BELLS = (0.03, 0.1)  # rad/s, Stribeck speeds at a medium presliding distance
WAVES = 4  # half waves of friction over a joint's position range
INDEPENDENT = 1e-7  # fraction of the largest eigenvalue below which a direction is dropped


@dataclass(frozen=True, eq=False)
class Survey:
    """Rows (M,) of a record with low-passed q, qd, qdd (M, n), friction signs (M, 5, n) and torque (N, n)."""

    rows: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    signs: np.ndarray
    tau: np.ndarray
    rigid: np.ndarray  # (M, n, 10 n)

    @classmethod
    def of(cls, data: Record, robot: Robot) -> Survey:
        """Return the survey of a record."""
        band = min(SURVEY_BAND, 0.1 * data.rate)
        qd = data.filter(data.qd, band)
        rows = survey_rows(data)
        n = data.q.shape[1]
        z = np.empty((len(data.t), len(DELTAS) + len(BELLS), n))
        for k, delta in enumerate(DELTAS):
            for a, b in data.segments:
                z[a:b, k] = presliding(data.q[a:b], np.full(n, delta), data.resolution)
        for k, speed in enumerate(BELLS, len(DELTAS)):
            z[:, k] = z[:, len(DELTAS) // 2] * np.exp(-((data.qd / speed) ** 2))
        q, slow, qdd, signs = data.q[rows], qd[rows], data.differentiate(qd)[rows], data.filter(z, band)[rows]
        rigid = robot.chain.rigid_regressor(q, slow, qdd, robot.gravity)
        return cls(rows, q, slow, qdd, signs, data.filter(data.tau, band), rigid)

    def columns(self, i: int) -> np.ndarray:
        """Return the columns (M, k) for the rigid body, rotor and offset of joint i."""
        return np.column_stack([self.rigid[:, i], self.qdd[:, i], np.ones(len(self.rows))])

    def friction(self, i: int) -> np.ndarray:
        """Return the columns (M, 6) for viscous and Coulomb friction of joint i."""
        return np.column_stack([self.qd[:, i], self.signs[:, :, i]])

    def friction_over_position(self, i: int) -> np.ndarray:
        """Return the columns (M, 4 WAVES) for the position-dependent torque and Coulomb friction of joint i."""
        q = self.q[:, i]
        phase = np.pi * np.arange(1, WAVES + 1) * ((q - q.min()) / max(np.ptp(q), 1e-9))[:, None]
        waves = np.hstack([np.cos(phase), np.sin(phase)])
        return np.hstack([waves, waves * self.signs[:, len(DELTAS) // 2, i, None]])


def survey_rows(data: Record) -> np.ndarray:
    """Return the rows (M,) of a record that stay within their segment for every delay shift."""
    first, last = shifts_of(data.rate)
    every = max(1, round(data.rate / SURVEY_RATE), len(data.t) // SURVEY_ROWS)
    return np.concatenate([np.arange(a - first, b - last, every) for a, b in data.segments]).astype(int)


def orthonormal(A: np.ndarray) -> np.ndarray:
    """Return orthonormal columns (M, k) that span the columns of A, except for weakly excited directions."""
    A = A / np.maximum(np.sqrt(np.sum(A * A, axis=0)), 1e-12)
    power, V = np.linalg.eigh(A.T @ A)
    kept = power > INDEPENDENT * power[-1]
    return A @ (V[:, kept] / np.sqrt(power[kept]))


def _velocity_on_time(data: Record, moved: np.ndarray) -> tuple[Record, np.ndarray]:
    """Return the record with qd aligned to the derivative of q, and the low-passed derivative (N, n)."""
    slope, speed, rows = data.filter(data.differentiate(data.q), BAND), data.filter(data.qd, BAND), survey_rows(data)
    bases = [orthonormal(np.column_stack([column, np.ones(len(rows))])) for column in slope[rows].T]
    late = delay_of(speed, bases, rows, data.rate, moved)
    if late is None or not late.matters(1.0 / data.rate):
        return data, slope
    data, kept = _shifted(data, "qd", late)
    return data, slope[kept]


def torque_on_time(data: Record, robot: Robot, used: np.ndarray) -> Record:
    """Return the record with tau aligned to the motion; the joints `used` (n,) determine the delay."""
    survey = Survey.of(data, robot)
    bases = [
        orthonormal(np.hstack([survey.columns(i), survey.friction(i), survey.friction_over_position(i)]))
        if used[i]
        else np.zeros((len(survey.rows), 0))
        for i in range(len(used))
    ]
    late = delay_of(survey.tau, bases, survey.rows, data.rate, used)
    return _shifted(data, "tau", late)[0] if late is not None and late.matters(1.0 / data.rate) else data


def _shifted(data: Record, name: str, late: Delay) -> tuple[Record, np.ndarray]:
    """Return the record with a column shifted by a delay, and the rows (N',) with a shifted value."""
    rows, column = late.seconds * data.rate, getattr(data, name).copy()
    ahead, behind = max(0, int(np.ceil(-rows))), max(0, int(np.ceil(rows)))
    for a, b in data.segments:
        column[a:b] = earlier(column[a:b], rows)
    found = [(a + ahead, b - behind) for a, b in data.segments if b - a - ahead - behind >= MIN_SEGMENT]
    kept = np.concatenate([np.arange(a, b) for a, b in found])
    edges = np.cumsum([0, *(b - a for a, b in found)]).tolist()
    columns = {k: getattr(data, k)[kept] for k in ("t", "dt", "q", "qd", "tau")} | {name: column[kept]}
    shifted = replace(
        data,
        **columns,
        segments=tuple(pairwise(edges)),
        bridged=np.flatnonzero(np.isin(kept, data.bridged)),
        delays={**data.delays, name: late},
    )
    return shifted, kept


def delay_text(name: str, late: Delay) -> str:
    """Return a sentence about the corrected delay of the column qd or tau."""
    what = {"qd": "velocity", "tau": "torque"}[name]
    side = "late" if late.seconds > 0 else "early"
    return (
        f"{what} is {1e3 * abs(late.seconds):.1f} +- {1e3 * late.sd:.1f} ms {side} relative to the positions: "
        "the fit corrects this delay, but estimators do not; correct it in the recording"
    )


# Single-sample torque outliers are replaced before filtering, because a filter would spread them over neighbouring
# samples, where no robust loss can reject them.


SPIKE, WINDOW = 6.0, 9  # outlier threshold in robust standard deviations, and samples of the median filter


def torque_outliers(data: Record) -> np.ndarray:
    """Return the mask (N, n) of torques at least six robust SDs away from the median of nine samples."""
    away = np.abs(data.tau - _median(data.tau, data))
    found = np.zeros(away.shape, dtype=bool)
    for a, b in data.segments:
        scale = np.median(away[a:b], axis=0) / NORMAL_MAD
        found[a:b] = (away[a:b] > SPIKE * scale) & (scale > 0)
    return found


def without_outliers(data: Record, found: np.ndarray, model: TorqueModel | None = None) -> np.ndarray:
    """Return the torque (N, n) with outliers replaced by the model torque plus the median residual around them."""
    known = np.zeros_like(data.tau) if model is None else _modelled(model, data)
    return np.where(found, known + _median(data.tau - known, data), data.tau)


def _median(x: np.ndarray, data: Record) -> np.ndarray:
    """Return the median (N, n) of the nine samples around each sample; the end samples of a segment are repeated."""
    from scipy.ndimage import median_filter

    return np.concatenate([median_filter(x[a:b], size=(WINDOW, 1), mode="nearest") for a, b in data.segments])


def _modelled(model: TorqueModel, data: Record) -> np.ndarray:
    """Return the model torque (N, n); the acceleration is low-passed at a tenth of the rate."""
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    parts = [model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b]) for a, b in data.segments]
    return np.concatenate(parts)


# Zero-phase low-pass and decimation of a long record: y_m = sum_j h_j x_{m every + j}, |j| <= L, with h the truncated
# impulse response of a Butterworth filter run forward and backward. Torque and every regressor column pass through
# the same h, so linear relations hold exactly. Only kept rows are computed, as products with a small banded matrix,
# and only a few thousand rows of the regressor exist at once.


ENDS = 2.0  # cut-off periods dropped at either end, where reflection turns noise into a step
DECAYED = 1e-6  # fraction of the largest tap below which taps are dropped
ROWS_AT_ONCE, WIDE = 1024, 64  # rows of this many columns that fit in the cache; narrower regressors use more rows
BAND_ROWS = 32  # kept rows per product


@dataclass(frozen=True, eq=False)
class Decimation:
    """Zero-phase filter with decimation, applied per segment.

    `segments`: (start, stop) of each segment of the record. `taps`: (2 L + 1,) impulse response h; a single tap of 1
    means no filter. `rows`: (M,) kept rows. `cutoff`: cut-off of the filter [Hz].
    """

    segments: tuple[tuple[int, int], ...]
    every: int
    taps: np.ndarray
    rows: np.ndarray
    cutoff: float = np.inf

    @classmethod
    def of(cls, data: Record, cutoff: float, every: int) -> Decimation:
        """Return the filter for a record."""
        taps = np.ones(1) if np.isinf(cutoff) else _taps(cutoff / data.rate)
        shortest = min(b - a for a, b in data.segments)
        left = min(int(ENDS * data.rate / cutoff), shortest // 4)
        rows = np.concatenate([np.arange(a + left, b - left, every) for a, b in data.segments])
        return cls(data.segments, every, taps, rows, cutoff)

    def run(self, columns: Callable[[int, int], np.ndarray], width: int) -> np.ndarray:
        """Return the kept rows (M, width) of lazily computed columns."""
        out = np.empty((len(self.rows), width))
        rows = ROWS_AT_ONCE * max(1, WIDE // max(width, 1)) // self.every
        reach, count, first = len(self.taps) // 2, max(BAND_ROWS, rows // BAND_ROWS * BAND_ROWS), 0
        for a, b in self.segments:
            begin, end = np.searchsorted(self.rows, (a, b)).tolist()
            kept = end - begin
            for k in range(0, kept, count):
                last = min(k + count, kept)
                start, stop = int(self.rows[begin + k]) - reach, int(self.rows[begin + last - 1]) + reach + 1
                x, missing = columns(max(start, a), min(stop, b)), (max(a - start, 0), max(stop - b, 0))
                if any(missing):  # segments are extended by point reflection
                    x = np.pad(x, (missing, (0, 0)), mode="reflect", reflect_type="odd")
                self._filter(x, out[first + k : first + last])
            first += kept
        return out

    def _filter(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write the kept rows (k, w), computed from rows x of the record that extend beyond them on both sides."""
        for k in range(0, len(out), BAND_ROWS):
            m = min(BAND_ROWS, len(out) - k)
            width = self.every * (m - 1) + len(self.taps)
            np.matmul(self._band[:m, :width], x[self.every * k : self.every * k + width], out=out[k : k + m])

    @cached_property
    def _band(self) -> np.ndarray:
        """Matrix for BAND_ROWS kept rows; each row contains the taps, shifted by `every` from the row above."""
        T = np.zeros((BAND_ROWS, self.every * (BAND_ROWS - 1) + len(self.taps)))
        for k in range(BAND_ROWS):
            T[k, self.every * k : self.every * k + len(self.taps)] = self.taps
        return T


def _taps(corner: float) -> np.ndarray:
    """Return the forward-backward impulse response of the filter for a cut-off in cycles per sample."""
    from scipy.signal import butter, sosfilt

    sections = np.asarray(butter(ORDER, 2.0 * corner, output="sos"))
    impulse = np.zeros(int(np.ceil(12.0 / corner)))
    impulse[0] = 1.0
    response = np.asarray(sosfilt(sections, impulse))
    size = 2 ** int(np.ceil(np.log2(2 * len(response))))
    h = np.fft.irfft(np.abs(np.fft.rfft(response, size)) ** 2, size)[: len(response)]
    reach = int(np.flatnonzero(np.abs(h) > DECAYED * h[0])[-1])
    taps = np.concatenate([h[reach:0:-1], h[: reach + 1]])
    return taps / taps.sum()

"""Filtered and decimated columns of a regression over joint torque, made piece by piece from a record.

No column exists at the full rate for the whole record: a long one would not fit into memory beside its filtered copy.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from armlab.identify.base_parameters import BaseParameters
from armlab.identify.record import Record, slow_enough
from armlab.kernels import presliding
from armlab.models.friction import FRICTION_TERMS
from armlab.robots import Robot

# Zero-phase low-pass and decimation of a long record in one pass, block by block.
#
#     y_m = sum_j h_j x_{m every + j},   |j| <= L
#
# with h the impulse response of a Butterworth filter run forward and backward, cut where it has decayed. Torque and
# every column of the regressor pass the same h, so linear relations survive it exactly. Only the rows that are kept are
# computed, as products with a narrow matrix, and never more than a few thousand rows of the regressor exist at once.


ORDER = 4
DECAYED = 1e-6  # of the largest tap
AT_ONCE = 1024  # rows of the record: their regressor stays in the cache
WIDE, NARROW = 64, 16  # columns: of fewer than the first more rows at once
BAND = 32  # kept rows of one product


@dataclass(frozen=True)
class Piece:
    """Rows `start` to `stop` of a record give the kept rows `first` to `last`, continued by `before` and `after`."""

    start: int
    stop: int
    before: int
    after: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Decimation:
    """A zero-phase filter that keeps every few rows of each segment.

    `segments`: (start, stop) of each piece of the record without a gap. `taps`: (2 L + 1,) impulse response h; one tap,
    1, filters nothing. `rows`: (M,) rows that are kept.
    """

    segments: tuple[tuple[int, int], ...]
    every: int
    taps: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, data: Record, cutoff: float, every: int) -> Decimation:
        """Return the filter for a record.

        `cutoff`: corner of one pass [Hz]; infinite for none.
        """
        taps = np.ones(1) if np.isinf(cutoff) else _taps(cutoff / data.rate)
        rows = np.concatenate([np.arange(a, b, every) for a, b in data.segments])
        return cls(data.segments, every, taps, rows)

    def run(self, columns: Callable[[int, int], np.ndarray], width: int) -> np.ndarray:
        """Return the kept rows (M, width) of columns that are made on the fly.

        `columns`: (start, stop) -> rows (stop - start, width) of the record.
        """
        out = np.empty((len(self.rows), width))
        for piece in self.pieces(AT_ONCE * max(1, WIDE // max(width, 1))):
            self.decimate(piece, columns(piece.start, piece.stop), out[piece.first : piece.last])
        return out

    def pieces(self, rows: int = AT_ONCE) -> Iterator[Piece]:
        """Yield what rows of the record are needed for what kept rows, about so many rows of the record at once."""
        reach, count = len(self.taps) // 2, max(BAND, rows // self.every // BAND * BAND)
        first = 0
        for a, b in self.segments:
            kept = -(-(b - a) // self.every)
            for k in range(0, kept, count):
                last = min(k + count, kept)
                start, stop = a + self.every * k - reach, a + self.every * (last - 1) + reach + 1
                inside = max(start, a), min(stop, b)
                yield Piece(*inside, inside[0] - start, stop - inside[1], first + k, first + last)
            first += kept

    def decimate(self, piece: Piece, x: np.ndarray, out: np.ndarray) -> None:
        """Write the kept rows of one piece; ends of a segment are continued by point reflection.

        `x`: (stop - start, C) its rows. `out`: (last - first, C) where they go.
        """
        if piece.before or piece.after:
            x = _continued(x, piece.before, piece.after)
        if len(self.taps) == 1:
            out[:] = x[:: self.every]
            return
        T, kept, done = self._band, piece.last - piece.first, 0
        if 0 < x.shape[1] <= NARROW and kept >= BAND:
            # Few columns: all bands side by side, in one product.
            bands = kept // BAND
            windows = sliding_window_view(x, T.shape[1], axis=0)[:: self.every * BAND][:bands]
            product = T @ windows.transpose(2, 0, 1).reshape(T.shape[1], -1)
            done = bands * BAND
            out[:done] = product.reshape(BAND, bands, -1).transpose(1, 0, 2).reshape(done, -1)
        for k in range(done, kept, BAND):
            m = min(BAND, kept - k)
            width = self.every * (m - 1) + len(self.taps)
            np.matmul(T[:m, :width], x[self.every * k : self.every * k + width], out=out[k : k + m])

    @cached_property
    def _band(self) -> np.ndarray:
        """The matrix of BAND kept rows: the taps, moved by `every` from row to row."""
        T = np.zeros((BAND, self.every * (BAND - 1) + len(self.taps)))
        for k in range(BAND):
            T[k, self.every * k : self.every * k + len(self.taps)] = self.taps
        return T


def _continued(x: np.ndarray, before: int, after: int) -> np.ndarray:
    """Return x (N, C) with rows before and after it, reflected at its ends."""
    if max(before, after) >= len(x):
        return np.pad(x, ((before, after), (0, 0)), mode="reflect", reflect_type="odd")
    out = np.empty((before + len(x) + after, x.shape[1]))  # ten times as fast, for the usual piece
    out[before : before + len(x)] = x
    np.subtract(2.0 * x[0], x[before:0:-1], out=out[:before])
    np.subtract(2.0 * x[-1], x[-2 : -2 - after : -1], out=out[before + len(x) :])
    return out


def _taps(corner: float) -> np.ndarray:
    """Return the impulse response of the filter, forward and backward, at `corner` cycles per sample."""
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


# Columns of a regression over joint torque that depend on the structure of friction, filtered and decimated.


FIXED = (
    "viscous",
    "offset",
    "ripple cos",
    "ripple sin",
)  # columns without structure, the last two where gears are known
SIGNED = ("coulomb+", "coulomb-", "root")  # columns of the sign alone
SHAPED = (*SIGNED, "stribeck")


@dataclass(frozen=True, eq=False)
class Bell:
    """The factor exp(-(qd / v_s)^2), made of the rows that are asked for.

    `qd`: (N, J) velocities. `speed`: (J,) v_s of Stribeck's term.
    """

    qd: np.ndarray
    speed: np.ndarray

    def __getitem__(self, rows: slice) -> np.ndarray:
        """Return it for some rows."""
        return np.exp(-((self.qd[rows] / self.speed) ** 2))


@dataclass(frozen=True, eq=False)
class FrictionColumns:
    """Makes the columns of friction of J joints from their motion.

    `decimation`: filter of the record, with the (M,) rows that are kept. `q`, `qd`: (N, J) positions and velocities.
    `resolution`: (J,) half the smallest step of the encoder [rad].
    """

    decimation: Decimation
    q: np.ndarray
    qd: np.ndarray
    resolution: np.ndarray

    def of(self, i: int) -> FrictionColumns:
        """Return those of one joint, i from 0."""
        one = slice(i, i + 1)
        q, qd = np.ascontiguousarray(self.q[:, one]), np.ascontiguousarray(self.qd[:, one])
        return FrictionColumns(self.decimation, q, qd, self.resolution[one])

    def sign(self, delta: np.ndarray, smooth: np.ndarray) -> np.ndarray:
        """Return s (N, J) along the record: presliding state, or smooth sign.

        `delta`, `smooth`: (J,) structure of the sign, see `FrictionStructure`.
        """
        soft = smooth > 0
        z = np.empty(self.q.shape)
        if not soft.all():
            for a, b in self.decimation.segments:
                z[a:b] = presliding(np.ascontiguousarray(self.q[a:b]), delta, self.resolution)
        for i in np.flatnonzero(soft):
            z[:, i] = np.tanh(self.qd[:, i] / smooth[i])
        return z

    def bell(self, speed: np.ndarray) -> Bell:
        """Return the factor of Stribeck's column.

        `speed`: (J,) v_s of Stribeck's term.
        """
        return Bell(self.qd, speed)

    def columns(self, s: np.ndarray, bells: Sequence[Bell | np.ndarray], signs: bool = True) -> np.ndarray:
        """Return the columns (M, J, 3 + S) of a sign: SIGNED, then Stribeck of each bell.

        `s`: (N, J) from `sign`. `bells`: S from `bell`, or their arrays (N, J). `signs`: whether SIGNED are wanted.
        """
        made_of = [FRICTION_TERMS[name].column for name in SIGNED] if signs else []

        def made(a: int, b: int) -> np.ndarray:
            own = [column(self.qd[a:b], s[a:b]) for column in made_of if column]
            return np.concatenate([*own, *(s[a:b] * bell[a:b] for bell in bells)], axis=1)

        J, count = self.q.shape[1], len(made_of) + len(bells)
        return np.moveaxis(self.decimation.run(made, J * count).reshape(-1, count, J), 1, 2)


MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity
SEEN = 0.5  # share of the samples at which a ripple line must not fold back
SMOOTH = 0.02  # rad/s, of the sign of coupled motors


@dataclass(frozen=True, eq=False)
class RegressionColumns:
    """Makes the columns of J joints of a record.

    `decimation`: of its rows; (M,) are kept. `joints`: (J,) those whose torque counts. `motors`: (K, n)
    angles theta = c q of motors that move several joints. `geared`: whether there are columns of ripple; where gears
    are known and ripple is seen in this record, when None.
    """

    data: Record
    decimation: Decimation
    robot: Robot
    joints: np.ndarray
    motors: np.ndarray
    geared: bool | None = None

    @property
    def cycles(self) -> np.ndarray:
        """Ripple line of each joint (J,) [rad/rad]: strain-wave gears press twice per input turn."""
        return 2.0 * np.abs(np.diag(np.linalg.inv(self.robot.coupling)))[self.joints]

    @property
    def friction(self) -> FrictionColumns:
        """What makes the columns that depend on the structure of friction."""
        data, joints = self.data, self.joints
        return FrictionColumns(self.decimation, data.q[:, joints], data.qd[:, joints], data.resolution[joints])

    def plain(self, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what has neither friction structure nor base parameters.

        `qdd`: (N, n) acceleration of the record. Returns: Torque (M, J); columns (M, J, 2 or 4): viscous, offset, and
        ripple where it is seen; acceleration and velocity (M, K, 2) of the coupled motors.
        """
        data, joints, cycles = self.data, self.joints, self.cycles
        J, K = len(joints), len(self.motors)
        geared = self.geared
        if geared is None:
            geared = not np.any(cycles < MIN_CYCLES) and self._lines_are_seen()

        def columns(a: int, b: int) -> np.ndarray:
            qd = data.qd[a:b, joints]
            parts = [data.tau[a:b, joints], qd, np.ones_like(qd)]
            if geared:
                slow, angle = slow_enough(qd, data.rate, cycles), cycles * data.q[a:b, joints]
                parts += [np.where(slow, np.cos(angle), 0.0), np.where(slow, np.sin(angle), 0.0)]
            return np.concatenate([*parts, qdd[a:b] @ self.motors.T, data.qd[a:b] @ self.motors.T], axis=1)

        fixed = len(FIXED) if geared else len(FIXED) - 2
        thin = self.decimation.run(columns, J * (1 + fixed) + 2 * K)
        tau, own, coupled = np.split(thin, [J, J * (fixed + 1)], axis=1)
        own = np.moveaxis(own.reshape(len(thin), fixed, J), 1, 2)
        return tau, own, np.moveaxis(coupled.reshape(len(thin), 2, K), 1, 2)

    def rigid(self, qdd: np.ndarray, base: BaseParameters) -> tuple[np.ndarray, ...]:
        """Return of each joint the columns (M, w) of the base parameters that it sees.

        `qdd`: (N, n) acceleration of the record.
        """
        data, robot, n = self.data, self.robot, self.robot.n
        seen = [base.kept[base.seen[i]] for i in self.joints]
        edges = np.cumsum([0, *(len(kept) for kept in seen)])
        flat = np.concatenate([np.where(kept < 10 * n, 10 * n * i + kept, 0) for i, kept in zip(self.joints, seen)])
        rotors = [(edges[i] + k, column - 10 * n) for i, kept in enumerate(seen) for k, column in enumerate(kept)]
        rotors = [(position, joint) for position, joint in rotors if joint >= 0]

        def columns(a: int, b: int) -> np.ndarray:
            moves = 0.0 if base.quasi_static else 1.0
            Y = robot.chain.rigid_regressor(data.q[a:b], moves * data.qd[a:b], moves * qdd[a:b], robot.gravity)
            X = np.take(Y.reshape(b - a, -1), flat, axis=1)
            for position, joint in rotors:
                X[:, position] = qdd[a:b, joint]
            return X

        thin = self.decimation.run(columns, int(edges[-1]))
        return tuple(thin[:, edges[i] : edges[i + 1]] for i in range(len(self.joints)))

    def shaped(self, delta: np.ndarray, smooth: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the columns (M, J, 3 + S) of the structure of friction: SIGNED, then Stribeck of each speed.

        `delta`, `smooth`: (J,) structure of the sign. `speeds`: (S, J) of Stribeck's term.
        """
        friction = self.friction
        return friction.columns(friction.sign(delta, smooth), [friction.bell(speed) for speed in speeds])

    def coupled_sign(self) -> np.ndarray:
        """Return the smooth sign (M, K) of the coupled motors' velocity."""
        return self.decimation.run(lambda a, b: np.tanh(self.data.qd[a:b] @ self.motors.T / SMOOTH), len(self.motors))

    def _lines_are_seen(self) -> bool:
        """Tell whether ripple passes slowly enough for the sampling in most samples; warn where it does not."""
        data = self.data
        share = [
            np.mean(slow_enough(data.qd[:, joint], data.rate, line)) for joint, line in zip(self.joints, self.cycles)
        ]
        fast = [self.robot.joint_names[joint] for joint, seen in zip(self.joints, share) if seen < SEEN]
        if fast:
            warnings.warn(
                f"Expected torque ripple below {data.rate / 4.0:.3g} Hz, a quarter of the sampling rate, in half of "
                f"the samples at least, got faster ripple for {', '.join(fast)}: it folds back, and no ripple is "
                "fitted. Log slower motion, as of identify.friction_run, or sample faster.",
                stacklevel=3,
            )
        return not fast

"""Hand-eye calibration from marker points, such as tracker LEDs, board corners or a single ball.

    p_ik = Y^-1 A_i s_k + noise,    s_k = X l_k with a known marker

Fitting the points directly is more accurate than estimating marker poses first, because the pose covariances differ
from sample to sample. Samples with missing points also contribute. The initial guess is a linear solution of
``A_i s_k = Y p_ik`` for the points s_k on the tool.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import rows_text
from armlab.calibrate.diagnostics import (
    FITS,
    MUCH_BETTER,
    ROBOT,
    SPREAD_AND_ANGLE,
    SUSPECT,
    doubts_of,
    limits_of,
    readings_of_robot,
    require_two_axes,
)
from armlab.calibrate.hand_eye import (
    LIMITS,
    WHAT,
    Pair,
    Part,
    PoseUnknowns,
    full,
    remarks,
    require_samples,
    robot_side,
    rotation_sd,
)
from armlab.calibrate.inputs import point_noise, pose_noise, poses
from armlab.errors import NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.tsqr import triangle
from armlab.frames import marker_pose
from armlab.frames.inputs import marker_points, sightings
from armlab.lie import se3, so3
from armlab.models import HandEye
from armlab.models.sensors import FRAMES

TURNED = 1e-3  # accuracy of robot orientations [rad]; smaller rotations count as zero
APART = 0.5  # ratio of residual to spread above which two records are inconsistent
ROUND = 0.5  # minimum singular value ratio of a scaled rotation or reflection
SHAPED = 0.25  # relative difference above which two arrangements count as different
CLEAR = 5.0  # standard deviations above which a difference is significant
OTHER_UNIT = 2.0  # scale factor above which a wrong unit is more likely than a camera error


def fit_hand_eye_points(
    T_base_tool: ArrayLike,
    p_cam: ArrayLike,
    *,
    marker: ArrayLike | None = None,
    visible: ArrayLike | None = None,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    noise: ArrayLike | None = None,
    noise_robot: ArrayLike | None = None,
    robust: bool = False,
    limits: tuple[float, float] = LIMITS,
) -> Fit[HandEye]:
    """Calibrate a camera (hand-eye) from robot poses and simultaneously observed marker points.

    The equation depends on the setup::

        eye_to_hand:  p_ik = T_base_cam^-1 T_base_tool s_k
        eye_in_hand:  p_ik = T_tool_cam^-1 T_base_tool^-1 s_k

    Parameters
    ----------
    T_base_tool : (N, 4, 4) robot poses, rotated about at least two axes.
    p_cam : (N, K, 3) points in camera axes [m], K >= 1; only invisible points may be NaN.
    marker : (K, 3) points in marker axes [m], not collinear. Default: unknown; the point positions on the tool are
        estimated.
    visible : (N, K) mask of the visible points; default: all.
    setup : as in `fit_hand_eye`.
    noise : standard deviation of each coordinate of a point [m], or covariance (3, 3) or (N, K, 3, 3) [m^2]. Default:
        estimated.
    noise_robot : noise of T_base_tool, as in `fit_hand_eye`, shared by all points of a sample. Default: exact poses.
    robust : detect and exclude outliers; `Fit.outliers` marks them.
    limits : largest accepted standard deviation along any direction: fraction of the point spread, and angle [rad].

    Returns
    -------
    Fit of a `models.HandEye`
        `points` are the points on the tool [m]. Parameters: X, or the K points if the marker is unknown, then Y.
        Residuals (N, K, 3) [m]; NaN for invisible points.

    Raises
    ------
    ShapeError : wrong shapes, NaN in visible points, invalid rotations.
    UnknownName : unknown setup.
    NotExcited : too few poses or points, or an unidentifiable direction (named in the message).
    NotConverged : inconsistent records, for example because of wrong pairing, inverse poses, lengths in millimetres or
        left-handed camera axes.
    """
    if setup not in FRAMES:
        raise UnknownName.among("setup", setup, FRAMES)
    model, seen, notes = _point_model(T_base_tool, p_cam, visible, setup, noise, noise_robot)
    body = None if marker is None else marker_points(marker, model.K, "p_cam")
    names, carrier = FRAMES[setup], FRAMES[setup][0].split("_")[1]
    require_samples(len(np.unique(model.sample)), 3 if model.K >= 3 else 5, "poses with visible points")
    held = "the points" if body is None else names[0]
    require_two_axes(model.RA, max(TURNED, rotation_sd(model.noise_A)), carrier, (held, names[1]))
    require_agreement(model)
    require_order_of_robot(model)
    start = model.start()
    try:
        if body is None:
            found = nonlinear_least_squares(model.free(), start, robust=robust)
            value = HandEye(setup, None, se3.from_rp(found.value.RY, found.value.tY), found.value.s)
            parts = (*(Part(f"translation of point{k}", carrier, False) for k in range(model.K)), *Part.of(names[1:]))
        else:
            begin = marked_start(start, body)
            require_marker(model, start.s, body)
            found = nonlinear_least_squares(model.marked(body), begin, robust=robust)
            X, Y = found.value.poses()
            value, parts = HandEye(setup, X, Y, body @ X[:3, :3].T + X[:3, 3]), Part.of(names)
    except NotConverged as error:
        if not error.reason:
            require_agreement(model, model.solution.misfit)
        raise
    residuals = np.full((*seen.shape, 3), np.nan)
    residuals[seen] = model.residuals(value)
    outliers = np.zeros(len(seen), dtype=bool)
    outliers[: len(found.outliers)] = found.outliers
    require_agreement(model, float(np.sqrt(3.0 * np.nanmean(residuals[~outliers] ** 2))), float(np.mean(outliers)))
    words = PoseUnknowns(parts, model.spread, limits_of(limits, SPREAD_AND_ANGLE, LIMITS))
    excitation = check_spread(found.rows.J, words.names, words.units, words.widths, WHAT, describe=words)

    turns = np.sqrt(np.diag(found.cov))[[unit == "rad" for unit in words.units]]
    lines = remarks(model.RA, model.spread, noise is not None, found, turns)
    doubts, lines = doubts_of(found.check, [*notes, *lines])
    return Fit(
        value, words.names, words.units, found.value.parameters(), found.cov, found.sigma, residuals, len(seen),
        excitation, lambda fit: "\n".join([fit.table(), *lines]), outliers, ("position [m]",), found.formal_cov, doubts,
    )  # fmt: skip


def _point_model(
    T_base_tool: ArrayLike, p_cam: ArrayLike, visible: ArrayLike | None, setup: str, noise: Any, noise_robot: Any
) -> tuple[PointModel, np.ndarray, list[str]]:
    """Return the validated observations, their visibility (N, K), and remarks on the poses."""
    RA, tA, note = poses(T_base_tool, "T_base_tool")
    p, seen = sightings(p_cam, visible, "p_cam")
    never = np.flatnonzero(~seen.any(axis=0))
    if len(never):
        raise NotExcited(
            f"Expected every point to be visible at least once, but points {rows_text(never)} are never visible. "
            "Remove these points.",
            [f"translation of point{k}" for k in never],
            ["never visible"] * len(never),
        )
    if len(RA) != len(p):
        raise ShapeError(
            f"Expected equal numbers of robot poses and point samples, got {len(RA)} and "
            f"{len(p)}. Pair poses and points by time first, and mark missing points with visible=."
        )
    RA, tA, of_robot = robot_side(RA, tA, pose_noise(noise_robot, len(RA), "noise_robot"), setup)
    cov = point_noise(noise, seen.shape)
    if cov is not None and cov.ndim == 4:
        cov = cov[seen]
    sample, point = np.nonzero(seen)
    return PointModel(RA, tA, p[seen], sample, point, seen.shape[1], cov, of_robot), seen, [note] if note else []


class Points(NamedTuple):
    """Marker points (K, 3) in tool axes, and the pose Y."""

    s: np.ndarray
    RY: np.ndarray
    tY: np.ndarray

    def plus(self, x: np.ndarray) -> Points:
        """Return the points after a step x = (s, v_Y, w_Y)."""
        return Points(self.s + x[:-6].reshape(-1, 3), self.RY @ so3.exp(x[-3:]), self.tY + x[-6:-3])

    def parameters(self) -> np.ndarray:
        """Return the points, and the position and rotation vector of Y (3 K + 6,)."""
        return np.concatenate([self.s.ravel(), self.tY, so3.log(self.RY)])


class Linear(NamedTuple):
    """Solution of A_i s_k = M p_ik + t_Y with an arbitrary matrix M, and its RMS residual `misfit` [m]."""

    s: np.ndarray
    M: np.ndarray
    misfit: float


@dataclass(frozen=True, eq=False)
class PointModel:
    """Measured points, with one row per visible point of a sample."""

    RA: np.ndarray  # (N, 3, 3) rotations of the robot
    tA: np.ndarray  # (N, 3) positions of the robot
    p: np.ndarray  # (m, 3) measured points in camera axes
    sample: np.ndarray  # (m,) index of the sample
    point: np.ndarray  # (m,) index of the point
    K: int  # number of points
    noise: np.ndarray | None  # variances (3,) or covariance (3, 3) or (m, 3, 3); None: estimated
    noise_A: np.ndarray | None = None  # robot noise: variances (6,) or covariance (6, 6) or (N, 6, 6); None: exact

    @cached_property
    def spread(self) -> float:
        """Spread of the measured points [m]: RMS distance from their mean."""
        t = self.p - self.p.mean(axis=0)
        return float(np.sqrt(np.vdot(t, t) / len(t))) or 1.0

    def only(self, keep: np.ndarray) -> PointModel:
        noise = self.noise[keep] if self.noise is not None and self.noise.ndim == 3 else self.noise
        return replace(self, p=self.p[keep], sample=self.sample[keep], point=self.point[keep], noise=noise)

    @cached_property
    def solution(self) -> Linear:
        return self.linear(self.RA, self.tA)

    def linear(self, RA: np.ndarray, tA: np.ndarray) -> Linear:
        """Return the linear solution for robot rotations (N, 3, 3) and positions (N, 3)."""
        m, n = len(self.p), 3 * self.K
        rows = self._rows(RA, 13)
        for i in range(3):
            rows[:, i, n + 3 * i : n + 3 * i + 3] = -self.p
            rows[:, i, n + 9 + i] = -1.0
        rows[:, :, -1] = -tA[self.sample]
        R = triangle(rows.reshape(3 * m, -1))
        scale = np.linalg.norm(R[:, :-1], axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        x = np.linalg.lstsq(R[:, :-1] / scale, R[:, -1], rcond=1e-9)[0] / scale
        misfit = float(np.linalg.norm(R[:, :-1] @ x - R[:, -1]) / np.sqrt(m))
        return Linear(x[:n].reshape(-1, 3), x[n : n + 9].reshape(3, 3), misfit)

    def start(self) -> Points:
        """Return the initial guess: the R_Y nearest to the linear solution, and the points and t_Y that fit best."""
        RY, n = so3.project(self.solution.M)[0], 3 * self.K
        rows = self._rows(self.RA, 4)
        rows[:, :, n : n + 3] = -np.eye(3)
        rows[:, :, -1] = self.p @ RY.T - self.tA[self.sample]
        R = triangle(rows.reshape(3 * len(rows), -1))
        x = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
        return Points(x[:n].reshape(-1, 3), RY, x[n:])

    def _rows(self, RA: np.ndarray, others: int) -> np.ndarray:
        """Return rows (m, 3, 3 K + others) with the coefficients of the points, and zeros for the other columns."""
        m, n = len(self.p), 3 * self.K
        rows = np.zeros((m, 3, n + others))
        rows[:, :, :n].reshape(m, 3, self.K, 3)[np.arange(m), :, self.point] = RA[self.sample]
        return rows

    def seen(self, s: np.ndarray, RY: np.ndarray, tY: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return R_Y^T R_A (m, 3, 3), the expected points ph (m, 3), and d(p - ph)/dY (m, 3, 6)."""
        C = (self.RA.transpose(0, 2, 1).reshape(-1, 3) @ RY).reshape(-1, 3, 3).transpose(0, 2, 1)[self.sample]
        ph = (C @ s[self.point][:, :, None])[:, :, 0] + ((self.tA - tY) @ RY)[self.sample]
        J = np.empty((len(ph), 3, 6))
        J[:, :, :3], J[:, :, 3:] = RY.T, -so3.hat(ph)
        return C, ph, J

    def residuals(self, value: HandEye) -> np.ndarray:
        return self.p - self.seen(np.asarray(value.points), value.Y[:3, :3], value.Y[:3, 3])[1]

    def free(self) -> NonlinearProblem[Points]:
        """Return the problem with an unknown marker."""

        def evaluate(value: Points) -> list[Measurement]:
            C, ph, JY = self.seen(*value)
            J = np.zeros((len(ph), 3, 3 * self.K + 6))
            J[:, :, : 3 * self.K].reshape(-1, 3, self.K, 3)[np.arange(len(ph)), :, self.point] = -C
            J[:, :, -6:] = JY
            return self._measured(ph, J, C, value.s, value.RY)

        return NonlinearProblem(evaluate, Points.plus, what="hand-eye calibration from points")

    def marked(self, marker: np.ndarray) -> NonlinearProblem[Pair]:
        """Return the problem with known marker points (K, 3)."""
        body = so3.hat(marker)

        def evaluate(value: Pair) -> list[Measurement]:
            s = marker @ value.RX.T + value.tX
            C, ph, JY = self.seen(s, value.RY, value.tY)
            J = np.empty((len(ph), 3, 12))
            J[:, :, :3], J[:, :, 3:6] = -C, C @ (value.RX @ body)[self.point]
            J[:, :, 6:] = JY
            return self._measured(ph, J, C, s, value.RY)

        return NonlinearProblem(evaluate, Pair.plus, what="hand-eye calibration from points")

    def _measured(
        self, ph: np.ndarray, J: np.ndarray, C: np.ndarray, s: np.ndarray, RY: np.ndarray
    ) -> list[Measurement]:
        """Return p - ph with the Jacobian J (m, 3, d), grouped by sample if the points share robot noise."""
        r = self.p - ph
        if self.noise_A is None:
            return [Measurement(r, J, self.noise, ("p",) * 3, self.sample)]
        G = np.concatenate([np.broadcast_to(-RY.T, C.shape), C @ so3.hat(s[self.point])], axis=2)
        found = []
        for rows in self._together:
            n, width = len(rows), 3 * rows.shape[1]
            sample, lever = self.sample[rows[:, 0]], G[rows].reshape(n, width, 6)
            of_A = self.noise_A[sample] if self.noise_A.ndim == 3 else full(self.noise_A)
            shared = lever @ of_A @ lever.transpose(0, 2, 1)
            cov = None if self.noise is None else shared + self._apart(rows)
            one = (r[rows].reshape(n, width), J[rows].reshape(n, width, -1), cov, ("p",) * width, sample)
            found.append(Measurement(*one, added=shared if cov is None else None))
        return found

    @cached_property
    def _together(self) -> list[np.ndarray]:
        """Rows (n, v) of the samples with v visible points, for every v."""
        counts = np.bincount(self.sample)
        first = np.cumsum(counts) - counts
        return [first[counts == v][:, None] + np.arange(v) for v in np.unique(counts[counts > 0])]

    def _apart(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3 v, 3 v) of the independent noise of points with row indices (n, v)."""
        noise = np.zeros(3) if self.noise is None else self.noise
        n, v = rows.shape
        cov = np.zeros((n, v, 3, v, 3))
        for k in range(v):
            cov[:, k, :, k, :] = noise[rows[:, k]] if noise.ndim == 3 else full(noise)
        return cov.reshape(n, 3 * v, 3 * v)


def marked_start(free: Points, marker: np.ndarray) -> Pair:
    """Return the initial guess: X from a fit of the marker to the points, and Y."""
    X = marker_pose(free.s[None], marker).T[0]
    return Pair(X[:3, :3], X[:3, 3], free.RY, free.tY)


def require_agreement(model: PointModel, rms: float | None = None, left_out: float = 0.0) -> None:
    """Raise an error for inconsistent records, with the likely cause; `rms` [m] is None before the fit."""
    found = model.solution
    if rms is None:
        cause = _unit_or_hand(model, found)
    else:
        bad = rms > APART * model.spread or left_out >= 0.5
        cause = _other_reading(model, found.misfit) if bad or rms > SUSPECT * model.spread else ""
        cause = cause or "Check that sample i was taken at the same time in both records, and check the frames." * bad
    if cause:
        share = f", with {100 * left_out:.0f} % of the samples excluded" if left_out else ""
        raise NotConverged(
            f"Expected consistent poses and points, got points that deviate by {found.misfit:.3g} m from a rigid "
            f"arrangement (RMS of the linear solution{share}). {cause}",
            best=found,
            reason="mismatch",
        )


def require_marker(model: PointModel, s: np.ndarray, marker: np.ndarray) -> None:
    """Raise an error if the shape of the marker does not match the observed points."""
    a, b = s - s.mean(axis=0), marker - marker.mean(axis=0)
    U, sizes, V = np.linalg.svd(a.T @ b)
    hand = np.sign(np.linalg.det(U @ V))
    seen, given = np.linalg.norm(a), np.linalg.norm(b)
    apart = float(np.linalg.norm(a - b @ (U * [1.0, 1.0, hand] @ V).T))
    unsure = CLEAR * model.solution.misfit * np.sqrt(model.K / len(model.p))
    if apart < max(SHAPED * seen, unsure):
        return
    turned, times = float(sizes.sum()), seen / given
    cause = "Check the order of the points."
    if turned > (1.0 - SHAPED**2) * seen * given and abs(np.log(times)) > np.log(OTHER_UNIT):
        cause = f"The marker would fit if scaled by {times:.3g}; perhaps millimetres were given as metres."
    elif hand < 0 and turned > (1.0 - SHAPED**2) * seen * given:
        cause = "The mirror image of the marker would fit: one marker axis is reversed."
    raise NotConverged(
        "Expected a marker with the same arrangement as the observed points, got residuals of "
        f"{apart / np.sqrt(model.K):.3g} m (RMS) for points spread over {seen / np.sqrt(model.K):.3g} m. {cause}",
        best=s,
        reason="mismatch",
    )


def _unit_or_hand(model: PointModel, found: Linear) -> str:
    """Describe the likely error if a good linear solution contains a matrix that is not a rotation."""
    size = np.linalg.svd(found.M, compute_uv=False)
    scale = float(np.cbrt(np.prod(size)))
    if size[2] < ROUND * size[0] or found.misfit > 0.1 * scale * model.spread:
        return ""
    if np.linalg.det(found.M) < 0:
        return "The axes of the camera are left-handed: one axis is reversed."
    if abs(np.log(scale)) > np.log(OTHER_UNIT):
        return f"The points would fit if scaled by {scale:.3g}; perhaps millimetres were given as metres."
    return ""


def _other_reading(model: PointModel, now: float) -> str:
    """Return the likely error in the poses if correcting it greatly improves the fit, otherwise an empty string."""
    N = len(model.tA)
    inverse = model.RA.transpose(0, 2, 1)
    other = {
        "The robot poses are inverted, or the other setup applies.": model.linear(
            inverse, -(inverse @ model.tA[:, :, None])[:, :, 0]
        ).misfit,
        "One of the records is in reverse order.": model.linear(model.RA[::-1], model.tA[::-1]).misfit,
    }
    for k in (1, 2, 3):
        text = f"The records are shifted by {k} sample{'s' * (k > 1)} relative to each other."
        for move in (k, -k):
            keep = (model.sample + move >= 0) & (model.sample + move < N)
            misfit = model.only(keep).linear(np.roll(model.RA, -move, axis=0), np.roll(model.tA, -move, axis=0)).misfit
            other[text] = min(misfit, other.get(text, np.inf))
    cause = min(other, key=lambda text: other[text])
    return cause if other[cause] < MUCH_BETTER * now else ""


def require_order_of_robot(model: PointModel) -> None:
    """Raise an error if the robot poses fit the points much better with another interpretation of the orientations."""
    rms = model.solution.misfit
    if rms < SUSPECT * model.spread:
        return
    for one in readings_of_robot(model.RA, model.tA):
        other = model.linear(one.R, one.t)
        if other.misfit < min(MUCH_BETTER * rms, FITS * model.spread):
            raise NotConverged(
                f"Expected consistent poses and points, got residuals of {rms:.3g} m (RMS). {one.text.format(ROBOT)}",
                best=other,
                reason="mismatch",
            )

"""Hand-eye and robot-world calibration from pairs of robot and marker poses.

Maximum-likelihood estimate of two poses in ``A_i X = Y B_i``, with the noise of the camera and, if given, of the robot:

    r_t = t_B - R_Y^T (R_A t_X + t_A - t_Y),    r_R = Log((R_Y^T R_A R_X)^T R_B)

Theory: Shiu and Ahmad (1989); Park and Martin (1994); Dornaika and Horaud (1998); Strobl and Hirzinger (2006).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate.diagnostics import (
    FITS,
    MARKER,
    MUCH_BETTER,
    ROBOT,
    ROUGH,
    SPREAD_AND_ANGLE,
    SUSPECT,
    UNSEEN,
    axis_text,
    doubts_of,
    largest_rotation,
    limits_of,
    readings,
    readings_of_robot,
    require_two_axes,
)
from armlab.calibrate.inputs import pose_noise, poses
from armlab.errors import NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution, whiten
from armlab.lie import so3
from armlab.models import HandEye
from armlab.models.sensors import FRAMES

LIMITS = (0.2, 0.2)  # largest accepted standard deviations: fraction of the position spread, and angle [rad]
CLASSES = ("position [m]", "rotation [rad]")
WHAT = "hand-eye calibration"
COMPONENTS = ("t",) * 3 + ("R",) * 3
SHARED = 0.3  # relative length above which a component of a direction is named
APART = 0.5  # ratio of residual to spread above which two records are inconsistent
COARSE = 0.03  # ratio of residual to spread that is too large for sensor noise
NOTHING, FITS_BETTER = 1e-4, 0.1  # misfit that counts as zero [rad^2]; relative misfit of a better interpretation
FAR = 30.0  # spread [m] beyond the reach of any arm, as when 30 cm are given in millimetres
LATE, ENOUGH = 4.0, 12  # smallest significant time offset in standard deviations; samples needed to estimate it
LEAST, LATEST = 0.01, 1.5  # samples: smaller offsets count as zero (unordered poses); larger ones are pairing errors
STENCIL = 5  # number of poses of the interpolating polynomial
PROBE, TINY = 1e-5, 1e-12  # step of a numerical derivative in samples; rounding error in m or rad
FIRST_ORDER = 0.05  # rad; larger standard deviations are only first-order approximations


def fit_hand_eye(
    T_base_tool: ArrayLike,
    T_cam_marker: ArrayLike,
    *,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    noise: ArrayLike | None = None,
    noise_robot: ArrayLike | None = None,
    robust: bool = False,
    offset: float | None = None,
    limits: tuple[float, float] = LIMITS,
) -> Fit[HandEye]:
    """Calibrate the poses of the camera and a marker from simultaneous robot and marker poses (hand-eye calibration).

    The equation depends on the setup::

        eye_to_hand:  T_base_tool T_tool_marker    = T_base_cam T_cam_marker
        eye_in_hand:  T_base_tool^-1 T_base_marker = T_tool_cam T_cam_marker

    No initial guess is needed. The result does not depend on the sample order, the choice of frames or the length unit.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) robot poses, N >= 3, rotated about at least two axes.
    T_cam_marker : (N, 4, 4) marker poses in the camera frame.
    setup : "eye_to_hand": fixed camera, marker on the tool. "eye_in_hand": camera on the tool, fixed marker.
    noise : noise of T_cam_marker: standard deviations (per position coordinate [m], per rotation vector component
        [rad]), or covariance (6, 6) or (N, 6, 6) of [v; w], v in camera axes, w in marker axes. Default: estimated.
    noise_robot : noise of T_base_tool in the same forms, v in base axes, w in tool axes. The robot noise is never
        estimated, because the data cannot distinguish the two noise sources. Default: exact poses.
    robust : detect and exclude outliers; `Fit.outliers` marks them.
    offset : camera delay in samples: T_cam_marker[i] shows robot pose i - offset. Requires consecutive, evenly
        spaced samples of a motion. Default: estimated as the last parameter if the motion determines it; an estimated
        delay is also listed in `doubts`.
    limits : largest accepted standard deviation along any direction: fraction of the position spread, and angle [rad].

    Returns
    -------
    Fit of a `models.HandEye`
        Parameters: position [m] and rotation vector [rad] of X, then of Y. The covariance refers to the errors v and w
        in (R Exp(w), t + v), v in the parent's axes, w in the child's axes. Residuals (N, 6): [r_t; r_R].

    Raises
    ------
    ShapeError : wrong shapes, rows with NaN, invalid rotations, or left-handed axes.
    UnknownName : unknown setup.
    NotExcited : too few poses, or an unidentifiable direction (named in the message).
    NotConverged : inconsistent records, for example because of wrong pairing, inverse poses or lengths in millimetres.

    References
    ----------
    Shah, J. Mech. Robotics 5(3), 2013 (initial guess); Strobl and Hirzinger, IROS 2006 (weights).
    """
    equation, notes = equation_of(T_base_tool, T_cam_marker, setup, noise, noise_robot)
    widths = limits_of(limits, SPREAD_AND_ANGLE, LIMITS)
    require_samples(equation.N, 3, "poses")
    _require_excitation(equation, _rotation_noise(equation, robust), setup)
    if offset is not None:
        equation = equation.late(_offset(offset))
    found, residuals = _solve(equation, robust)
    timed = _timed(equation, found, robust) if offset is None else None
    if timed is not None:
        found, residuals = timed, equation.late(timed.value.late).evaluate(timed.value.pair)[0].r
    require_match(equation, residuals, ~found.outliers, HandEye(setup, *_pair(found).poses()))
    if equation.noise is None:
        _require_excitation(equation, float(np.hypot(found.sigma[1], rotation_sd(equation.noise_A))), setup)
    return _result(equation, found, residuals, setup, widths, notes)


def equation_of(
    T_base_tool: ArrayLike, T_cam_marker: ArrayLike, setup: str, noise: Any, noise_robot: Any
) -> tuple[HandEyeEquation, list[str]]:
    """Return the validated equation, and remarks on the poses."""
    if setup not in FRAMES:
        raise UnknownName.among("setup", setup, FRAMES)
    RA, tA, first = poses(T_base_tool, "T_base_tool")
    RB, tB, second = poses(T_cam_marker, "T_cam_marker")
    if len(RA) != len(RB):
        raise ShapeError(
            "Expected equal numbers of robot and marker poses, got "
            f"{len(RA)} and {len(RB)}. Pair the poses by time first."
        )
    N = len(RA)
    of_camera, of_robot = pose_noise(noise, N), pose_noise(noise_robot, N, "noise_robot")
    if of_camera is not None and not np.all(np.diagonal(full(of_camera), axis1=-2, axis2=-1) > 0):
        raise ShapeError("Expected noise above zero, got zero. Omit noise to estimate the standard deviations.")
    RA, tA, of_robot = robot_side(RA, tA, of_robot, setup)
    return HandEyeEquation(RA, tA, RB, tB, of_camera, of_robot), [note for note in (first, second) if note]


def robot_side(
    R: np.ndarray, t: np.ndarray, noise: np.ndarray | None, setup: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the rotations, positions and noise of A: the robot poses or, for eye-in-hand, their inverses."""
    noise = noise if noise is not None and noise.any() else None
    if setup == "eye_to_hand":
        return R, t, noise
    inverse = np.ascontiguousarray(R.transpose(0, 2, 1))
    return inverse, -(inverse @ t[:, :, None])[:, :, 0], None if noise is None else inverse_noise(noise, R, t)


def inverse_noise(noise: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the covariance (N, 6, 6) of inverse poses, with errors v' = hat(-R^T t) w - R^T v and w' = -R w."""
    M = np.zeros((len(R), 6, 6))
    Rt = R.transpose(0, 2, 1)
    M[:, :3, :3] = -Rt
    M[:, :3, 3:] = so3.hat(-(Rt @ t[:, :, None])[:, :, 0])
    M[:, 3:, 3:] = -R
    return M @ full(noise) @ M.transpose(0, 2, 1)


def full(noise: np.ndarray) -> np.ndarray:
    """Return variances (k,) as a covariance (k, k), and covariances unchanged."""
    return np.diag(noise) if noise.ndim == 1 else noise


def rotation_sd(noise: np.ndarray | None) -> float:
    """Return the standard deviation of a rotation component [rad] from a pose covariance; 0 without noise."""
    if noise is None:
        return 0.0
    variance = noise if noise.ndim == 1 else np.diagonal(noise, axis1=-2, axis2=-1)
    return float(np.sqrt(np.mean(variance[..., 3:])))


class Pair(NamedTuple):
    RX: np.ndarray
    tX: np.ndarray
    RY: np.ndarray
    tY: np.ndarray

    def plus(self, x: np.ndarray) -> Pair:
        """Return the pair after a step x = (v_X, w_X, v_Y, w_Y), v in the parent's axes, w in the child's axes."""
        turn = so3.exp(x.reshape(4, 3)[1::2])
        return Pair(self.RX @ turn[0], self.tX + x[:3], self.RY @ turn[1], self.tY + x[6:9])

    def parameters(self) -> np.ndarray:
        """Return the positions and rotation vectors of both poses (12,)."""
        return np.concatenate([self.tX, so3.log(self.RX), self.tY, so3.log(self.RY)])

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        X, Y = np.eye(4), np.eye(4)
        X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = self.RX, self.tX, self.RY, self.tY
        return X, Y


class TimedPair(NamedTuple):
    """Pair of poses and the camera delay [samples]."""

    pair: Pair
    late: float

    def plus(self, x: np.ndarray) -> TimedPair:
        return TimedPair(self.pair.plus(x[:12]), self.late + float(x[12]))


@dataclass(frozen=True, eq=False)
class HandEyeEquation:
    """Hand-eye equation A_i X = Y B_i for pairs of poses."""

    RA: np.ndarray  # (N, 3, 3) rotations of A
    tA: np.ndarray  # (N, 3) positions of A
    RB: np.ndarray  # (N, 3, 3) measured rotations of B
    tB: np.ndarray  # (N, 3) measured positions of B
    noise: np.ndarray | None = None  # variances (6,) or covariance (6, 6) or (N, 6, 6) of B; None: estimated
    noise_A: np.ndarray | None = None  # noise of A in the same forms; None: exact

    @property
    def N(self) -> int:
        return len(self.tA)

    @cached_property
    def mean(self) -> np.ndarray:
        """Mean of R_A (3, 3); its norm decreases with larger rotations."""
        return self.RA.sum(axis=0) / self.N

    @cached_property
    def spread(self) -> float:
        """Position spread [m]: RMS distance from the mean; the larger of the two records' values."""
        both = (t - t.sum(axis=0) / self.N for t in (self.tA, self.tB))
        return max(float(np.sqrt(np.vdot(t, t) / self.N)) for t in both) or 1.0

    @cached_property
    def _near(self) -> tuple[np.ndarray, np.ndarray]:
        """Relative indices (N, 5) of the neighbours of each pose of A, and the steps (N, 5, 6) to them."""
        here, width = np.arange(self.N), min(STENCIL, self.N)
        near = np.clip(here - width // 2, 0, self.N - width)[:, None] + np.arange(width)
        turn = so3.log(self.RA.transpose(0, 2, 1)[:, None] @ self.RA[near])
        return near - here[:, None], np.concatenate([self.tA[near] - self.tA[:, None], turn], axis=2)

    def late(self, samples: float) -> HandEyeEquation:
        """Return the equation with the poses of A shifted to earlier times, by polynomial interpolation."""
        places, steps = self._near
        apart = places[:, :, None] - places[:, None, :] + np.eye(places.shape[1])
        ahead = np.where(np.eye(places.shape[1]) > 0, 1.0, -samples - places[:, None, :])
        x = np.einsum("nk,nki->ni", np.prod(ahead / apart, axis=2), steps)
        return replace(self, RA=self.RA @ so3.exp(x[:, 3:]), tA=self.tA + x[:, :3])

    def timed(self, value: TimedPair) -> list[Measurement]:
        """Return the residuals; the last column of J is the derivative with respect to the offset."""
        now, pair = self.late(value.late) if value.late else self, value.pair
        (one,) = now.evaluate(pair)
        (R0, t0), (R1, t1) = ((e.RA, e.tA) for e in (self.late(value.late + h) for h in (-PROBE, PROBE)))
        w = so3.log(R0.transpose(0, 2, 1) @ R1) / (2.0 * PROBE)
        v = (now.RA @ (so3.hat(-pair.tX) @ w[:, :, None]))[:, :, 0] + (t1 - t0) / (2.0 * PROBE)
        turned = one.J[:, 3:, 3:6] @ (w @ pair.RX)[:, :, None]
        column = np.concatenate([-(v @ pair.RY)[:, :, None], turned], axis=1)
        return [replace(one, J=np.concatenate([one.J, column], axis=2))]

    def product(self) -> np.ndarray:
        """Return the mean K of R_A (x) R_B (9, 9), with K vec(R_X) = vec(R_Y) and norm 1 - sigma_R^2."""
        K = self.RA.reshape(-1, 9).T @ self.RB.reshape(-1, 9) / self.N
        return K.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)

    def start(self) -> Pair:
        """Return the initial guess: rotations from the singular vectors of K, positions by least squares."""
        U, _, V = np.linalg.svd(self.product())
        pair = np.stack([V[0], U[:, 0]]).reshape(2, 3, 3)
        U, _, V = np.linalg.svd(np.sign(np.linalg.det(pair[0])) * pair)
        U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
        RX, RY = U @ V
        M, c = self.mean, self.tB @ RY.T - self.tA
        middle = c.sum(axis=0) / self.N
        pulled = c.ravel() @ self.RA.reshape(-1, 3) / self.N - M.T @ middle
        tX = np.linalg.solve(np.eye(3) - M.T @ M, pulled)
        return Pair(RX, tX, RY, M @ tX - middle)

    def evaluate(self, pair: Pair) -> list[Measurement]:
        """Return r_t = t_B - t_h in camera axes and r_R = Log(R_h^T R_B) in marker axes, with h = Y^-1 A X."""
        C = pair.RY.T @ self.RA
        t = C @ pair.tX + (self.tA - pair.tY) @ pair.RY
        back = (C @ pair.RX).transpose(0, 2, 1)
        w = so3.log(back @ self.RB)
        bent = so3.left_jacobian_inv(w)
        r, J = np.concatenate([self.tB - t, w], axis=1), np.zeros((self.N, 6, 12))
        J[:, :3, :3], J[:, :3, 6:9], J[:, :3, 9:] = -C, pair.RY.T, -so3.hat(t)
        J[:, 3:, 3:6], J[:, 3:, 9:] = -bent, bent @ back
        of_A = self._noise_of_A(pair, C)
        if self.noise is None:
            return [Measurement(r, J, None, COMPONENTS, added=of_A)]
        return [Measurement(r, J, self.noise if of_A is None else full(self.noise) + of_A, COMPONENTS)]

    def _noise_of_A(self, pair: Pair, C: np.ndarray) -> np.ndarray | None:
        """Return G S_A G^T (N, 6, 6), with G = [[-R_Y^T, C hat(t_X)], [0, -R_X^T]] and C = R_Y^T R_A."""
        if self.noise_A is None:
            return None
        G = np.zeros((self.N, 6, 6))
        G[:, :3, :3] = -pair.RY.T
        G[:, :3, 3:] = C @ so3.hat(pair.tX)
        G[:, 3:, 3:] = -pair.RX.T
        return G @ full(self.noise_A) @ G.transpose(0, 2, 1)

    def problem(self) -> NonlinearProblem[Pair]:
        return NonlinearProblem(self.evaluate, Pair.plus, what="hand-eye calibration")


def _solve(equation: HandEyeEquation, robust: bool) -> tuple[NonlinearSolution[Pair], np.ndarray]:
    """Return the fit and the residuals (N, 6) of all samples; if it fails, the error names the likely cause."""
    try:
        found = nonlinear_least_squares(equation.problem(), equation.start(), robust=robust)
    except NotConverged as error:
        everything = np.ones(equation.N, dtype=bool)
        require_match(equation, equation.evaluate(error.best)[0].r, everything, error.best)
        raise
    if found.outliers.any():
        return found, equation.evaluate(found.value)[0].r
    return found, found.rows.raw.reshape(-1, 6)


def _offset(offset: Any) -> float:
    found = numbers(offset, "offset", ShapeError)
    if found.shape != () or not abs(found) <= LATEST:
        raise ShapeError(
            f"Expected offset to be a number of samples between -{LATEST} and {LATEST}, got {offset!r}. Shift the "
            "records by whole samples first."
        )
    return float(found)


def _pair(found: NonlinearSolution[Any]) -> Pair:
    return found.value.pair if isinstance(found.value, TimedPair) else found.value


def _timed(
    equation: HandEyeEquation, found: NonlinearSolution[Pair], robust: bool
) -> NonlinearSolution[TimedPair] | None:
    """Return the fit that includes the camera delay, or None if the data do not determine the delay."""
    if equation.N < ENOUGH:
        return None
    (one,) = equation.timed(TimedPair(found.value, 0.0))
    roots = one.roots(dict(zip(found.classes, np.maximum(found.sigma, TINY).tolist())))
    rows = whiten([one], [roots]).times(1.0 - found.outliers)
    U = np.linalg.qr(rows.J[:, :12])[0]
    column = rows.J[:, 12] - U @ (U.T @ rows.J[:, 12])
    if abs(column @ rows.r) < LATE * float(np.linalg.norm(column)):
        return None
    problem = NonlinearProblem(equation.timed, TimedPair.plus, what=WHAT)
    try:
        timed = nonlinear_least_squares(problem, TimedPair(found.value, 0.0), robust=robust)
    except (NotConverged, NotExcited):
        return None
    least = max(LEAST, LATE * float(np.sqrt(timed.cov[12, 12])))
    return timed if least < abs(timed.value.late) < LATEST else None


def _require_excitation(equation: HandEyeEquation, noise: float, setup: str) -> None:
    names = FRAMES[setup]
    require_two_axes(equation.RA, noise, names[0].split("_")[1], names)


def _rotation_noise(equation: HandEyeEquation, robust: bool) -> float:
    """Return the standard deviation of a rotation [rad], given or estimated before the fit."""
    if equation.noise is not None:
        return float(np.hypot(rotation_sd(equation.noise), rotation_sd(equation.noise_A)))
    if robust:
        return rotation_sd(equation.noise_A)
    return float(np.sqrt(max(1.0 - np.linalg.svd(equation.product(), compute_uv=False)[0], 0.0)))


def _require_order(equation: HandEyeEquation, position: float, rotation: float) -> None:
    """Raise an error if the records fit much better with another interpretation of the orientations."""
    spread = equation.spread
    if position < SUSPECT * spread and rotation < SUSPECT:
        return
    for text, other in _equations(equation):
        start = other.start()
        left, turned = _sizes(other.evaluate(start)[0].r)
        fits = left < min(max(MUCH_BETTER * position, SUSPECT * spread), FITS * spread)
        if fits and turned < max(MUCH_BETTER * rotation, SUSPECT):
            raise NotConverged(
                f"Expected two consistent records of poses, got residuals of {position:.3g} m and {rotation:.3g} rad "
                f"(RMS). {text}",
                best=start,
                reason="mismatch",
            )


def require_match(equation: HandEyeEquation, r: np.ndarray, kept: np.ndarray, best: Any) -> None:
    """Raise an error if the residuals r (N, 6) show inconsistent records; the message names the likely cause."""
    position, rotation = _sizes(r[kept])
    _require_order(equation, position, rotation)
    turned, moved = np.sqrt(3.0 - np.vdot(equation.mean, equation.mean)), equation.spread
    few = 2 * np.count_nonzero(kept) <= len(kept)
    if (rotation <= APART * turned or rotation < ROUGH) and position <= APART * moved and not few:
        cause = _other_reading(equation) if rotation > SUSPECT else ""
        if not cause:
            return
    left_out = f", {np.count_nonzero(~kept)} of {len(kept)} excluded" if few else ""
    raise NotConverged(
        f"Expected two consistent records of poses, got residuals of {position:.3g} m and {rotation:.3g} rad "
        f"(RMS{left_out}), although the poses spread over {moved:.3g} m and {turned:.3g} rad. {_cause(equation)}",
        best=best,
        reason="mismatch",
    )


@dataclass(frozen=True)
class Part:
    """Group of three unknowns."""

    what: str  # such as "translation of T_tool_marker"
    axes: str  # axes of the unknowns, such as "tool"
    rotation: bool  # True for a rotation vector

    @classmethod
    def of(cls, names: Sequence[str]) -> tuple[Part, ...]:
        """Return the parts of poses T_a_b: the translation in axes of a, and the rotation in axes of b."""
        found: list[Part] = []
        for name in names:
            _, parent, child = name.split("_")
            found += [cls(f"translation of {name}", parent, False), cls(f"rotation of {name}", child, True)]
        return tuple(found)


@dataclass(frozen=True, eq=False)
class PoseUnknowns:
    """Names, units and limits of the unknowns, and descriptions of directions for `check_spread`."""

    parts: Sequence[Part]  # groups of three unknowns
    spread: float  # spread of the measured positions [m]
    limits: tuple[float, float]  # largest accepted standard deviation: fraction of the spread, and angle [rad]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, such as "T_base_cam rx"."""
        return tuple(f"{p.what.split()[-1]} {'r' * p.rotation}{axis}" for p in self.parts for axis in "xyz")

    @cached_property
    def units(self) -> tuple[str, ...]:
        return tuple("rad" if p.rotation else "m" for p in self.parts for _ in range(3))

    @cached_property
    def widths(self) -> np.ndarray:
        return np.repeat([self.limits[1] if p.rotation else self.limits[0] * self.spread for p in self.parts], 3)

    def __call__(self, step: np.ndarray) -> str:
        """Return a name such as "translation of T_tool_marker along tool axis z (T_base_cam moves with it), 0.4 m"."""
        blocks = step.reshape(-1, 3)
        sizes = [hypot(*block) for block in (blocks / self.widths.reshape(-1, 3)).tolist()]
        largest = max(sizes)
        first = next(i for i, size in enumerate(sizes) if size > 0.5 * largest)  # of the poses that move together
        part = self.parts[first]
        text = f"{part.what} {'about' if part.rotation else 'along'} {axis_text(blocks[first], part.axes)}"
        others = {p.what.split()[-1] for p, size in zip(self.parts, sizes) if size > SHARED * largest}
        others -= {part.what.split()[-1]}
        text += f" ({' and '.join(sorted(others))} move{'s' * (len(others) == 1)} with it)" if others else ""
        if abs(hypot(*sizes) - 1.0) < UNSEEN:
            return text
        return f"{text}, {hypot(*blocks[first].tolist()):.2g} {'rad' if part.rotation else 'm'}"


def require_samples(N: int, least: int, what: str) -> None:
    if least > N:
        raise NotExcited(
            f"Expected at least {least} pairs of {what}, got {N}. Use poses that rotate the tool about two axes.",
            [f"everything: {N} poses"],
            [f"{N} poses (at least {least} required)"],
        )


def _cause(equation: HandEyeEquation) -> str:
    """Return the likely cause of the misfit, such as inverted poses, reversed axes or wrong units."""
    cause = _other_reading(equation)
    if cause:
        return cause
    scale = _scale(equation)
    if scale is not None and scale < 0.0:
        return "Positions and rotations have opposite handedness: one axis of the camera or of the robot is reversed."
    if scale is not None:
        return f"The measured poses would fit if scaled by {scale:.3g}; perhaps millimetres were given as metres."
    return "Check that sample i was taken at the same time in both records, and check the frames of the poses."


def _other_reading(equation: HandEyeEquation) -> str:
    """Return the likely error in the records if correcting it greatly improves the fit of the rotations, or ""."""
    now = _misfit(equation.RA, equation.RB)
    RA, RB = equation.RA, equation.RB
    other = {
        "One of the records contains inverse poses, or the other setup applies.": _misfit(RA.transpose(0, 2, 1), RB),
        "One of the records is in reverse order.": _misfit(RA, RB[::-1]),
    }
    for k in (1, 2, 3):
        if 2 * k + 3 < equation.N:
            text = f"The records are shifted by {k} sample{'s' * (k > 1)} relative to each other."
            other[text] = min(_misfit(RA[k:], RB[:-k]), _misfit(RA[:-k], RB[k:]))
    cause = min(other, key=lambda text: other[text])
    return cause if now > NOTHING and other[cause] < FITS_BETTER * now else ""


def _misfit(RA: np.ndarray, RB: np.ndarray) -> float:
    """Return 1 minus the largest singular value of the mean of R_A (x) R_B; 0 for consistent records."""
    still = np.zeros((len(RA), 3))
    return float(1.0 - np.linalg.svd(HandEyeEquation(RA, still, RB, still).product(), compute_uv=False)[0])


def _scale(equation: HandEyeEquation) -> float | None:
    """Return the factor on t_B that makes the positions fit (negative for a mirror image), or None."""
    RY = equation.start().RY
    turned = equation.tB @ RY.T
    A = np.concatenate([equation.RA, -turned[:, :, None], np.broadcast_to(-np.eye(3), (equation.N, 3, 3))], axis=2)
    x = np.linalg.lstsq(A.reshape(-1, 7), -equation.tA.ravel(), rcond=None)[0]
    left = float(np.sqrt(np.mean((A.reshape(-1, 7) @ x + equation.tA.ravel()) ** 2) * 3.0))
    odd = x[3] < 0 or abs(np.log(max(x[3], 1e-300))) > np.log(2.0)
    return float(x[3]) if left < 0.1 * float(equation.tA.std(axis=0).max()) and odd else None


def remarks(RA: np.ndarray, spread: float, given: bool, found: NonlinearSolution[Any], turns: np.ndarray) -> list[str]:
    lines = [f"largest rotation between two poses {largest_rotation(RA):.3g} rad"]
    if given and found.freedom:
        lines.append(f"residuals {np.sqrt(2.0 * found.cost / found.freedom):.3g} times the given noise")
    left = found.sigma.tolist()
    if not given and (left[0] > COARSE * spread or (left[-1] > ROUGH and len(left) == 2)):
        lines.append("residuals are too large for a sensor: are some samples wrong?")
    if spread > FAR:
        lines.append(f"positions spread over {spread:.3g} m: were millimetres given as metres?")
    if turns.max() > FIRST_ORDER:
        lines.append("standard deviations of rotations exceed 3 degrees and are only first-order approximations")
    return lines


def _equations(equation: HandEyeEquation) -> Iterator[tuple[str, HandEyeEquation]]:
    """Yield equations with another interpretation of the robot poses, the marker poses, or both."""
    RA, tA, RB, tB = equation.RA, equation.tA, equation.RB, equation.tB
    of_marker = readings(RB, tB)
    for one in of_marker:
        yield one.text.format(MARKER), HandEyeEquation(RA, tA, one.R, one.t)
    for one in readings_of_robot(RA, tA):
        yield one.text.format(ROBOT), HandEyeEquation(one.R, one.t, RB, tB)
        for two in of_marker:
            if two.text == one.text:
                yield one.text.format(f"{ROBOT} and {MARKER}"), HandEyeEquation(one.R, one.t, two.R, two.t)


def _sizes(r: np.ndarray) -> tuple[float, float]:
    """Return the RMS position [m] and rotation [rad] residuals of r (N, 6)."""
    position, rotation = np.sqrt((r**2).sum(axis=0).reshape(2, 3).sum(axis=1) / max(len(r), 1))
    return float(position), float(rotation)


def _result(
    equation: HandEyeEquation, found: NonlinearSolution[Any], residuals: np.ndarray, setup: str,
    limits: tuple[float, float], notes: list[str],
) -> Fit[HandEye]:  # fmt: skip
    """Return the fit; raise an error for directions that are not identifiable within the limits."""
    words = PoseUnknowns(Part.of(FRAMES[setup]), equation.spread, limits)
    J, pair, late = found.rows.J, _pair(found), []
    names, units, parameters = words.names, words.units, pair.parameters()
    if isinstance(found.value, TimedPair):
        column, by, sd = J[:, 12], found.value.late, float(np.sqrt(found.cov[12, 12]))
        J = J[:, :12] - np.outer(column, column @ J[:, :12]) / (column @ column)
        names, units, parameters = (*names, "time offset"), (*units, "samples"), np.append(parameters, by)
        late = [
            f"The camera is {abs(by):.2f} +- {sd:.1g} samples {'late' if by > 0 else 'early'}; the fit corrects this. "
            f"Synchronise the clocks, or pass offset={by:.2f}."
        ]
    excitation = check_spread(J, words.names, words.units, words.widths, WHAT, describe=words)
    turns = np.sqrt(np.diag(found.cov)[:12]).reshape(4, 3)[1::2]
    lines = remarks(equation.RA, equation.spread, equation.noise is not None, found, turns)
    doubts, lines = doubts_of(found.check, [*notes, *lines])
    return Fit(
        HandEye(setup, *pair.poses()), names, units, parameters, found.cov,
        found.sigma, residuals, equation.N, excitation, lambda fit: "\n".join([fit.table(), *lines]), found.outliers,
        CLASSES, found.formal_cov, (*late, *doubts),
    )  # fmt: skip

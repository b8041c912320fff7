"""Calibration of a laser line scanner from flat plates: scanner pose on the tool, and plate planes.

Maximum-likelihood estimate from lines or raw profiles in the laser plane (residuals: `laser_model`). No initial guess
is needed, and plates may pass through the origin. Problem statement: Bagge Carlson, Johansson and Robertsson (2015).

The best initial guess of each group is fitted first. If the fit is inconsistent with the noise, every initial guess of
the group is refined by a few steps with weights ``(c^2 / (c^2 + rho^2))^2`` applied to whole scans. Scaling rho by the
median residual makes these steps robust to unknown noise and outliers. Only the two best results are then fitted to
convergence, which limits the computing time for scans that cannot be fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate.diagnostics import SPREAD_AND_ANGLE, doubts_of, limits_of
from armlab.calibrate.inputs import finite, poses, rows_text
from armlab.calibrate.laser_model import (
    FAR_APART,
    LIMITS,
    ROUGH,
    TURNED,
    Scans,
    Scene,
    SceneUnknowns,
    misfit,
    require_motion,
    require_slant,
    require_units,
    scene_of,
    starts,
)
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Fit, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution, descend
from armlab.estimation.robust import mad
from armlab.lie import se3, so3
from armlab.models import LaserSensor

CLASSES = {"p": "point [m]", "l": "line [rad]"}
FAT = 0.2  # ratio of width to length above which a profile is not a line
SCHEDULE = (100.0, 30.0, 10.0, 5.0)
REFUSED = 1e-4  # p-value of chi^2 below which a fit is rejected
MANY = 0.35  # fraction of outliers above which another initial guess is tried
STEPS, TUNING, SETTLED = 9, 5.0, 1e-2  # short descent: maximum steps, c, step at convergence in standard deviations
BEST, WORSE, SAME = 2, 5.0, 1e-3  # per group: number of fits, largest ratio to the best, smallest relative difference
LOST = 1.5  # residual [rad] of angles and scaled points beyond which no fit is tried; wrong labels leave 2 to 8 rad
CLEAR = (2e-3, 0.03)  # ratio of residual to spread of the points, and angle [rad], below which no other guess is tried
HELD = 0.6  # leverage per residual above which a scan is suspicious
TINY = 1e-12  # rounding [m or rad]
FAILED = (NotConverged, NotExcited, ShapeError, np.linalg.LinAlgError)  # failures of a descent


def fit_laser_plane(
    T_base_tool: ArrayLike,
    scans: ArrayLike | Sequence[ArrayLike],
    plane: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    start: ArrayLike | None = None,
    robust: bool = False,
    limits: tuple[float, float] = LIMITS,
) -> Fit[LaserSensor]:
    """Fit the pose of a line scanner on the tool from scans of flat plates at unknown positions.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) tool poses, rotated about at least two axes.
    scans : lines (N, 4), each a point and a unit direction of either sign in the laser plane (x, y) [m]; or N raw
        profiles, each with the points (K, 2) on a plate [m].
    plane : (N,) plate label of each scan. One plate is sufficient; three are better.
    noise : for lines, standard deviations of points [m] and of angles [rad]; for raw points, one standard deviation
        [m]. Default: estimated.
    start : (4, 4) approximate T_tool_sensor; default: found by global search.
    robust : detect and exclude outliers; `Fit.outliers` marks them.
    limits : largest accepted standard deviation along any direction: fraction of the point spread, and angle [rad].

    Returns
    -------
    Fit of a `models.LaserSensor`
        Parameters: position [m] and rotation vector [rad] of T_tool_sensor, then two tilts [rad] and the offset [m] of
        each plane; tilts are relative to the fitted normal. The pose covariance refers to v and w in
        (R Exp(w), t + v), v in tool axes, w in sensor axes. Residuals (N, 2) in the laser plane: distance [m], angle
        [rad]; for raw profiles (M, 1).

    Raises
    ------
    ShapeError : wrong shapes, rows with NaN, invalid rotations; a plate parallel to the laser plane.
    NotExcited : too few scans, or an unidentifiable direction (named in the message).
    NotConverged : no initial guess gives a consistent fit, for example because of wrong labels, pairing or units.

    References
    ----------
    Bagge Carlson, Johansson and Robertsson, IROS 2015.
    """
    data, planes, note = scans_of(T_base_tool, scans, plane, noise)
    require_motion(data, planes)
    guess = None if start is None else poses(np.asarray(start, dtype=float)[None], "start")[0][0]
    found = searched(data, guess, robust)
    scene = found.value
    require_slant(data, scene)
    words = SceneUnknowns(data, scene, planes, limits_of(limits, SPREAD_AND_ANGLE, LIMITS))
    excitation = check_spread(found.rows.J, words.names, words.units, words.widths, "laser scanner", describe=words)

    found_planes = (f"plane {a}: n {np.round(n, 6)}, d {d:.6g} m" for a, n, d in zip(planes, scene.n, scene.d))
    chi2 = "" if data.noise is None else f"residuals {times(found):.3g} times the given noise"
    spread = data.spread(scene)
    wide = f"points spread over {spread:.3g} m: were millimetres given as metres?" * (spread > FAR_APART)
    rough = ""
    if data.noise is None and not _is_clear(data, found):
        angle = f" and {np.degrees(found.sigma[1]):.2g} deg" if len(found.sigma) > 1 else ""
        rough = (
            f"residuals of {1e3 * found.sigma[0]:.3g} mm{angle} are large for a scanner: are the plate labels wrong?"
        )
    doubts, lines = doubts_of(found.check, [note, *found_planes, chi2, wide, rough])
    tilts = np.column_stack([np.zeros((len(planes), 2)), scene.d]).ravel()
    parameters = np.concatenate([scene.t, so3.log(scene.R), tilts])
    value = LaserSensor(se3.from_rp(scene.R, scene.t), scene.n, scene.d, planes)
    residuals = data.residuals(scene)
    return Fit(
        value, words.names, words.units, parameters, found.cov, found.sigma, residuals, data.N, excitation,
        lambda fit: "\n".join([fit.table(), *lines]), found.outliers, tuple(CLASSES[name] for name in found.classes),
        found.formal_cov, doubts,
    )  # fmt: skip


def scans_of(T_base_tool: Any, scans: Any, plane: Any, noise: Any) -> tuple[Scans, tuple[str, ...], str]:
    """Return the validated scans, the plate labels, and a remark on the poses."""
    RA, tA, note = poses(T_base_tool, "T_base_tool")
    N = len(RA)
    labels = np.asarray(plane)
    if labels.shape != (N,) or labels.dtype.kind not in "iuUS":
        raise ShapeError(
            f"Expected plane to have one label per scan, {N} integers or strings, got {labels.dtype} of shape "
            f"{labels.shape}. Pass the plate of each scan."
        )
    names, number = np.unique(labels, return_inverse=True)
    p, line, points, owner = _lines(scans, N)
    cov = _profile_noise(noise, 2 if points is None else 1)
    return Scans(RA, tA, number, p, line, points, owner, cov), tuple(str(name) for name in names), note


def _lines(scans: Any, N: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """Return the point and direction (N, 2) of each scan; for profiles, also the raw points (M, 2) and scan indices."""
    if getattr(scans, "ndim", None) == 2 or (len(scans) and np.ndim(scans[0]) == 1):
        values = numbers(scans, "scans", ShapeError)
        if values.shape != (N, 4):
            raise ShapeError(_shape_text(N, values.shape))
        finite(values, "scans")
        lengths = np.linalg.norm(values[:, 2:], axis=1)
        bad = np.flatnonzero(np.abs(lengths - 1.0) > 1e-6)
        if len(bad):
            raise ShapeError(
                "Expected unit directions in columns 3 and 4 of scans, got directions of other lengths in rows "
                f"{rows_text(bad)}. Normalise the directions."
            )
        return values[:, :2], values[:, 2:] / lengths[:, None], None, np.arange(N)
    profiles = [numbers(one, f"profile {i}", ShapeError) for i, one in enumerate(scans)]
    if len(profiles) != N or any(one.ndim != 2 or one.shape[1:] != (2,) for one in profiles):
        raise ShapeError(_shape_text(N, [one.shape for one in profiles[:3]]))
    bad = np.array([i for i, one in enumerate(profiles) if not np.isfinite(one).all()], dtype=int)
    if len(bad):
        raise ShapeError(
            f"Expected finite scans, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. Drop these points."
        )
    short = np.array([i for i, one in enumerate(profiles) if len(one) < 2 or not np.ptp(one, axis=0).any()], dtype=int)
    if len(short):
        raise ShapeError(
            f"Expected profiles with at least two points, got fewer in rows {rows_text(short)}. Drop these profiles."
        )
    p = np.array([one.mean(axis=0) for one in profiles])
    shapes = [np.linalg.svd(one - middle, full_matrices=False) for one, middle in zip(profiles, p)]
    fat = np.array([i for i, (_, s, _) in enumerate(shapes) if s[1] > FAT * s[0]], dtype=int)
    if len(fat):
        raise ShapeError(
            "Expected profiles of flat plates, got profiles that are not straight "
            f"lines in rows {rows_text(fat)}. Crop the profiles to the plate."
        )
    owner = np.repeat(np.arange(N), [len(one) for one in profiles])
    return p, np.array([V[0] for _, _, V in shapes]), np.concatenate(profiles), owner


def _shape_text(N: int, got: Any) -> str:
    return (
        f"Expected {N} scans, one per pose: lines of shape ({N}, 4), each a point and a unit direction in the laser "
        f"plane, or profiles of shape (K, 2), got {got}. Match the scans with the poses first."
    )


def _profile_noise(noise: Any, count: int) -> np.ndarray | None:
    if noise is None:
        return None
    values = np.atleast_1d(numbers(noise, "noise", ShapeError))
    if values.shape != (count,) or not np.all(values > 0) or not np.isfinite(values).all():
        usual = "(sd of line points [m], sd of line angles [rad])" if count == 2 else "one sd of raw points [m]"
        raise ShapeError(f"Expected noise as {usual}, above zero, got {noise!r}. Correct the noise.")
    return values**2


def searched(scans: Scans, guess: np.ndarray | None, robust: bool) -> NonlinearSolution[Scene]:
    """Return the first fit consistent with the given noise or, if the noise is unknown, the best of all fits."""
    ratio = _ratio(scans)
    size = max(ratio, _spread(scans.p))
    require_units(scans, ratio)
    best: NonlinearSolution[Scene] | None = None
    first = [] if guess is None else [[scene_of(scans, guess)]]
    for group in chain(first, starts(scans, ratio)):
        for found in _fitted(scans, group, size, robust):
            if scans.noise is not None and agrees(found):
                return _oriented(scans, _doubted(scans, found, size) if robust else found, robust)
            if best is None or _rank(scans, found, size, robust) < _rank(scans, best, size, robust):
                best = found
        if best is not None and len(group) > 1 and scans.noise is None and _is_clear(scans, best):
            break  # a group with a single guess does not end the search
    if best is None or scans.noise is not None:
        text = "no convergence"
        if best is not None:
            text = f"residuals of at least {times(best):.3g} times the given noise"
            text += f" and {int(best.outliers.sum())} of {scans.N} scans flagged as outliers" if robust else ""
        raise misfit(scans, ratio, None if best is None else best.value, text)
    if robust:
        best = nonlinear_least_squares(scans.problem(), best.value.oriented(), robust=True, majority=True)
    _require_fit(scans, ratio, best)
    return _oriented(scans, best, robust)


def agrees(found: NonlinearSolution[Scene]) -> bool:
    """Return whether the residuals are consistent with the given noise and most scans are inliers."""
    from scipy.special import chdtri

    free = found.freedom
    return bool((free == 0 or 2.0 * found.cost < chdtri(free, REFUSED)) and np.mean(found.outliers) <= MANY)


def times(found: NonlinearSolution[Scene]) -> float:
    return float(np.sqrt(2.0 * found.cost / max(found.freedom, 1)))


def _ratio(scans: Scans) -> float:
    """Return the point SD divided by the angle SD [m/rad]: from the noise of lines, else from the point spread."""
    if scans.points is not None:
        off = scans.points - scans.p[scans.owner]
        return float(np.sqrt(np.median(np.bincount(scans.owner, np.sum(off * off, axis=1)) / np.bincount(scans.owner))))
    if scans.noise is not None:
        return float(np.sqrt(scans.noise[0] / scans.noise[1]))
    return _spread(scans.p)


def _spread(p: np.ndarray) -> float:
    """Return the RMS distance of points (N, 2) from their mean."""
    return max(float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))), TINY)


def _fitted(scans: Scans, group: list[Scene], size: float, robust: bool) -> Iterator[NonlinearSolution[Scene]]:
    """Yield the fit from the first initial guess, then the fits started from the best results of short descents."""
    first = _tried(scans, group[0], robust)
    if first is not None:
        yield first
    ends = [_approached(scans, scene) for scene in group]
    lefts = np.array([_left(scans, scene, size) for scene in ends])
    before = 0.0
    for k in np.argsort(lefts, kind="stable")[:BEST]:
        if lefts[k] > min(WORSE * lefts.min(), LOST):
            break
        if lefts[k] > (1.0 + SAME) * before:
            found = _tried(scans, ends[k], robust)
            if found is not None:
                yield found
        before = lefts[k]


def _approached(scans: Scans, scene: Scene) -> Scene:
    """Return the scene after a short descent that is robust to unknown noise and outliers."""
    problem = replace(scans, noise=None).problem()
    for _ in range(STEPS):
        r = scans.residuals(scene)
        sizes = np.maximum([mad(r[:, k]) for k in range(r.shape[1])], TINY)
        rho2 = np.mean((r / sizes) ** 2, axis=1)
        if scans.points is not None:
            rho2 = np.bincount(scans.owner, rho2) / np.bincount(scans.owner)
        weight = (TUNING**2 / (TUNING**2 + rho2)) ** 2
        try:
            found = descend(problem, scene, dict(zip("pl", sizes)), weight, iterations=1, strict=False)
        except FAILED:
            break
        scene = found.value
        if found.step < SETTLED:
            break
    return scene


def _left(scans: Scans, scene: Scene, size: float) -> float:
    """Return the residual size of a scene [rad]: median scaled point residual plus median angle residual."""
    r = np.median(np.abs(scans.residuals(scene)), axis=0)
    left = float(r[0] / size + np.sum(r[1:]))
    return left if np.isfinite(left) else np.inf


def _tried(scans: Scans, scene: Scene, robust: bool) -> NonlinearSolution[Scene] | None:
    try:
        return nonlinear_least_squares(scans.problem(), scene, robust=robust, schedule=SCHEDULE)
    except FAILED:
        return None


def _doubted(scans: Scans, found: NonlinearSolution[Scene], size: float) -> NonlinearSolution[Scene]:
    """Return the fit, or a better fit started without one of the high-leverage scans."""
    held = np.einsum("ij,jk,ik->i", found.rows.J, found.cov, found.rows.J)
    numbers = np.bincount(found.rows.sample, minlength=scans.N)
    strong = np.bincount(found.rows.sample, held, minlength=scans.N) > HELD * np.minimum(numbers, 2)
    for i in np.flatnonzero(strong & ~found.outliers).tolist():
        try:
            rest = nonlinear_least_squares(scans.without(i).problem(), found.value, robust=True, schedule=SCHEDULE)
            other = nonlinear_least_squares(scans.problem(), rest.value, robust=True, schedule=SCHEDULE[-1:])
        except FAILED:
            continue
        if agrees(other) and _rank(scans, other, size, True) < _rank(scans, found, size, True):
            found = other
    return found


def _oriented(scans: Scans, found: NonlinearSolution[Scene], robust: bool) -> NonlinearSolution[Scene]:
    if np.all(found.value.d >= 0):
        return found
    again = {"robust": robust, "schedule": SCHEDULE[-1:], "majority": robust and scans.noise is None}
    return nonlinear_least_squares(scans.problem(), found.value.oriented(), **again)


def _is_clear(scans: Scans, found: NonlinearSolution[Scene]) -> bool:
    """Return whether the residuals of points and angles are small, and most scans are inliers."""
    left = np.median(np.abs(scans.residuals(found.value)), axis=0)
    near = left[0] < CLEAR[0] * scans.spread(found.value)
    return bool(near and (len(left) == 1 or left[1] < CLEAR[1]) and np.mean(found.outliers) <= MANY)


def _rank(scans: Scans, found: NonlinearSolution[Scene], size: float, robust: bool) -> float:
    """Return the criterion to minimise: chi^2 for given noise, otherwise the residual size."""
    if scans.noise is not None:
        return float(found.outliers.sum()) + times(found) if robust else found.cost
    if robust:
        return _left(scans, found.value, size)
    return float(np.sum(np.log(np.maximum(found.sigma, TINY))))


def _require_fit(scans: Scans, ratio: float, found: NonlinearSolution[Scene]) -> None:
    """Raise an error for residuals larger than any plausible scanner error."""
    size, spread = float(found.sigma[0]), scans.spread(found.value)
    turn = float(found.sigma[1]) if len(found.sigma) > 1 else 0.0
    if size <= ROUGH * spread and turn <= TURNED and np.mean(found.outliers) <= MANY:
        return
    angles = f" and {turn:.2g} rad" if turn else ""
    raise misfit(
        scans, ratio, found.value,
        f"residuals of {size:.3g} m{angles} (RMS), although the points spread over {spread:.3g} m, and "
        f"{int(found.outliers.sum())} of {scans.N} scans flagged as outliers",
    )  # fmt: skip

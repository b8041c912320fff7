"""Hand-eye calibration from points of a marker: LEDs of a tracker, corners of a board, one ball.

    p_ik = Y^-1 A_i s_k + noise,    s_k = X l_k with a known marker

Poses of the marker are not needed in between: with their unequal covariance they cost accuracy, and a sample in which
a point is missing still counts.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import rows_text
from armlab.calibrate._arguments import point_noise, pose_noise, poses
from armlab.calibrate._hand_eye_equation import robot_side, rotation_sd
from armlab.calibrate._hand_eye_words import Part, Words, limits_of, remarks, require_samples, require_two_axes
from armlab.calibrate._marker_equation import Sight, marked_start
from armlab.calibrate._marker_match import require_marker, require_sight
from armlab.calibrate._orientation_readings import require_order_of_robot
from armlab.calibrate.hand_eye import LIMITS, WHAT
from armlab.errors import NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit, check_spread, nonlinear_least_squares, unhurried
from armlab.frames.inputs import marker_points, sightings
from armlab.lie import se3
from armlab.models import HandEye
from armlab.models.hand_eye import FRAMES

__all__ = ["fit_hand_eye_points"]

TURNED = 1e-3  # rad: orientations of robots are no better; a turn that they could make by that is none


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
    """Find where camera and marker are from poses of the robot and points of the marker seen at the same moments.

        eye_to_hand:  p_ik = T_base_cam^-1 T_base_tool s_k;   eye_in_hand:  p_ik = T_tool_cam^-1 T_base_tool^-1 s_k

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses of the robot that turn the tool about at least two axes.
    p_cam : (N, K, 3) points in camera axes [m], K >= 1; NaN only where not visible.
    marker : (K, 3) the points in marker axes [m], not in a line. None: their places on the tool are unknown, and found.
    visible : (N, K) which points were seen; all when left out.
    setup : as in `fit_hand_eye`.
    noise : deviation of each coordinate of a point [m], or covariance (3, 3) or (N, K, 3, 3). Estimated when left out.
    noise_robot : of T_base_tool, as in `fit_hand_eye`: all points of a sample share it. Exact when left out or zero.
    robust : find wrong samples; `Fit.outliers` marks them, and they do not count.
    limits : largest standard deviation accepted along any direction: share of the spread of the points, and [rad].

    Returns
    -------
    Fit of a `models.HandEye` with `points`, the points on the tool. Parameters: X, or the K points, then Y. Residuals
    (N, K, 3); NaN where not visible.

    Raises
    ------
    ShapeError : another shape, NaN rows where visible, no rotations. UnknownName : another setup.
    NotExcited : too few poses or points; a direction that they do not tell, by name.
    NotConverged : records that do not belong together: pairing, inverse poses, millimetres, a left-handed camera.
    """
    if setup not in FRAMES:
        raise UnknownName.among("setup", setup, FRAMES)
    sight, seen, notes = _sight(T_base_tool, p_cam, visible, setup, noise, noise_robot)
    body = None if marker is None else marker_points(marker, sight.K, "p_cam")
    names, carrier = FRAMES[setup], FRAMES[setup][0].split("_")[1]
    require_samples(len(np.unique(sight.sample)), 3 if sight.K >= 3 else 5, "poses with points that were seen")
    held = "the points" if body is None else names[0]
    require_two_axes(sight.RA, max(TURNED, rotation_sd(sight.noise_A)), carrier, (held, names[1]))
    require_sight(sight)
    require_order_of_robot(sight)
    start = sight.start()
    try:
        if body is None:
            found = nonlinear_least_squares(sight.free(), start, robust=robust)
            value = HandEye(setup, None, se3.from_rp(found.value.RY, found.value.tY), found.value.s)
            parts = (*(Part(f"translation of point{k}", carrier, False) for k in range(sight.K)), *Part.of(names[1:]))
        else:
            begin = marked_start(start, body)
            require_marker(sight, start.s, body)
            found = nonlinear_least_squares(sight.marked(body), begin, robust=robust)
            X, Y = found.value.poses()
            value, parts = HandEye(setup, X, Y, body @ X[:3, :3].T + X[:3, 3]), Part.of(names)
    except NotConverged as error:
        if not error.reason:
            require_sight(sight, sight.solution.misfit)
        raise
    residuals = np.full((*seen.shape, 3), np.nan)
    residuals[seen] = sight.residuals(value)
    outliers = np.zeros(len(seen), dtype=bool)
    outliers[: len(found.outliers)] = found.outliers
    require_sight(sight, float(np.sqrt(3.0 * np.nanmean(residuals[~outliers] ** 2))), float(np.mean(outliers)))
    words = Words(parts, sight.spread, limits_of(limits))
    judge = partial(check_spread, found.rows.J, words.names, words.units, words.widths, WHAT, describe=words)
    excitation = unhurried(judge, found.cov, words.widths, found.null.shape[1])

    def summary(fit: Fit[HandEye]) -> str:
        turns = fit.sd[[unit == "rad" for unit in fit.units]]
        return "\n".join([fit.table(), *notes, *remarks(sight.RA, sight.spread, noise is not None, found, turns)])

    return Fit(
        value, words.names, words.units, found.value.parameters(), found.cov, found.sigma, residuals, len(seen),
        excitation, summary, outliers, ("position [m]",),
    )  # fmt: skip


def _sight(
    T_base_tool: ArrayLike, p_cam: ArrayLike, visible: ArrayLike | None, setup: str, noise: Any, noise_robot: Any
) -> tuple[Sight, np.ndarray, list[str]]:
    """Return what was seen, checked, which points were visible (N, K), and what must be reported of the poses."""
    RA, tA, note = poses(T_base_tool, "T_base_tool")
    p, seen = _points(p_cam, visible)
    if len(RA) != len(p):
        raise ShapeError(
            f"Expected as many poses of the robot as samples of points, got {len(RA)} and {len(p)}. Pair them by "
            "their time first, and give points that are missing by visible=."
        )
    RA, tA, of_robot = robot_side(RA, tA, pose_noise(noise_robot, len(RA), "noise_robot"), setup)
    cov = point_noise(noise, seen.shape)
    if cov is not None and cov.ndim == 4:
        cov = cov[seen]
    sample, point = np.nonzero(seen)
    return Sight(RA, tA, p[seen], sample, point, seen.shape[1], cov, of_robot), seen, [note] if note else []


def _points(p_cam: ArrayLike, visible: ArrayLike | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, K, 3) and which are visible (N, K), each of them somewhere."""
    p, seen = sightings(p_cam, visible, "p_cam")
    never = np.flatnonzero(~seen.any(axis=0))
    if len(never):
        raise NotExcited(
            f"Expected every point in some sample, got none of points {rows_text(never)}. Leave these points out.",
            [f"translation of point{k}" for k in never],
            ["never visible"] * len(never),
        )
    return p, seen

"""Hand-eye and robot-world calibration: where the camera stands and where the marker sits, from pairs of poses.

Maximum likelihood on two poses for ``A_i X = Y B_i``, with the noise of the camera and, when it is told, of the robot:

    r_t = t_B - R_Y^T (R_A t_X + t_A - t_Y),    r_R = Log((R_Y^T R_A R_X)^T R_B)

Theory: Shiu and Ahmad (1989); Park and Martin (1994); Dornaika and Horaud (1998); Strobl and Hirzinger (2006).
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.calibrate._arguments import pose_noise, poses
from armlab.calibrate._hand_eye_equation import Equation, full, robot_side, rotation_sd
from armlab.calibrate._hand_eye_words import (
    Part,
    Words,
    limits_of,
    remarks,
    require_match,
    require_samples,
    require_two_axes,
)
from armlab.calibrate._orientation_readings import require_order
from armlab.errors import NotConverged, ShapeError, UnknownName
from armlab.estimation import Fit, check_spread, nonlinear_least_squares, unhurried
from armlab.models import HandEye
from armlab.models.hand_eye import FRAMES

__all__ = ["LIMITS", "fit_hand_eye"]

LIMITS = (0.2, 0.2)
CLASSES = ("position [m]", "rotation [rad]")
WHAT = "hand-eye calibration"


def fit_hand_eye(
    T_base_tool: ArrayLike,
    T_cam_marker: ArrayLike,
    *,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    noise: ArrayLike | None = None,
    noise_robot: ArrayLike | None = None,
    robust: bool = False,
    limits: tuple[float, float] = LIMITS,
) -> Fit[HandEye]:
    """Find where camera and marker are from poses of the robot and of the marker seen at the same moments.

        eye_to_hand:  T_base_tool T_tool_marker    = T_base_cam T_cam_marker
        eye_in_hand:  T_base_tool^-1 T_base_marker = T_tool_cam T_cam_marker

    No guess is needed, and order of samples, frames and unit of length do not matter.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses of the robot, N >= 3, that turn the tool about at least two axes.
    T_cam_marker : (N, 4, 4) poses of the marker in the camera.
    setup : "eye_to_hand": the camera stands, the marker is on the tool. "eye_in_hand": the other way round.
    noise : of T_cam_marker: (sd of each axis of the position [m], of the rotation vector [rad]), or covariance (6, 6)
        or (N, 6, 6) of [v; w], v in camera axes, w in marker axes. Estimated when left out.
    noise_robot : the same of T_base_tool, v in base axes, w in tool axes. It is never estimated: data cannot separate
        the two. Exact when left out or zero.
    robust : find wrong samples; `Fit.outliers` marks them, and they do not count.
    limits : largest standard deviation accepted along any direction: share of the spread of the positions, and [rad].

    Returns
    -------
    Fit of a `models.HandEye`. Parameters and covariance: X, then Y; the position and the rotation vector of each. The
    covariance is that of (R Exp(w), t + v): v in the parent's axes, w in the child's. Residuals (N, 6): [r_t; r_R].

    Raises
    ------
    ShapeError : another shape, NaN rows, no rotations, left-handed axes. UnknownName : another setup.
    NotExcited : too few poses; a direction that they do not tell, by name.
    NotConverged : records that do not belong together: pairing, inverse poses, millimetres.

    References
    ----------
    Shah, J. Mech. Robotics 5(3), 2013 (start); Strobl and Hirzinger, IROS 2006 (weights).
    """
    if setup not in FRAMES:
        raise UnknownName.among("setup", setup, FRAMES)
    equation, notes = _equation(T_base_tool, T_cam_marker, setup, noise, noise_robot)
    names = FRAMES[setup]
    carrier = names[0].split("_")[1]
    require_samples(equation.N, 3, "poses")
    require_two_axes(equation.RA, _rotation_noise(equation, robust), carrier, names)
    try:
        found = nonlinear_least_squares(equation.problem(), equation.start(), robust=robust)
    except NotConverged as error:
        rest = equation.evaluate(error.best)[0].r
        require_order(equation, rest, np.ones(equation.N, dtype=bool))
        require_match(equation, rest, np.ones(equation.N, dtype=bool), error.best)
        raise
    residuals = equation.evaluate(found.value)[0].r if found.outliers.any() else found.rows.raw.reshape(-1, 6)
    value = HandEye(setup, *found.value.poses())
    require_order(equation, residuals, ~found.outliers)
    require_match(equation, residuals, ~found.outliers, value)
    if equation.noise is None:
        require_two_axes(equation.RA, float(np.hypot(found.sigma[1], rotation_sd(equation.noise_A))), carrier, names)
    words = Words(Part.of(names), equation.spread, limits_of(limits))
    judge = partial(check_spread, found.rows.J, words.names, words.units, words.widths, WHAT, describe=words)
    excitation = unhurried(judge, found.cov, words.widths, found.null.shape[1])

    def summary(fit: Fit[HandEye]) -> str:
        given, turns = equation.noise is not None, fit.sd.reshape(4, 3)[1::2]
        return "\n".join([fit.table(), *notes, *remarks(equation.RA, equation.spread, given, found, turns)])

    return Fit(
        value, words.names, words.units, found.value.parameters(), found.cov, found.sigma, residuals, equation.N,
        excitation, summary, found.outliers, CLASSES,
    )  # fmt: skip


def _equation(
    T_base_tool: ArrayLike, T_cam_marker: ArrayLike, setup: str, noise: Any, noise_robot: Any
) -> tuple[Equation, list[str]]:
    """Return the checked equation, and what must be reported of its poses."""
    RA, tA, first = poses(T_base_tool, "T_base_tool")
    RB, tB, second = poses(T_cam_marker, "T_cam_marker")
    if len(RA) != len(RB):
        raise ShapeError(
            f"Expected as many poses of the robot as of the marker, got {len(RA)} and {len(RB)}. "
            "Pair them by their time first."
        )
    N = len(RA)
    of_camera, of_robot = pose_noise(noise, N), pose_noise(noise_robot, N, "noise_robot")
    if of_camera is not None and not np.all(np.diagonal(full(of_camera), axis1=-2, axis2=-1) > 0):
        raise ShapeError("Expected noise above zero, got zero. Leave it out to have it estimated.")
    RA, tA, of_robot = robot_side(RA, tA, of_robot, setup)
    return Equation(RA, tA, RB, tB, of_camera, of_robot), [note for note in (first, second) if note]


def _rotation_noise(equation: Equation, robust: bool) -> float:
    """Return what is known of the deviation of rotations before the fit [rad]."""
    if equation.noise is not None:
        return float(np.hypot(rotation_sd(equation.noise), rotation_sd(equation.noise_A)))
    if robust:
        return rotation_sd(equation.noise_A)
    return float(np.sqrt(max(1.0 - np.linalg.svd(equation.product(), compute_uv=False)[0], 0.0)))

"""Calibration of a laser line scanner on flat plates: where it sits on the tool, and where the plates are.

    e1 = (c_x p_x + c_y p_y - h) / k,        e2 = asin((c_x l_x + c_y l_y) / k)

Maximum likelihood of lines or raw profiles in the laser plane; plates through the origin are plates like others, and no
guess is needed. Bagge Carlson, Johansson and Robertsson (2015) posed the problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from armlab.calibrate._arguments import poses
from armlab.calibrate._hand_eye_words import limits_of
from armlab.calibrate._laser_data import scans_of
from armlab.calibrate._laser_search import searched, times
from armlab.calibrate._laser_words import FAR_APART, LIMITS, Words, require_motion, require_slant
from armlab.estimation import Fit, check_spread, unhurried
from armlab.lie import se3, so3
from armlab.models import LaserSensor

__all__ = ["fit_laser_plane"]

CLASSES = {"p": "point [m]", "l": "line [rad]"}


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
    """Find where a line scanner sits on the tool from scans of flat plates that are somewhere.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses of the tool that turn it about at least two axes.
    scans : lines (N, 4): a point and a unit direction, either way, in the laser plane (x, y) [m]; or N raw profiles of
        a plate, each (K, 2).
    plane : (N,) label of the plate of each scan. One plate is enough, three are better.
    noise : of lines (sd of the point [m], of the angle [rad]); of raw points one sd [m]. Estimated when left out.
    start : (4, 4) T_tool_sensor where it is roughly known; not needed.
    robust : find wrong scans; `Fit.outliers` marks them, and they do not count.
    limits : largest standard deviation accepted along any direction: share of the spread of the points, and [rad].

    Returns
    -------
    Fit of a `models.LaserSensor`. Parameters: position and rotation vector of T_tool_sensor (covariance of
    (R Exp(w), t + v): v in tool axes, w in sensor axes), then of each plane two tilts [rad] from the normal found, and
    its offset. Residuals (N, 2) in the laser plane: distance [m], angle [rad]; of raw profiles (M, 1).

    Raises
    ------
    ShapeError : another shape, NaN rows, no rotations; a plate parallel to the laser plane.
    NotExcited : too few scans; a direction that they do not tell, by name.
    NotConverged : no start fits the noise: labels, pairing, millimetres, wrong scans.

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
    words = Words(data, scene, planes, limits_of(limits))
    judge = partial(check_spread, found.rows.J, words.names, words.units, words.widths, "laser scanner", describe=words)
    excitation = unhurried(judge, found.cov, words.widths, found.null.shape[1])

    def summary(fit: Fit[LaserSensor]) -> str:
        found_planes = (f"plane {a}: n {np.round(n, 6)}, d {d:.6g} m" for a, n, d in zip(planes, scene.n, scene.d))
        chi2 = "" if data.noise is None else f"residuals {times(found):.3g} times the noise"
        wide = f"points spread over {words.spread:.3g} m: millimetres given as metres?" * (words.spread > FAR_APART)
        return "\n".join(line for line in [fit.table(), note, *found_planes, chi2, wide] if line)

    tilts = np.column_stack([np.zeros((len(planes), 2)), scene.d]).ravel()
    parameters = np.concatenate([scene.t, so3.log(scene.R), tilts])
    value = LaserSensor(se3.from_rp(scene.R, scene.t), scene.n, scene.d, planes)
    residuals = data.residuals(scene)
    return Fit(
        value, words.names, words.units, parameters, found.cov, found.sigma, residuals, data.N, excitation, summary,
        found.outliers, tuple(CLASSES[name] for name in found.classes),
    )  # fmt: skip

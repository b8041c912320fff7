"""Calibration of a laser line scanner on flat plates: where it sits on the tool, and where the plates are.

    e1 = (c_x p_x + c_y p_y - h) / k,        e2 = asin((c_x l_x + c_y l_y) / k)

Maximum likelihood of lines or raw profiles in the laser plane; plates through the origin are plates like others, and no
guess is needed. Bagge Carlson, Johansson and Robertsson (2015) posed the problem.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.calibrate._arguments import poses
from armlab.calibrate._hand_eye_words import limits_of
from armlab.calibrate._laser_data import scans_of
from armlab.calibrate._laser_equation import Scans, Scene
from armlab.calibrate._laser_start import scene_of, starts
from armlab.calibrate._laser_words import ROUGH, Words, misfit, require_motion, require_slant, require_units
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Fit, NonlinearSolution, check_spread, nonlinear_least_squares, unhurried
from armlab.lie import se3, so3
from armlab.models import LaserSensor

__all__ = ["fit_laser_plane"]

LIMITS = (0.2, 0.2)
SCHEDULE = (100.0, 30.0, 10.0, 5.0)
USUAL = (0.5e-3, 9e-3)  # noise of a search where none is given [m, rad]
REFUSED = 1e-4  # probability of a chi^2 as large as that of a fit that is not taken
CUBE = 24  # starts after which no others are tried where noise is not given
CLEAR = (2e-3, 0.03)  # residual over the spread of the points, and [rad], from which no other starts are tried
MANY = 0.35  # share of outliers from which another start is tried
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
    found = _best(data, guess, robust)
    scene = found.value
    require_slant(data, scene)
    words = Words(data, scene, planes, limits_of(limits))
    judge = partial(check_spread, found.rows.J, words.names, words.units, words.widths, "laser scanner", describe=words)
    excitation = unhurried(judge, found.cov, words.widths, found.null.shape[1])

    def summary(fit: Fit[LaserSensor]) -> str:
        found_planes = (f"plane {a}: n {np.round(n, 6)}, d {d:.6g} m" for a, n, d in zip(planes, scene.n, scene.d))
        chi2 = "" if data.noise is None else f"residuals {_times(found):.3g} times the noise"
        return "\n".join(line for line in [fit.table(), note, *found_planes, chi2] if line)

    tilts = np.column_stack([np.zeros((len(planes), 2)), scene.d]).ravel()
    parameters = np.concatenate([scene.t, so3.log(scene.R), tilts])
    value = LaserSensor(se3.from_rp(scene.R, scene.t), scene.n, scene.d, planes)
    residuals = data.residuals(scene)
    return Fit(
        value, words.names, words.units, parameters, found.cov, found.sigma, residuals, data.N, excitation, summary,
        found.outliers, tuple(CLASSES[name] for name in found.classes),
    )  # fmt: skip


def _best(scans: Scans, guess: np.ndarray | None, robust: bool) -> NonlinearSolution[Scene]:
    """Return the first fit that agrees with its noise, or the best of all where noise is not given."""
    count = 2 if scans.points is None else 1
    nominal = scans if scans.noise is not None else replace(scans, noise=np.square(USUAL[:count]))
    assumed = np.sqrt(np.asarray(nominal.noise))
    ratio = _ratio(scans, float(assumed[0]), float(assumed[-1]))
    require_units(scans, ratio)
    best: NonlinearSolution[Scene] | None = None
    for group in _groups(scans, guess, ratio):
        for scene in group:
            found = _tried(nominal, scene, robust)
            if found is None:
                continue
            if scans.noise is not None and _agrees(found):
                return _finished(scans, found, robust)
            if best is None or _rank(found) < _rank(best):
                best = found
        if best is None or len(group) == 1:  # one guess proves nothing
            continue
        if _is_clear(scans, best) or (scans.noise is None and len(group) >= CUBE):
            break
    if best is None or scans.noise is not None:
        text = "none that converge"
        if best is not None:
            text = f"residuals {_times(best):.3g} times the noise at best"
            text += f" and {int(best.outliers.sum())} of {scans.N} scans left out" if robust else ""
        raise misfit(scans, ratio, None if best is None else best.value, text)
    found = _finished(scans, best, robust)
    size, spread = float(found.sigma[0]), Words(scans, found.value, (), LIMITS).spread
    if size > ROUGH * spread or np.mean(found.outliers) > MANY:
        raise misfit(
            scans, ratio, found.value,
            f"{size:.3g} m between points and plates (RMS) where they spread over {spread:.3g} m, "
            f"{int(found.outliers.sum())} of {scans.N} scans left out",
        )  # fmt: skip
    return found


def _groups(scans: Scans, guess: np.ndarray | None, ratio: float) -> Iterator[list[Scene]]:
    if guess is not None:
        yield [scene_of(scans, guess)]
    yield from starts(scans, ratio)


def _ratio(scans: Scans, point: float, angle: float) -> float:
    """Return the deviation of points over that of angles [m/rad]; of raw profiles the spread of a typical one."""
    if scans.points is None:
        return point / angle
    off = scans.points - scans.p[scans.owner]
    return float(np.sqrt(np.median(np.bincount(scans.owner, np.sum(off * off, axis=1)) / np.bincount(scans.owner))))


def _tried(scans: Scans, scene: Scene, robust: bool) -> NonlinearSolution[Scene] | None:
    try:
        return nonlinear_least_squares(scans.problem(), scene, robust=robust, schedule=SCHEDULE)
    except (NotConverged, NotExcited, ShapeError, np.linalg.LinAlgError):
        return None


def _finished(scans: Scans, found: NonlinearSolution[Scene], robust: bool) -> NonlinearSolution[Scene]:
    """Return the fit with its own noise, and normals away from the origin."""
    if scans.noise is not None and np.all(found.value.d >= 0):
        return found
    return nonlinear_least_squares(scans.problem(), found.value.oriented(), robust=robust, schedule=SCHEDULE)


def _agrees(found: NonlinearSolution[Any]) -> bool:
    from scipy.special import chdtri

    free = found.freedom
    return bool((free == 0 or 2.0 * found.cost < chdtri(free, REFUSED)) and np.mean(found.outliers) <= MANY)


def _is_clear(scans: Scans, found: NonlinearSolution[Scene]) -> bool:
    """Return whether what is left is small beside the scene: points and angles."""
    left = np.median(np.abs(scans.residuals(found.value)), axis=0)
    near = left[0] < CLEAR[0] * Words(scans, found.value, (), LIMITS).spread
    return bool(near and left[-1] < CLEAR[1] and np.mean(found.outliers) <= MANY)


def _times(found: NonlinearSolution[Any]) -> float:
    """Return the residuals over the noise that was given."""
    return float(np.sqrt(2.0 * found.cost / max(found.freedom, 1)))


def _rank(found: NonlinearSolution[Any]) -> tuple[int, float]:
    return int(found.outliers.sum()), found.cost

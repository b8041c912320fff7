"""The search for the scene of a line scanner: short descents from many starts, the best of them to their end.

The best start of each group is fitted at once. Where that does not agree with the noise, every start of the group makes
a few steps with weights ``(c^2 / (c^2 + rho^2))^2`` over whole scans, rho in deviations that the median of the
residuals tells, so that neither noise that nobody gave nor wrong scans matter; the few that leave least are fitted.
So many steps are all that scans cost which nothing fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from armlab.calibrate._laser_equation import Scans, Scene
from armlab.calibrate._laser_start import scene_of, starts
from armlab.calibrate._laser_words import LIMITS, ROUGH, TURNED, Words, misfit, require_units
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import NonlinearSolution, nonlinear_least_squares
from armlab.estimation.nonlinear import descend
from armlab.estimation.robust import mad

__all__ = ["searched", "times"]

SCHEDULE = (100.0, 30.0, 10.0, 5.0)
REFUSED = 1e-4  # probability of a chi^2 as large as that of a fit that is not taken
MANY = 0.35  # share of outliers from which another start is tried
STEPS, TUNING, SETTLED = 9, 5.0, 1e-2  # of a short descent: most steps, c, last step in deviations
BEST, WORSE, SAME = 2, 5.0, 1e-3  # of a group: how many are fitted, how much worse than the best, how alike
LOST = 1.5  # rad, left by angles and by points made an angle, from which nothing is fitted: wrong labels leave 2 to 8
CLEAR = (2e-3, 0.03)  # residual over the spread of the points, and [rad], from which no other starts are tried
HELD = 0.6  # of a scan's two numbers: the share of what they say that they say alone, from which it is doubted
TINY = 1e-12  # m, rad: rounding


def searched(scans: Scans, guess: np.ndarray | None, robust: bool) -> NonlinearSolution[Scene]:
    """Return the first fit that agrees with its noise, or the best of all where noise is not given.

    Parameters
    ----------
    scans : checked. guess : (4, 4) pose of the sensor, or None. robust : find wrong scans.

    Raises
    ------
    NotConverged : nothing fits.
    """
    ratio = _ratio(scans)
    size = max(ratio, _spread(scans.p))
    require_units(scans, ratio)
    best: NonlinearSolution[Scene] | None = None
    for group in _groups(scans, guess, ratio):
        for found in _fitted(scans, group, size, robust):
            if scans.noise is not None and agrees(found):
                return _oriented(scans, _doubted(scans, found, size) if robust else found, robust)
            if best is None or _rank(scans, found, size, robust) < _rank(scans, best, size, robust):
                best = found
        if best is not None and len(group) > 1 and scans.noise is None and _is_clear(scans, best):
            break  # one guess alone proves nothing
    if best is None or scans.noise is not None:
        text = "none that converge"
        if best is not None:
            text = f"residuals {times(best):.3g} times the noise at best"
            text += f" and {int(best.outliers.sum())} of {scans.N} scans left out" if robust else ""
        raise misfit(scans, ratio, None if best is None else best.value, text)
    _require_fit(scans, ratio, best)
    return _oriented(scans, best, robust)


def agrees(found: NonlinearSolution[Scene]) -> bool:
    """Return whether residuals are as small as the noise that was given, and most scans count."""
    from scipy.special import chdtri

    free = found.freedom
    return bool((free == 0 or 2.0 * found.cost < chdtri(free, REFUSED)) and np.mean(found.outliers) <= MANY)


def times(found: NonlinearSolution[Scene]) -> float:
    """Return the residuals over the noise that was given."""
    return float(np.sqrt(2.0 * found.cost / max(found.freedom, 1)))


def _groups(scans: Scans, guess: np.ndarray | None, ratio: float) -> Iterator[list[Scene]]:
    if guess is not None:
        yield [scene_of(scans, guess)]
    yield from starts(scans, ratio)


def _ratio(scans: Scans) -> float:
    """Return the deviation of points over that of angles [m/rad], of a typical scan where noise is not given.

    A line through many points of a scan is as sure at its ends as these: the ratio is their spread along it.
    """
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
    """Yield the fit from the first start, then those from the ends of the best short descents."""
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
    """Return the scene after a short descent that neither the size of the noise nor wrong scans lead."""
    problem = replace(scans, noise=None).problem()
    names = ("p", "l")
    for _ in range(STEPS):
        r = scans.residuals(scene)
        sizes = np.maximum([mad(r[:, k]) for k in range(r.shape[1])], TINY)
        rho2 = np.mean((r / sizes) ** 2, axis=1)
        if scans.points is not None:
            rho2 = np.bincount(scans.owner, rho2) / np.bincount(scans.owner)
        weight = (TUNING**2 / (TUNING**2 + rho2)) ** 2
        try:
            found = descend(problem, scene, dict(zip(names, sizes)), weight, iterations=1, strict=False)
        except (NotConverged, NotExcited, ShapeError, np.linalg.LinAlgError):
            break
        scene = found.value
        if found.step < SETTLED:
            break
    return scene


def _left(scans: Scans, scene: Scene, size: float) -> float:
    """Return what a scene leaves: the median residual of angles, and that of points made an angle."""
    r = np.median(np.abs(scans.residuals(scene)), axis=0)
    left = float(r[0] / size + np.sum(r[1:]))
    return left if np.isfinite(left) else np.inf


def _tried(scans: Scans, scene: Scene, robust: bool) -> NonlinearSolution[Scene] | None:
    try:
        return nonlinear_least_squares(scans.problem(), scene, robust=robust, schedule=SCHEDULE)
    except (NotConverged, NotExcited, ShapeError, np.linalg.LinAlgError):
        return None


def _doubted(scans: Scans, found: NonlinearSolution[Scene], size: float) -> NonlinearSolution[Scene]:
    """Return the fit, or a better one without a scan that holds it: a wrong one may have others left out in its place.

    Where a plate is nearly parallel to the laser plane, one scan tells more of the rotation than all others.
    """
    held = np.einsum("ij,jk,ik->i", found.rows.J, found.cov, found.rows.J)
    numbers = np.bincount(found.rows.sample, minlength=scans.N)
    strong = np.bincount(found.rows.sample, held, minlength=scans.N) > HELD * np.minimum(numbers, 2)
    for i in np.flatnonzero(strong & ~found.outliers).tolist():
        try:
            rest = nonlinear_least_squares(scans.without(i).problem(), found.value, robust=True, schedule=SCHEDULE)
            other = nonlinear_least_squares(scans.problem(), rest.value, robust=True, schedule=SCHEDULE[-1:])
        except (NotConverged, NotExcited, ShapeError, np.linalg.LinAlgError):
            continue
        if agrees(other) and _rank(scans, other, size, True) < _rank(scans, found, size, True):
            found = other
    return found


def _oriented(scans: Scans, found: NonlinearSolution[Scene], robust: bool) -> NonlinearSolution[Scene]:
    """Return the fit with normals away from the origin."""
    if np.all(found.value.d >= 0):
        return found
    return nonlinear_least_squares(scans.problem(), found.value.oriented(), robust=robust, schedule=SCHEDULE[-1:])


def _is_clear(scans: Scans, found: NonlinearSolution[Scene]) -> bool:
    """Return whether what is left is small beside the scene: points and angles."""
    left = np.median(np.abs(scans.residuals(found.value)), axis=0)
    near = left[0] < CLEAR[0] * Words(scans, found.value, (), LIMITS).spread
    return bool(near and (len(left) == 1 or left[1] < CLEAR[1]) and np.mean(found.outliers) <= MANY)


def _rank(scans: Scans, found: NonlinearSolution[Scene], size: float, robust: bool) -> float:
    """Return what to make small: chi^2 of given noise, otherwise minus the logarithm of the likelihood per scan."""
    if scans.noise is not None:
        return float(found.outliers.sum()) + times(found) if robust else found.cost
    if robust:
        return _left(scans, found.value, size)
    return float(np.sum(np.log(np.maximum(found.sigma, TINY))))


def _require_fit(scans: Scans, ratio: float, found: NonlinearSolution[Scene]) -> None:
    """Refuse what leaves more than any scanner errs, where noise is not given."""
    size, spread = float(found.sigma[0]), Words(scans, found.value, (), LIMITS).spread
    turn = float(found.sigma[1]) if len(found.sigma) > 1 else 0.0
    if size <= ROUGH * spread and turn <= TURNED and np.mean(found.outliers) <= MANY:
        return
    angles = f", {turn:.2g} rad between lines and plates" if turn else ""
    raise misfit(
        scans, ratio, found.value,
        f"{size:.3g} m between points and plates (RMS) where they spread over {spread:.3g} m{angles}, "
        f"{int(found.outliers.sum())} of {scans.N} scans left out",
    )  # fmt: skip

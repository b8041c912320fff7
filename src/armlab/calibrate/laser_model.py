"""Model of a laser line on flat plates: residuals in the laser plane, with Jacobian.

With g = R_i^T n, c = R_X^T g, h = d - n.t_i - g.t_X and k = hypot(c_x, c_y):

    e1 = (c_x p_x + c_y p_y - h) / k [m],        e2 = asin((c_x l_x + c_y l_y) / k) [rad]

Initial guesses come from one linear system per plate, then from the rotations of a cube, then from random rotations.
Errors name the undetermined directions or the likely cause of a misfit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from armlab.calibrate.diagnostics import ALIGNED, UNSEEN, axis_text, require_two_axes
from armlab.calibrate.inputs import rows_text
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Measurement, NonlinearProblem
from armlab.lie import quaternion, so3

TINY = 1e-12
ENOUGH = 15  # scans per plate needed for a linear initial guess
RESTARTS = 20  # random rotations
PRODUCT = 0.3  # ratio of the second to the first singular value above which a matrix is not nearly rank one
LIMITS = (0.2, 0.2)  # largest accepted standard deviations: fraction of the point spread, and angle [rad]
FLAT = 0.05  # sine of the angle between plate and laser plane below which a scan is unusable
SHAKEN = 1e-3  # accuracy of robot orientations [rad]; smaller rotations count as zero
UNITS, FAR = 2.0, 20.0  # ratios of length units above which the ratio is reported, and above which no fit is tried
ROUGH = 0.1  # ratio of the residual to the spread of the points above which scans are inconsistent
FAR_APART = 30.0  # spread [m] larger than any robot cell, for example 300, which is 30 cm in millimetres
TURNED = 0.2  # residual angle [rad] above which scans are inconsistent


class Scene(NamedTuple):
    """Pose of the sensor on the tool, R (3, 3) and t (3,), and planes, n (P, 3) and d (P,)."""

    R: np.ndarray
    t: np.ndarray
    n: np.ndarray
    d: np.ndarray

    def plus(self, x: np.ndarray) -> Scene:
        """Return the scene after a step (v, w, and two tilts and an offset for each plane)."""
        tilts = x[6:].reshape(-1, 3)
        n = self.n + np.einsum("jab,jb->ja", tangents(self.n), tilts[:, :2])
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        return Scene(self.R @ so3.exp(x[3:6]), self.t + x[:3], n, self.d + tilts[:, 2])

    def oriented(self) -> Scene:
        """Return the scene with normals pointing away from the origin."""
        sign = np.where(self.d < 0, -1.0, 1.0)
        return Scene(self.R, self.t, self.n * sign[:, None], self.d * sign)


def tangents(n: np.ndarray) -> np.ndarray:
    """Return two orthonormal vectors (P, 3, 2) normal to each n (P, 3)."""
    cross = so3.hat(n)
    B = np.empty((len(n), 3, 2))
    first = -cross[np.arange(len(n)), :, np.argmin(np.abs(n), axis=1)]  # e x n, with e the axis least parallel to n
    B[:, :, 0] = first / np.sqrt(np.einsum("ji,ji->j", first, first))[:, None]
    B[:, :, 1:] = cross @ B[:, :, :1]
    return B


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans of plates as lines or points."""

    RA: np.ndarray  # (N, 3, 3) rotations of T_base_tool
    tA: np.ndarray  # (N, 3) positions of T_base_tool
    plane: np.ndarray  # (N,) index of the plate
    p: np.ndarray  # (N, 2) point on the line in each scan
    line: np.ndarray  # (N, 2) unit direction of the line in each scan
    points: np.ndarray | None  # (M, 2) raw points, or None if lines were measured
    owner: np.ndarray  # (M,) scan of each point
    noise: np.ndarray | None  # variances (2,) of points and angles, or (1,) of raw points; None: estimated

    @property
    def N(self) -> int:
        return len(self.tA)

    @cached_property
    def P(self) -> int:
        return int(self.plane.max()) + 1

    def without(self, i: int) -> Scans:
        keep, rows = np.arange(self.N) != i, self.owner != i
        owner = self.owner[rows] - (self.owner[rows] > i)
        points = None if self.points is None else self.points[rows]
        return Scans(
            self.RA[keep], self.tA[keep], self.plane[keep], self.p[keep], self.line[keep], points, owner, self.noise
        )

    @property
    def numbers(self) -> int:
        return 2 * self.N if self.points is None else len(self.points)

    def seen(self, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return g and c (N, 3) and h (N,) as defined in the module docstring."""
        n = scene.n[self.plane]
        g = np.einsum("nij,ni->nj", self.RA, n)
        return g, g @ scene.R, scene.d[self.plane] - np.sum(n * self.tA, axis=1) - g @ scene.t

    def evaluate(self, scene: Scene) -> list[Measurement]:
        """Return the point distances from the plate in the laser plane, and the line angles.

        With a = p - e1 c / k and b = (-c_y, c_x) / k^2, de1 = (a . dc - dh) / k and de2 = +- b . dc.
        """
        g, c, h = self.seen(scene)
        k = np.maximum(np.hypot(c[:, 0], c[:, 1]), TINY)
        r = self._off(c, h, k)
        own, p = (slice(None), self.p) if self.points is None else (self.owner, self.points)
        c, k, classes = c[own], k[own, None], ("p", "l")[: r.shape[1]]
        levers = np.empty((len(r), r.shape[1], 2))  # lever arms of dc in the laser plane
        levers[:, 0] = (p - r[:, :1] * c[:, :2] / k) / k
        if self.points is None:
            across = np.stack([-c[:, 1], c[:, 0]], axis=1)
            levers[:, 1] = across * np.sign(np.einsum("ni,ni->n", across, self.line))[:, None] / k**2
        B = tangents(scene.n)[self.plane]
        J = np.zeros((len(r), r.shape[1], 6 + 3 * self.P))
        J[:, 0, :3] = g[own] / k
        J[:, :, 3] = levers[..., 1] * c[:, None, 2]
        J[:, :, 4] = -levers[..., 0] * c[:, None, 2]
        J[:, :, 5] = levers[..., 0] * c[:, None, 1] - levers[..., 1] * c[:, None, 0]
        tilts = np.zeros((len(r), r.shape[1], 3))
        tilts[:, :, :2] = levers @ ((self.RA @ scene.R[:, :2]).transpose(0, 2, 1) @ B)[own]
        arm = self.tA + self.RA @ scene.t
        tilts[:, 0, :2] += np.einsum("na,nab->nb", arm, B)[own] / k
        tilts[:, 0, 2:] = -1.0 / k
        at = 6 + 3 * self.plane[own][:, None] + np.arange(3)
        J[np.arange(len(r))[:, None], :, at] = tilts.transpose(0, 2, 1)
        return [Measurement(r, J, self.noise, classes, np.arange(self.N) if self.points is None else self.owner)]

    def residuals(self, scene: Scene) -> np.ndarray:
        """Return the residuals of `evaluate`: (N, 2), or (M, 1) for raw points."""
        _, c, h = self.seen(scene)
        return self._off(c, h, np.maximum(np.hypot(c[:, 0], c[:, 1]), TINY))

    def _off(self, c: np.ndarray, h: np.ndarray, k: np.ndarray) -> np.ndarray:
        if self.points is not None:
            own = self.owner
            return ((np.einsum("ni,ni->n", c[own, :2], self.points) - h[own]) / k[own])[:, None]
        r = np.empty((self.N, 2))
        r[:, 0] = (np.einsum("ni,ni->n", c[:, :2], self.p) - h) / k
        sine = np.einsum("ni,ni->n", c[:, :2], self.line) / k
        r[:, 1] = np.arcsin(np.minimum(np.maximum(sine, -1.0), 1.0))
        return r

    def problem(self) -> NonlinearProblem[Scene]:
        return NonlinearProblem(self.evaluate, Scene.plus, what="laser scanner")

    def spread(self, scene: Scene) -> float:
        """Return the spread of the measured points [m]: RMS distance from their mean in base axes."""
        q = self.p @ scene.R[:, :2].T + scene.t
        q = np.einsum("nij,nj->ni", self.RA, q) + self.tA
        return float(np.sqrt(np.mean(np.sum((q - q.mean(axis=0)) ** 2, axis=1)))) or 1.0


def starts(scans: Scans, ratio: float) -> Iterator[list[Scene]]:
    """Yield groups of initial guesses, best first; `ratio` is the point SD divided by the angle SD."""
    linear = [R for j in range(scans.P) for R in linear_rotations(scans, j, ratio)[0]]
    if linear:
        yield _sorted(scans, linear, ratio)
    yield _sorted(scans, list(cube()), ratio)
    q = np.random.default_rng(0).standard_normal((RESTARTS, 4))
    yield _sorted(scans, list(quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))), ratio)


def cube() -> Iterator[np.ndarray]:
    """Yield the 24 rotations of a cube."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(R) > 0:
                yield R


def _sorted(scans: Scans, rotations: list[np.ndarray], ratio: float) -> list[Scene]:
    scenes = [scene_of(scans, R) for R in rotations]
    off = [scans.residuals(scene) for scene in scenes]
    costs = [float(np.sum((r * np.array([1.0, ratio])[: r.shape[1]]) ** 2)) for r in off]
    return [scenes[i] for i in np.argsort(costs, kind="stable")]


def linear_rotations(scans: Scans, j: int, ratio: float) -> tuple[list[np.ndarray], float]:
    """Return rotations from the scans of plate j, and the ratio of scan to pose length units (1 if unknown).

    p_x n.R_i r1 + p_y n.R_i r2 + n.R_i t + n.t_i - d = 0 and l_x n.R_i r1 + l_y n.R_i r2 = 0 are linear in
    [n (x) r1, n (x) r2, n (x) t, n, d], up to scale.
    """
    mine = scans.plane == j
    if np.count_nonzero(mine) < ENOUGH:
        return [], 1.0
    R, p, line = scans.RA[mine].reshape(-1, 9), scans.p[mine], scans.line[mine]
    middle = scans.tA[mine].mean(axis=0)
    t = scans.tA[mine] - middle
    A = np.hstack([p[:, :1] * R, p[:, 1:] * R, R, t, -np.ones((len(R), 1))])
    B = np.hstack([line[:, :1] * R, line[:, 1:] * R, np.zeros((len(R), 13))]) * ratio
    z = np.linalg.svd(np.linalg.qr(np.vstack([A, B]), mode="r"))[2][-1]
    pairs = np.hstack([z[:9].reshape(3, 3), z[9:18].reshape(3, 3)])
    _, s, V = np.linalg.svd(pairs)
    found = []
    for sign in (1.0, -1.0):
        r1, r2 = sign * V[0, :3], sign * V[0, 3:]
        U, _, W = np.linalg.svd(np.stack([r1, r2], axis=1), full_matrices=False)
        r1, r2 = (U @ W).T
        found.append(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    size = float(np.linalg.norm(z[27:30]))
    known = size > 0 and s[1] < PRODUCT * s[0]  # the matrix is nearly rank one
    return found, float(s[0] / np.sqrt(2.0) / size) if known else 1.0


def scene_of(scans: Scans, R: np.ndarray) -> Scene:
    """Return the best planes and position for a sensor rotation R; the lines determine the normals."""
    lines = np.einsum("nij,nj->ni", scans.RA, scans.line @ R[:, :2].T)
    across = (lines[scans.plane == j] for j in range(scans.P))
    n = np.linalg.eigh(np.stack([one.T @ one for one in across]))[1][:, :, 0]
    own = n[scans.plane]
    A = np.zeros((scans.N, 3 + scans.P))
    A[:, :3] = np.einsum("ni,nij->nj", own, scans.RA)
    A[np.arange(scans.N), 3 + scans.plane] = -1.0
    reach = np.einsum("nij,nj->ni", scans.RA, scans.p @ R[:, :2].T) + scans.tA
    x = np.linalg.lstsq(A, -np.sum(own * reach, axis=1), rcond=None)[0]
    return Scene(R, x[:3], n, x[3:]).oriented()


@dataclass(frozen=True, eq=False)
class SceneUnknowns:
    """Names, units and limits of the unknowns, and descriptions of directions for `check_spread`."""

    scans: Scans
    scene: Scene  # estimated scene
    planes: tuple[str, ...]  # labels of the planes
    limits: tuple[float, float]  # fraction of the spread of the points, and angle [rad]

    @cached_property
    def names(self) -> tuple[str, ...]:
        pose = [f"T_tool_sensor {'r' * turn}{axis}" for turn in (0, 1) for axis in "xyz"]
        return (*pose, *(f"plane {label} {what}" for label in self.planes for what in ("tilt 1", "tilt 2", "offset")))

    @cached_property
    def units(self) -> tuple[str, ...]:
        return (*("m",) * 3, *("rad",) * 3, *("rad", "rad", "m") * len(self.planes))

    @cached_property
    def widths(self) -> np.ndarray:
        spread = self.scans.spread(self.scene)
        return np.array([self.limits[0] * spread if unit == "m" else self.limits[1] for unit in self.units])

    def __call__(self, step: np.ndarray) -> str:
        """Return a description such as "translation of the sensor along tool axis z, 0.4 m"."""
        widths = self.widths
        sizes = np.linalg.norm((step / widths).reshape(-1, 3), axis=1)
        first = int(np.flatnonzero(sizes > 0.5 * sizes.max())[0])
        part = step[3 * first : 3 * first + 3]
        if first == 0:
            text, unit = f"translation of the sensor along {axis_text(part, 'tool')}", "m"
        elif first == 1:
            u, line = part / np.linalg.norm(part), np.append(self.scans.line.T @ np.sign(self.scans.line[:, :1]), 0.0)
            along = abs(u @ line) > ALIGNED * np.linalg.norm(line)
            text = f"rotation about the {'laser line' if along else axis_text(part, 'sensor')}"
            unit = "rad"
        else:
            label = self.planes[first - 2]
            tilted = np.linalg.norm(part[:2] / widths[3 * first]) > abs(part[2] / widths[3 * first + 2])
            text, unit = (f"tilt of plane {label}", "rad") if tilted else (f"offset of plane {label}", "m")
            part = part[:2] if tilted else part[2:]
        if abs(np.linalg.norm(step / widths) - 1.0) < UNSEEN:
            return text
        return f"{text}, {np.linalg.norm(part):.2g} {unit}"


def require_motion(scans: Scans, planes: tuple[str, ...]) -> None:
    """Raise an error for too few scans, and for orientations that do not determine the sensor position."""
    needed = 7 + 3 * scans.P
    few = [str(planes[j]) for j in range(scans.P) if np.count_nonzero(scans.plane == j) < 2]
    if scans.numbers < needed or few:
        where = f"planes {', '.join(few)} with only one scan" if few else f"{scans.N} scans"
        raise NotExcited(
            f"Expected at least {needed} values and two scans of each of {scans.P} planes, got {scans.numbers} "
            f"values from {where}. Scan each plate from many directions.",
            [where],
            [f"{scans.numbers} values (at least {needed} required)"],
        )
    require_two_axes(scans.RA, SHAKEN, "tool", ("the sensor", "every plane"))


def require_slant(scans: Scans, scene: Scene) -> None:
    bad = np.flatnonzero(np.hypot(*scans.seen(scene)[1][:, :2].T) < FLAT)
    if len(bad):
        raise ShapeError(
            f"Expected plates that intersect the laser plane, got parallel plates (sine below {FLAT}) in rows "
            f"{rows_text(bad)}. Drop these scans."
        )


def require_units(scans: Scans, ratio: float) -> None:
    """Raise an error before the fit if the length units of scans and poses differ greatly."""
    size = _unit(scans, ratio)
    if not 1.0 / FAR < size < FAR:
        raise misfit(scans, ratio, None, f"lengths {size:.2g} times those of the poses")


def _unit(scans: Scans, ratio: float) -> float:
    """Return the ratio of the length unit of the poses to that of the scans, or 1 if the plates disagree."""
    sizes = [linear_rotations(scans, j, ratio)[1] for j in range(scans.P)]
    agreed = np.ptp(np.log(np.maximum(sizes, 1e-300))) < np.log(UNITS)
    return float(np.median(sizes)) if agreed else 1.0


def misfit(scans: Scans, ratio: float, best: Scene | None, text: str) -> NotConverged:
    """Return the error, with the likely cause, for scans that cannot be fitted from any initial guess."""
    size = _unit(scans, ratio)
    cause = "Check the plate labels and the pairing of scans and poses, or detect outliers with robust=True."
    if not 1.0 / UNITS < size < UNITS:
        cause = f"The scans would fit with lengths scaled by {size:.2g}."
        if not 1.0 / FAR < size < FAR:
            cause = f"{cause[:-1]}; perhaps millimetres were given as metres."
    return NotConverged(
        f"Expected scans of flat plates from one sensor, got {text}. {cause}", best=best, reason="misfit"
    )

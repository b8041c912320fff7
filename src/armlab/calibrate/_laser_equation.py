"""A laser line on a plate: residuals in the laser plane with their Jacobian.

With g = R_i^T n, c = R_X^T g, h = d - n.t_i - g.t_X and k = hypot(c_x, c_y):

    e1 = (c_x p_x + c_y p_y - h) / k [m],        e2 = asin((c_x l_x + c_y l_y) / k) [rad]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from armlab.estimation import Measurement, NonlinearProblem
from armlab.lie import so3

TINY = 1e-12


class Scene(NamedTuple):
    """Pose of the sensor on the tool, and planes: R (3, 3), t (3,), n (P, 3), d (P,)."""

    R: np.ndarray
    t: np.ndarray
    n: np.ndarray
    d: np.ndarray

    def plus(self, x: np.ndarray) -> Scene:
        """Return the scene after a step (v, w, then two tilts and an offset for each plane)."""
        tilts = x[6:].reshape(-1, 3)
        n = self.n + np.einsum("jab,jb->ja", tangents(self.n), tilts[:, :2])
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        return Scene(self.R @ so3.exp(x[3:6]), self.t + x[:3], n, self.d + tilts[:, 2])

    def oriented(self) -> Scene:
        """Return it with normals that point away from the origin."""
        sign = np.where(self.d < 0, -1.0, 1.0)
        return Scene(self.R, self.t, self.n * sign[:, None], self.d * sign)


def tangents(n: np.ndarray) -> np.ndarray:
    """Return bases (P, 3, 2) of the planes across unit normals (P, 3)."""
    cross = so3.hat(n)
    B = np.empty((len(n), 3, 2))
    first = -cross[np.arange(len(n)), :, np.argmin(np.abs(n), axis=1)]  # e x n, e the axis farthest from n
    B[:, :, 0] = first / np.sqrt(np.einsum("ji,ji->j", first, first))[:, None]
    B[:, :, 1:] = cross @ B[:, :, :1]
    return B


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans of plates, as lines or as points.

    Attributes
    ----------
    RA, tA : (N, 3, 3), (N, 3) of T_base_tool. plane : (N,) number of the plate.
    p, line : (N, 2) point and unit direction of the line in each scan.
    points : (M, 2) raw, or None; then lines are what was measured. owner : (M,) scan of each point.
    noise : (2,) variances of point and angle, (1,) of points; None when it is to be estimated.
    """

    RA: np.ndarray
    tA: np.ndarray
    plane: np.ndarray
    p: np.ndarray
    line: np.ndarray
    points: np.ndarray | None
    owner: np.ndarray
    noise: np.ndarray | None

    @property
    def N(self) -> int:
        """Number of scans."""
        return len(self.tA)

    @cached_property
    def linear(self) -> dict[float, Any]:
        """What was found of each plate alone, see `linear_rotations`: asked for units and for starts."""
        return {}

    @cached_property
    def P(self) -> int:
        """Number of plates."""
        return int(self.plane.max()) + 1

    def without(self, i: int) -> Scans:
        """Return all scans but one."""
        keep, rows = np.arange(self.N) != i, self.owner != i
        owner = self.owner[rows] - (self.owner[rows] > i)
        points = None if self.points is None else self.points[rows]
        return Scans(
            self.RA[keep], self.tA[keep], self.plane[keep], self.p[keep], self.line[keep], points, owner, self.noise
        )

    @property
    def numbers(self) -> int:
        """How many numbers were measured."""
        return 2 * self.N if self.points is None else len(self.points)

    def seen(self, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return g, c (N, 3) and h (N,)."""
        n = scene.n[self.plane]
        g = np.einsum("nij,ni->nj", self.RA, n)
        return g, g @ scene.R, scene.d[self.plane] - np.sum(n * self.tA, axis=1) - g @ scene.t

    def slant(self, scene: Scene) -> np.ndarray:
        """Return k (N,): sine of the angle between plate and laser plane."""
        return np.hypot(*self.seen(scene)[1][:, :2].T)

    def evaluate(self, scene: Scene) -> list[Measurement]:
        """Return the distance of points from the plate in the laser plane, and the angle of lines.

        With a = p - e1 c / k and b = (-c_y, c_x) / k^2, in the laser plane: de1 = (a . dc - dh) / k, de2 = +- b . dc.
        """
        g, c, h = self.seen(scene)
        k = np.maximum(np.hypot(c[:, 0], c[:, 1]), TINY)
        r = self._off(c, h, k)
        own, p = (slice(None), self.p) if self.points is None else (self.owner, self.points)
        c, k, classes = c[own], k[own, None], ("p", "l")[: r.shape[1]]
        levers = np.empty((len(r), r.shape[1], 2))  # of dc in the laser plane
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
        """Return the residuals (N, 2), or (M, 1) of raw points, of `evaluate`."""
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
        """Return what the solver needs."""
        return NonlinearProblem(self.evaluate, Scene.plus, what="laser scanner")

    def base_points(self, scene: Scene) -> np.ndarray:
        """Return the points (N, 3) of the lines in base axes."""
        q = self.p @ scene.R[:, :2].T + scene.t
        return np.einsum("nij,nj->ni", self.RA, q) + self.tA

"""A laser line on a plate: residuals in the laser plane with their Jacobian.

With g = R_i^T n, c = R_X^T g, h = d - n.t_i - g.t_X and k = hypot(c_x, c_y):

    e1 = (c_x p_x + c_y p_y - h) / k [m],        e2 = asin((c_x l_x + c_y l_y) / k) [rad]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from armlab.estimation import Measurement, Problem
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
    first = so3.hat(-n)[np.arange(len(n)), :, np.argmin(np.abs(n), axis=1)]  # e x n, e the axis farthest from n
    first /= np.sqrt(np.einsum("ji,ji->j", first, first))[:, None]
    return np.stack([first, np.einsum("jab,jb->ja", so3.hat(n), first)], axis=2)


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
        """Return the distance of points from the plate in the laser plane, and the angle of lines."""
        g, c, h = self.seen(scene)
        rows, at = np.arange(self.N), 6 + 3 * self.plane
        dc, dh = np.zeros((self.N, 3, 6 + 3 * self.P)), np.zeros((self.N, 6 + 3 * self.P))
        dc[:, :, 3:6] = so3.hat(c)
        B = tangents(scene.n)[self.plane]
        turned = scene.R.T @ (self.RA.transpose(0, 2, 1) @ B)
        dh[:, :3] = -g
        arm = self.tA + self.RA @ scene.t
        tilt = -np.einsum("na,nab->nb", arm, B)
        for i in range(2):
            dc[rows, :, at + i] = turned[:, :, i]
            dh[rows, at + i] = tilt[:, i]
        dh[rows, at + 2] = 1.0
        k = np.maximum(np.hypot(c[:, 0], c[:, 1]), TINY)
        dk = (c[:, :1] * dc[:, 0] + c[:, 1:2] * dc[:, 1]) / k[:, None]
        own, p = (rows, self.p) if self.points is None else (self.owner, self.points)
        r = self._off(c, h, k)
        J1 = p[:, :1] * dc[own, 0] + p[:, 1:] * dc[own, 1] - dh[own] - r[:, :1] * dk[own]
        J1 /= k[own, None]
        if self.points is not None:
            return [Measurement(r, J1[:, None], self.noise, ("p",), own)]
        side = np.sign(c[:, 0] * self.line[:, 1] - c[:, 1] * self.line[:, 0])
        J2 = (side / k**2)[:, None] * (c[:, :1] * dc[:, 1] - c[:, 1:2] * dc[:, 0])
        return [Measurement(r, np.stack([J1, J2], axis=1), self.noise, ("p", "l"), own)]

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

    def problem(self) -> Problem[Scene]:
        """Return what the solver needs."""
        return Problem(self.evaluate, Scene.plus, what="laser scanner")

    def base_points(self, scene: Scene) -> np.ndarray:
        """Return the points (N, 3) of the lines in base axes."""
        q = self.p @ scene.R[:, :2].T + scene.t
        return np.einsum("nij,nj->ni", self.RA, q) + self.tA

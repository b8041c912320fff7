"""First values for a laser scanner: one linear system per plate, then rotations of a cube, then random ones."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from armlab.calibrate._laser_equation import Scans, Scene
from armlab.lie import quaternion

ENOUGH = 15  # scans of a plate that a linear start needs
RESTARTS = 20
PRODUCT = 0.3  # second singular value over the first beyond which what should be a product is none


def starts(scans: Scans, ratio: float) -> Iterator[list[Scene]]:
    """Yield groups of first values, the best of each group first.

    Parameters
    ----------
    scans : of plates. ratio : deviation of points over that of angles.
    """
    linear = [R for found, _ in linear_rotations(scans, ratio) for R in found]
    if linear:
        yield _sorted(scans, linear, ratio)
    yield _sorted(scans, list(cube()), ratio)
    q = np.random.default_rng(0).standard_normal((RESTARTS, 4))
    yield _sorted(scans, list(quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))), ratio)


def cube() -> Iterator[np.ndarray]:
    """Yield the 24 rotations that turn the axes into each other."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(R) > 0:
                yield R


def _sorted(scans: Scans, rotations: list[np.ndarray], ratio: float) -> list[Scene]:
    scenes = [scene_of(scans, R) for R in rotations]
    costs = [_cost(scans, scene, ratio) for scene in scenes]
    return [scenes[i] for i in np.argsort(costs, kind="stable")]


def _cost(scans: Scans, scene: Scene, ratio: float) -> float:
    r = scans.residuals(scene)
    r = r * np.array([1.0, ratio])[: r.shape[1]]
    return float(np.vdot(r, r))


def linear_rotations(scans: Scans, ratio: float) -> tuple[tuple[list[np.ndarray], float], ...]:
    """Return rotations from the scans of each plate alone, and the unit of length of the scans over that of the poses.

    The unit is 1 where the scans do not tell it: it counts only if the products are products.

    p_x n.R_i r1 + p_y n.R_i r2 + n.R_i t + n.t_i - d = 0 and l_x n.R_i r1 + l_y n.R_i r2 = 0 are linear in
    [n (x) r1, n (x) r2, n (x) t, n, d], up to scale.
    """
    known = scans.linear
    if ratio not in known:
        known[ratio] = tuple(_linear(scans, j, ratio) for j in range(scans.P))
    return known[ratio]


def _linear(scans: Scans, j: int, ratio: float) -> tuple[list[np.ndarray], float]:
    mine = scans.plane == j
    if np.count_nonzero(mine) < ENOUGH:
        return [], 1.0
    R, p, line = scans.RA[mine].reshape(-1, 9), scans.p[mine], scans.line[mine]
    middle = scans.tA[mine].mean(axis=0)
    t = scans.tA[mine] - middle
    A = np.hstack([p[:, :1] * R, p[:, 1:] * R, R, t, -np.ones((len(R), 1))])
    B = np.hstack([line[:, :1] * R, line[:, 1:] * R, np.zeros((len(R), 13))]) * ratio
    rows = np.vstack([A, B])
    z = np.linalg.svd(rows)[2][-1]
    pairs = np.hstack([z[:9].reshape(3, 3), z[9:18].reshape(3, 3)])
    _, s, V = np.linalg.svd(pairs)
    found = []
    for sign in (1.0, -1.0):
        r1, r2 = sign * V[0, :3], sign * V[0, 3:]
        U, _, W = np.linalg.svd(np.stack([r1, r2], axis=1), full_matrices=False)
        r1, r2 = (U @ W).T
        found.append(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    size = float(np.linalg.norm(z[27:30]))
    told = size > 0 and s[1] < PRODUCT * s[0]
    return found, float(s[0] / np.sqrt(2.0) / size) if told else 1.0


def scene_of(scans: Scans, R: np.ndarray) -> Scene:
    """Return planes and position that go best with a rotation R of the sensor: lines give normals, points the rest."""
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

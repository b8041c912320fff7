"""Poses of a marker from its points, for example LEDs: rigid least squares for every frame of a tracker.

    T_i = argmin sum_k |p_ik - T l_k|^2  over the visible points

by the singular vectors of ``sum (p - mean p)(l - mean l)^T`` (Kabsch 1976; Umeyama 1991), never a reflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only, number
from armlab.errors import NotExcited, ShapeError
from armlab.frames.inputs import marker_points, sightings
from armlab.lie import so3

LINE = 1e-6  # breadth over length below which points lie in a line
FEWEST = 3


@dataclass(frozen=True, eq=False)
class MarkerPoses:
    """Poses of a marker, one per frame of the tracker, in its order.

    Attributes
    ----------
    T : (N, 4, 4) T_cam_marker; NaN where too few points were visible.
    valid : (N,) where there is a pose.
    rms : (N,) root mean square distance of the visible points from the marker's [m]; NaN where there is no pose.
    cov : (N, 6, 6) of [v; w], v in camera axes, w in marker axes; NaN where there is no pose.
    noise : deviation of each coordinate of a point [m], given or found; NaN where it cannot be estimated.
    marker : (K, 3) the points in marker axes [m], given or found.
    """

    T: np.ndarray
    valid: np.ndarray
    rms: np.ndarray
    cov: np.ndarray
    noise: float
    marker: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "T", "valid", "rms", "cov", "marker")


def marker_pose(
    p: ArrayLike, marker: ArrayLike | None = None, *, visible: ArrayLike | None = None, noise: float | None = None
) -> MarkerPoses:
    """Find the pose of a marker in every frame from the points that are visible in it.

    As many poses come out as frames go in, so that they stay paired with the poses of a robot. An LED that is off by
    3 mm shows in `rms`.

    Parameters
    ----------
    p : (N, K, 3) points in camera axes [m]; NaN only where not visible.
    marker : (K, 3) the same points in marker axes [m]. None, for three points: from the medians of their distances;
        origin at point 0, x towards point 1, point 2 on the side of positive y.
    visible : (N, K) which points were seen; all when left out.
    noise : deviation of each coordinate of a point [m]; found from what the points of a frame do not agree on when left
        out.

    Returns
    -------
    MarkerPoses.

    Raises
    ------
    ShapeError : another shape, NaN where visible, with its rows.
    NotExcited : a marker of fewer than three points, or with all of them in a line.

    References
    ----------
    Kabsch (1976), Acta Crystallographica A32; Umeyama (1991), PAMI 13(4).
    """
    p, seen = sightings(p, visible, "p")
    p = np.where(seen[:, :, None], p, 0.0)
    shape = _template(p, seen) if marker is None else marker_points(marker, p.shape[1], "p")
    _require_breadth(shape)
    sd = np.nan if noise is None else number(noise, "noise [m]")
    if noise is not None and not 0.0 < sd < np.inf:
        raise ShapeError(f"Expected noise above zero [m], got {sd:g}. Leave it out to have it found.")
    count = seen.sum(axis=1)
    share = seen / np.maximum(count, 1)[:, None]
    there, here = share[:, None, :] @ p, share @ shape  # centres (N, 1, 3) and (N, 3)
    weighted = np.where(seen[:, :, None], p - there, 0.0)
    body = shape - here[:, None, :]
    R, sigma = so3.nearest(np.swapaxes(weighted, 1, 2) @ body)
    turned = seen[:, :, None] * (body @ np.swapaxes(R, 1, 2))
    spread = np.einsum("nki,nki->n", seen[:, :, None] * body, body)
    valid = (count >= FEWEST) & (sigma[:, 1] + sigma[:, 2] > LINE * np.maximum(spread, np.finfo(float).tiny))
    left = np.einsum("nki,nki->n", weighted - turned, weighted - turned)
    T = np.full((len(p), 4, 4), np.nan)
    T[valid, :3, :3], T[valid, 3] = R[valid], (0.0, 0.0, 0.0, 1.0)
    T[valid, :3, 3] = there[valid, 0] - (R[valid] @ here[valid, :, None])[:, :, 0]
    rms = np.where(valid, np.sqrt(left / np.maximum(count, 1)), np.nan)
    freedom = int(np.sum(3 * count[valid] - 6))
    if noise is None and freedom:
        sd = float(np.sqrt(left[valid].sum() / freedom))
    cov = np.full((len(p), 6, 6), np.nan)
    cov[valid] = sd**2 * np.linalg.inv(_information(R[valid], shape, seen[valid]))
    return MarkerPoses(T, valid, rms, cov, sd, shape)


def _information(R: np.ndarray, marker: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return J^T J (n, 6, 6) of p = R Exp(w) l + t + v: J = [I, -R hat(l)]."""
    J = np.zeros((*seen.shape, 3, 6))
    J[..., :3] = np.eye(3)
    J[..., 3:] = -R[:, None] @ so3.hat(marker)
    J *= seen[:, :, None, None]
    flat = J.reshape(len(J), -1, 6)
    return np.swapaxes(flat, 1, 2) @ flat


def _template(p: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return three points (3, 3) with the median distances of those measured."""
    if p.shape[1] != FEWEST:
        raise NotExcited(
            f"Expected three points where the marker is not given, got {p.shape[1]}. Give the marker's points.",
            ["marker"],
            [f"{p.shape[1]} points"],
        )
    length = {}
    for i, k in ((0, 1), (0, 2), (1, 2)):
        both = seen[:, i] & seen[:, k]
        if not both.any():
            raise NotExcited(
                f"Expected frames in which points {i} and {k} are both visible, got none. Give the marker's points.",
                [f"distance of points {i} and {k}"],
                ["0 frames"],
            )
        length[i, k] = float(np.median(np.linalg.norm(p[both, i] - p[both, k], axis=1)))
    base = length[0, 1]
    x = (base**2 + length[0, 2] ** 2 - length[1, 2] ** 2) / (2.0 * base) if base else 0.0
    y = np.sqrt(max(length[0, 2] ** 2 - x**2, 0.0))
    return np.array([[0.0, 0.0, 0.0], [base, 0.0, 0.0], [x, y, 0.0]])


def _require_breadth(marker: np.ndarray) -> None:
    """Refuse fewer than three points, and points in a line."""
    size = np.linalg.svd(marker - marker.mean(axis=0), compute_uv=False)
    if len(marker) < FEWEST or not size[1] > LINE * size[0]:
        raise NotExcited(
            f"Expected a marker of at least three points that are not in a line, got {len(marker)} whose breadth is "
            f"{size[1] if len(size) > 1 else 0.0:.2g} m. A pose needs a point beside the line of the others.",
            ["rotation about the line of the points"],
            ["unseen"],
        )

"""Poses of a marker from its points (for example LEDs) by rigid least squares in each tracker frame.

    T_i = argmin sum_k |p_ik - T l_k|^2  over the visible points

The solution uses the singular value decomposition of ``sum (p - mean p)(l - mean l)^T`` (Kabsch 1976; Umeyama 1991),
and is never a reflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only
from armlab.errors import NotExcited
from armlab.frames.inputs import marker_points, noise_of, sightings
from armlab.lie import so3

LINE = 1e-6  # width-to-length ratio below which points are collinear
MIN_POINTS = 3


@dataclass(frozen=True, eq=False, repr=False)
class MarkerPoses(Shown):
    """Poses of a marker, one per tracker frame, in the order of the frames.

    Attributes
    ----------
    T : (N, 4, 4) poses T_cam_marker; NaN if too few points are visible.
    valid : (N,) mask of the frames with a pose.
    rms : (N,) root mean square distance of the visible points from the marker points [m]; NaN without a pose.
    cov : (N, 6, 6) covariance of [v; w], v in camera axes [m], w in marker axes [rad]; NaN without a pose.
    noise : standard deviation of each coordinate of a point [m], given or estimated; NaN if not estimable.
    marker : (K, 3) points in marker axes [m], given or estimated.
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
    """Compute the pose of a marker in every frame from its visible points.

    The result has one pose per input frame, so it remains paired with the robot poses. `rms` reveals, for example,
    an LED misplaced by 3 mm.

    Parameters
    ----------
    p : (N, K, 3) points in camera axes [m]; only invisible points may be NaN.
    marker : (K, 3) points in marker axes [m]. Default (three points only): computed from their median distances,
        with the origin at point 0, x towards point 1, and point 2 at positive y.
    visible : (N, K) mask of the visible points; default: all.
    noise : standard deviation of each coordinate of a point [m]; default: estimated from the residuals of the points.

    Returns
    -------
    MarkerPoses

    Raises
    ------
    ShapeError : wrong shapes, or NaN in visible points (the message lists the rows).
    NotExcited : a marker with fewer than three points, or with collinear points.

    References
    ----------
    Kabsch (1976), Acta Crystallographica A32; Umeyama (1991), PAMI 13(4).
    """
    p, seen = sightings(p, visible, "p")
    p = np.where(seen[:, :, None], p, 0.0)
    shape = _template(p, seen) if marker is None else marker_points(marker, p.shape[1], "p")
    _require_breadth(shape)
    sd = noise_of(noise) or np.nan
    count = seen.sum(axis=1)
    share = seen / np.maximum(count, 1)[:, None]
    there, here = share[:, None, :] @ p, share @ shape  # centres (N, 1, 3) and (N, 3)
    weighted = np.where(seen[:, :, None], p - there, 0.0)
    body = shape - here[:, None, :]
    R, sigma = so3.nearest(np.swapaxes(weighted, 1, 2) @ body)
    turned = seen[:, :, None] * (body @ np.swapaxes(R, 1, 2))
    spread = np.einsum("nki,nki->n", seen[:, :, None] * body, body)
    valid = (count >= MIN_POINTS) & (sigma[:, 1] + sigma[:, 2] > LINE * np.maximum(spread, np.finfo(float).tiny))
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
    """Return three marker points (3, 3) whose distances are the medians of the measured distances."""
    if p.shape[1] != MIN_POINTS:
        raise NotExcited(
            f"Expected three points without marker=, got {p.shape[1]}. Pass the points of the marker.",
            ["marker"],
            [f"{p.shape[1]} points"],
        )
    length = {}
    for i, k in ((0, 1), (0, 2), (1, 2)):
        both = seen[:, i] & seen[:, k]
        if not both.any():
            raise NotExcited(
                f"Expected frames in which points {i} and {k} are both visible, got none. Pass the points of "
                "the marker.",
                [f"distance of points {i} and {k}"],
                ["0 frames"],
            )
        length[i, k] = float(np.median(np.linalg.norm(p[both, i] - p[both, k], axis=1)))
    base = length[0, 1]
    x = (base**2 + length[0, 2] ** 2 - length[1, 2] ** 2) / (2.0 * base) if base else 0.0
    y = np.sqrt(max(length[0, 2] ** 2 - x**2, 0.0))
    return np.array([[0.0, 0.0, 0.0], [base, 0.0, 0.0], [x, y, 0.0]])


def _require_breadth(marker: np.ndarray) -> None:
    size = np.linalg.svd(marker - marker.mean(axis=0), compute_uv=False)
    if len(marker) < MIN_POINTS or not size[1] > LINE * size[0]:
        raise NotExcited(
            f"Expected a marker with at least three non-collinear points, got {len(marker)} points with a width of "
            f"{size[1] if len(size) > 1 else 0.0:.2g} m. Add a point away from the line through the other points.",
            ["rotation about the line of the points"],
            ["unobservable"],
        )

"""The force on an arm: an arrow at its tool point, and an ellipsoid of two sigma at the tip."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from armlab._palette import GREY, VERMILION
from armlab.lie import quaternion
from armlab.live.bodies import arrow
from armlab.live.node import Node, rgb, solid

__all__ = ["ForceArrow", "ellipsoid_axes", "is_significant"]

_ZERO_OUTSIDE = 7.81  # 95 % quantile of chi-square with 3 degrees of freedom
_SURE = 1e-6  # N; half axes are not shorter
_SHORTEST, _FULL = 1e-3, 0.15  # m: a shorter arrow is not drawn, or thinner


class ForceArrow:
    """Arrow and ellipsoid; both are grey while zero lies inside the 95 % ellipsoid.

    Parameters
    ----------
    scene : ``server.scene``. root : name of the node in whose axes forces are.
    """

    def __init__(self, scene: Any, root: str) -> None:
        self._arrow = Node(solid(scene, f"{root}/force", arrow(), VERMILION))
        self._spread = Node(
            scene.add_icosphere(
                f"{root}/uncertainty", 1.0, rgb(VERMILION), opacity=0.3, visible=False, cast_shadow=False
            )
        )
        self.hide()

    def hide(self) -> None:
        """Draw nothing."""
        self._arrow.handle.visible = self._spread.handle.visible = False

    def show(self, tool: np.ndarray, force: np.ndarray | None, covariance: np.ndarray | None, unit: float) -> None:
        """Draw a force; nothing where it is missing or NaN.

        Parameters
        ----------
        tool : (3,) where it acts [m]. force : (3,) [N]. covariance : (3, 3) of it; no ellipsoid where it is missing.
        unit : length of a force [m/N].
        """
        if force is None or not np.isfinite(force).all():
            self.hide()
            return
        covariance = np.full((3, 3), np.nan) if covariance is None else covariance
        known = bool(np.isfinite(covariance).all())
        axes, half = ellipsoid_axes(covariance) if known else (np.eye(3), np.zeros(3))
        color = rgb(VERMILION if is_significant(force, axes, half) else GREY)
        tip = unit * force
        length = math.hypot(*tip)
        self._arrow.handle.visible = length >= _SHORTEST
        if length >= _SHORTEST:
            thick = min(max(length / _FULL, 0.3), 1.0)
            wxyz, scale = _towards(*(tip / length).tolist()), (thick, thick, length)
            self._arrow.set(position=tuple(tool.tolist()), wxyz=wxyz, scale=scale, color=color)
        self._spread.handle.visible = known
        if known:
            self._spread.set(
                position=tuple((tool + tip).tolist()),
                wxyz=tuple(quaternion.from_matrix(axes).tolist()),
                scale=tuple((unit * np.maximum(half, _SURE)).tolist()),
                color=color,
            )


def ellipsoid_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes (3, 3), columns of a rotation, and half axes (3,) of the two-sigma ellipsoid.

    ``{x : x^T C^-1 x = 4}``.

    Parameters
    ----------
    covariance : (3, 3).
    """
    size, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    return axes, 2.0 * np.sqrt(np.maximum(size, 0.0))


def is_significant(force: np.ndarray, axes: np.ndarray, half: np.ndarray) -> bool:
    """Return whether zero lies outside the 95 % ellipsoid of a force: ``f^T C^-1 f >= 7.81``.

    Parameters
    ----------
    force : (3,). axes, half : of its two-sigma ellipsoid; half axes of zero are no doubt at all.
    """
    return bool(4.0 * np.sum((force @ axes / np.maximum(half, _SURE)) ** 2) >= _ZERO_OUTSIDE)


def _towards(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the shortest turn (wxyz) that takes the z axis to a unit vector."""
    w = 1.0 + z if z > 0.0 else (x * x + y * y) / (1.0 - z)  # the same, exact also close to -z
    size = math.hypot(w, x, y)
    return (w / size, -y / size, x / size, 0.0) if size else (0.0, 1.0, 0.0, 0.0)

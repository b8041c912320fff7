"""Kinematics of a robot: poses, Jacobians and what follows from them, for one configuration or any batch of them."""

from __future__ import annotations

from armlab.kinematics.forward import (
    forward,
    forward_jacobian,
    frame_jacobian,
    frame_poses,
    jacobian,
    jacobian_derivative,
    link_transforms,
    twist_jacobian,
)
from armlab.kinematics.inverse import Inverse, inverse
from armlab.kinematics.manipulability import (
    Ellipsoid,
    ellipsoid,
    manipulability,
    manipulability_gradient,
    singular_values,
)
from armlab.kinematics.null_motion import NullMotion, null_motion
from armlab.kinematics.path import Path, inverse_path

__all__ = [
    "Ellipsoid",
    "Inverse",
    "NullMotion",
    "Path",
    "ellipsoid",
    "forward",
    "forward_jacobian",
    "frame_jacobian",
    "frame_poses",
    "inverse",
    "inverse_path",
    "jacobian",
    "jacobian_derivative",
    "link_transforms",
    "manipulability",
    "manipulability_gradient",
    "null_motion",
    "singular_values",
    "twist_jacobian",
]

"""Kinematics of a robot: poses, Jacobians and what follows from them, for one configuration or any batch of them."""

from __future__ import annotations

from armlab.kinematics.forward import (
    forward,
    forward_jacobian,
    frame_poses,
    jacobian,
    jacobian_derivative,
    link_transforms,
    parameter_jacobian,
    twist_jacobian,
)
from armlab.kinematics.inverse import IkSolution, inverse
from armlab.kinematics.manipulability import (
    Ellipsoid,
    ellipsoid,
    manipulability,
    manipulability_gradient,
    singular_values,
)
from armlab.kinematics.path import IkPath, inverse_path
from armlab.kinematics.self_motion import SelfMotion, self_motion

__all__ = [
    "Ellipsoid",
    "IkSolution",
    "SelfMotion",
    "IkPath",
    "ellipsoid",
    "forward",
    "forward_jacobian",
    "parameter_jacobian",
    "frame_poses",
    "inverse",
    "inverse_path",
    "jacobian",
    "jacobian_derivative",
    "link_transforms",
    "manipulability",
    "manipulability_gradient",
    "self_motion",
    "singular_values",
    "twist_jacobian",
]

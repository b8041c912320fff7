"""Robot kinematics: poses, Jacobians, inverse kinematics and dexterity, for single configurations or batches."""

from __future__ import annotations

from armlab.kinematics.dexterity import (
    Ellipsoid,
    SelfMotion,
    ellipsoid,
    manipulability,
    manipulability_gradient,
    self_motion,
    singular_values,
)
from armlab.kinematics.forward import (
    forward,
    forward_jacobian,
    jacobian,
    jacobian_derivative,
    link_transforms,
    parameter_jacobian,
)
from armlab.kinematics.inverse import IkSolution, inverse
from armlab.kinematics.path import IkPath, inverse_path

__all__ = [
    "Ellipsoid", "IkPath", "IkSolution", "SelfMotion", "ellipsoid", "forward", "forward_jacobian", "inverse",
    "inverse_path", "jacobian", "jacobian_derivative", "link_transforms", "manipulability", "manipulability_gradient",
    "parameter_jacobian", "self_motion", "singular_values",
]  # fmt: skip

"""Kinematics of a robot: poses, link frames and Jacobians, for one configuration or any batch of them."""

from __future__ import annotations

from armlab.kinematics.forward import forward, link_transforms
from armlab.kinematics.jacobian import jacobian

__all__ = ["forward", "jacobian", "link_transforms"]

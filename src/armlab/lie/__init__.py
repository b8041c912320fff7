"""Lie groups SO(3) and SE(3), Euler angles and quaternions, as functions on arrays with any leading axes."""

from armlab.lie import euler, quaternion, se3, so3

__all__ = ["euler", "quaternion", "se3", "so3"]

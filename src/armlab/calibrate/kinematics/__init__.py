"""Kinematic calibration of one arm, and of two arms that measure each other."""

__all__ = []

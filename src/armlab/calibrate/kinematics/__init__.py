"""Kinematic calibration of one arm, or of two arms that measure each other."""

__all__ = []

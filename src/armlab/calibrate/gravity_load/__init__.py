"""Gravity calibration of force sensors and accelerometers."""

__all__ = []

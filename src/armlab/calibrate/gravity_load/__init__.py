"""Calibration of sensors by a load in gravity: force sensors and accelerometers."""

__all__ = []

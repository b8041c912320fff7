"""Calibration experiments of known truth."""

__all__ = []

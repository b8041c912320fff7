"""Calibration experiments with known ground truth."""

__all__ = []

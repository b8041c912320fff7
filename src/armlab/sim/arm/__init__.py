"""Simulated arm: rigid bodies, drives, friction, sensors, synthetic truth."""

__all__ = []

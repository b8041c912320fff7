"""Checks before a run: computer, network, and what robots send."""

__all__ = []

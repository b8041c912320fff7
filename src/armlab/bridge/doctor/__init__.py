"""Checks before a run: computer, network, and packets of robots."""

__all__ = []

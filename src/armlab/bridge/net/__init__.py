"""Sockets, and how the parts of a run report events."""

__all__ = []

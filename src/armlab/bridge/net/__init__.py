"""Sockets and rate-limited events."""

__all__ = []

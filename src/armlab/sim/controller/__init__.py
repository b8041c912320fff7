"""Simulated EGM controller: cycle, references, packets, UDP channel."""

__all__ = []

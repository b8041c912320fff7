"""Controller inputs from other programs: sources, their fusion, and parameters."""

__all__ = []

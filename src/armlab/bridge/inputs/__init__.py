"""Values from other programs that a controller reads: sources, their fusion, and parameters."""

__all__ = []

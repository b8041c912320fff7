"""Server processes: send rows, parameters and events of a cell to other programs, and pass on their commands."""

__all__ = []

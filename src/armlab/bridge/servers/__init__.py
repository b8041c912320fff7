"""Server processes: rows, parameters and events of a cell to other programs, their commands to the loop."""

__all__ = []

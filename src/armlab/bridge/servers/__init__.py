"""Server processes that send a cell's rows, parameters and events to other programs and pass on their commands."""

__all__ = []

"""Server processes that send a cell's rows, parameters and events to other programs and return commands to the loop."""

__all__ = []

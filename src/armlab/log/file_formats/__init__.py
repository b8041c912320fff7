"""File formats, one module each, for reading and writing a `Table`."""

__all__ = []

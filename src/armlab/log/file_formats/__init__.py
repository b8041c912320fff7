"""One module per file format: reading it into a `Table` and writing it."""

__all__ = []

"""One module per file format, which reads it as a `Table` and writes it."""

__all__ = []

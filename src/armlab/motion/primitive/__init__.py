"""Parts of a movement primitive: its equation, its runs, and its fit to demonstrations."""

__all__ = ()

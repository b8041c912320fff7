"""Components of a movement primitive: equation, runs, and fit to demonstrations."""

__all__ = ()

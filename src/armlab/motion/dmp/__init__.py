"""Dynamic movement primitives: equation, runs, and the fit to demonstrations."""

__all__ = ()

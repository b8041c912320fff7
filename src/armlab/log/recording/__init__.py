"""armlab recordings: written by a running link, and cut, merged and inspected offline."""

__all__ = []

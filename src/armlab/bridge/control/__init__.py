"""The control loop: one reply per packet, limits, sessions and recording."""

__all__ = []

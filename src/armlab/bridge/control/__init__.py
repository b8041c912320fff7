"""The control loop: from a packet of an arm to the one reply to it, and the recording of both."""

__all__ = []

"""Pre-run checks of the computer, the network and the robot packets."""

__all__ = []

"""ROS topics, messages and commands, whichever transport carries them (docs/ros.md)."""

__all__ = []

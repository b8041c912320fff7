"""ROS topics, messages and commands for all transports (docs/ros.md)."""

__all__ = []

"""ROS 1 through rospy, which lives under the system's Python: `relay` runs there (docs/ros.md)."""

__all__ = []

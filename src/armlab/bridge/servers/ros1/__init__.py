"""ROS 1 server; the system's Python with rospy runs `relay` (docs/ros.md)."""

__all__ = []

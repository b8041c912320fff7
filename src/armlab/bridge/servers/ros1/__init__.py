"""ROS 1 server; `relay` runs under the system's Python with rospy (docs/ros.md)."""

__all__ = []

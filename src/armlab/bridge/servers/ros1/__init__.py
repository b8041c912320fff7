"""ROS 1 nodes read and command by rospy, which lives under the system's Python: `relay` runs there (docs/ros.md)."""

from armlab.bridge.servers.ros1.process import Ros1Process

__all__ = ["Ros1Process"]

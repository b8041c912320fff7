"""Logs of other programs, topic by topic: MCAP, rosbag2 and ROS 1 bags."""

__all__ = []

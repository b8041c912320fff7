"""Topic-based logs from other programs: MCAP, rosbag2 and ROS 1 bags."""

__all__ = []

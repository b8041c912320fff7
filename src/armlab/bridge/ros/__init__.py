"""What ROS programs get and may ask for, whatever carries it: topics, messages, commands (docs/ros.md)."""

from armlab.bridge.ros.requests import Commands
from armlab.bridge.ros.topics import Encoded, Published, Topics
from armlab.bridge.ros.types import store

__all__ = ["Commands", "Encoded", "Published", "Topics", "store"]

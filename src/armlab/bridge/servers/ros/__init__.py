"""What ROS programs get and may ask for, whatever carries it: topics, messages, commands (docs/ros.md)."""

from armlab.bridge.servers.ros.requests import Commands
from armlab.bridge.servers.ros.topics import Encoded, Published, Topics
from armlab.bridge.servers.ros.types import store

__all__ = ["Commands", "Encoded", "Published", "Topics", "store"]

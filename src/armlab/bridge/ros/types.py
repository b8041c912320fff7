"""The message types that are spoken: those of ROS 2 Humble (the same in later ones), and ABB's EGM states."""

from __future__ import annotations

from functools import cache
from typing import Any

__all__ = ["store"]

_OTHERS = {
    # Names and order as in ros-industrial/abb_robot_driver_interfaces; constants are no part of a message.
    "abb_egm_msgs/msg/EGMChannelState": (
        "string name\nbool active\nbool egm_convergence_met\nuint8 egm_client_state\nuint8 motor_state\n"
        "uint8 rapid_execution_state\nfloat64 utilization_rate"
    ),
    "abb_egm_msgs/msg/EGMState": "std_msgs/Header header\nEGMChannelState[] egm_channels",
}


@cache
def store() -> Any:
    """Return the message types with their codecs (a typestore of `rosbags`)."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    known = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OTHERS.items():
        known.register(get_types_from_msg(text, name))
    return known

"""What is the same in all dialects of ROS 2: number of the domain, names of types, what a command says."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from typing import Any

from armlab.errors import CommandRefused, ConfigError

__all__ = ["content", "domain_number", "store", "type_name"]

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


_HIGHEST = 232  # beyond it there is no UDP port
_LARGEST = 2**17  # bytes of a message to us


def domain_number(given: int | None, environment: Mapping[str, str] = os.environ) -> int:
    """Return the number of the domain: as given, else that of ROS_DOMAIN_ID, else 0.

    Raises
    ------
    ConfigError : ROS_DOMAIN_ID is no such number.
    """
    text = environment.get("ROS_DOMAIN_ID", "") or "0"
    if given is not None:
        return given
    if not text.isdecimal() or int(text) > _HIGHEST:
        raise ConfigError(f"Expected ROS_DOMAIN_ID from 0 to {_HIGHEST}, got {text!r}. Set it, or unset it for 0.")
    return int(text)


def type_name(name: str) -> str:
    """Return the name that the wire has for a ROS 2 message type."""
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def content(name: str, cdr: bytes) -> Any:
    """Return what a command says: numbers, a text, or None of an empty one.

    Raises
    ------
    CommandRefused : too many bytes, or such that are no message of this type.
    """
    if len(cdr) > _LARGEST:
        raise CommandRefused(f"Expected a {name} of at most {_LARGEST} bytes, got {len(cdr)}.")
    try:
        return getattr(store().deserialize_cdr(cdr, name), "data", None)
    except Exception as error:  # what a codec raises on bytes of others is nowhere listed
        raise CommandRefused(f"Expected a {name}, got {len(cdr)} bytes that are none ({error}).") from None

"""ABB's Externally Guided Motion on the wire: bytes to SI values and back, no sockets."""

from armlab.wire.egm.codec import EgmCodec
from armlab.wire.egm.details import Details
from armlab.wire.egm.robot_side import RobotSideCodec
from armlab.wire.egm.types import Beside, Codec, Drop, Packet, Reference, RobotAxes, RobotMessage, SensorMessage

__all__ = [
    "Beside",
    "Codec",
    "Details",
    "Drop",
    "EgmCodec",
    "Packet",
    "Reference",
    "RobotAxes",
    "RobotMessage",
    "RobotSideCodec",
    "SensorMessage",
]

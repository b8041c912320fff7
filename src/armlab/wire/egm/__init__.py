"""ABB's Externally Guided Motion on the wire: bytes to SI values and back, no sockets."""

from armlab.wire.egm.codec import EgmCodec
from armlab.wire.egm.details import Details
from armlab.wire.egm.robot_side import RobotSideCodec
from armlab.wire.egm.types import Arm, Beside, Codec, Drop, Packet, Reference, RobotMessage, SensorMessage

__all__ = [
    "Arm",
    "Beside",
    "Codec",
    "Details",
    "Drop",
    "EgmCodec",
    "Packet",
    "Reference",
    "RobotMessage",
    "RobotSideCodec",
    "SensorMessage",
]

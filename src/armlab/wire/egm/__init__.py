"""Codec for ABB's Externally Guided Motion: converts bytes to SI values and back."""

from armlab.wire.egm.codec import Details, EgmCodec
from armlab.wire.egm.types import Beside, Codec, Drop, Packet, Reference

__all__ = ["Beside", "Codec", "Details", "Drop", "EgmCodec", "Packet", "Reference"]

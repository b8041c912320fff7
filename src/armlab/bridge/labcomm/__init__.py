"""LabComm servers and clients: rows of the arms and parameters out, commands in, over TCP.

`LabCommServer` serves `ArmChannel` (7511 left, 7512 right), `ParameterChannel` (7513) and `FusedChannel` (7514);
`LabCommClient` is the other side; ``bridge.connect("labcomm://host:7511", robot)`` runs a controller over it.
"""

from armlab.bridge.labcomm.channels import ArmChannel, FusedArm, FusedChannel, FusedSource
from armlab.bridge.labcomm.client import LabCommClient
from armlab.bridge.labcomm.feed import RowFeed, to_arbiter
from armlab.bridge.labcomm.parameter_channel import ParameterChannel
from armlab.bridge.labcomm.rows import Row, RowTypes
from armlab.bridge.labcomm.server import LabCommServer
from armlab.bridge.labcomm.source import LabCommSource

__all__ = [
    "ArmChannel",
    "FusedArm",
    "FusedChannel",
    "FusedSource",
    "LabCommClient",
    "LabCommServer",
    "LabCommSource",
    "ParameterChannel",
    "Row",
    "RowFeed",
    "RowTypes",
    "to_arbiter",
]

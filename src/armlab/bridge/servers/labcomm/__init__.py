"""LabComm servers and clients: rows of the arms and parameters out, commands in, over TCP.

`LabCommServer` serves `ArmChannel` (7511 left, 7512 right), `ParameterChannel` (7513) and `FusedChannel` (7514);
`LabCommClient` is the other side; ``bridge.connect("labcomm://host:7511", robot)`` runs a controller over it.
"""

from armlab.bridge.servers.labcomm.channels import ArmChannel, FusedArm, FusedChannel, FusedSource, ParameterChannel
from armlab.bridge.servers.labcomm.client import LabCommClient, LabCommSource
from armlab.bridge.servers.labcomm.rows import Row, RowTypes
from armlab.bridge.servers.labcomm.server import LabCommServer, RowFeed, to_arbiter

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

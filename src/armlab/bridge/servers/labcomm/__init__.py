"""LabComm servers and clients over TCP: rows and parameters out, commands in.

`LabCommServer` serves an `ArmChannel` per arm (port 7511 left, 7512 right), and `LabCommClient` is the client.
``bridge.connect("labcomm://host:7511", robot)`` returns a link that runs a controller over LabComm.
"""

from armlab.bridge.servers.labcomm.channels import ArmChannel
from armlab.bridge.servers.labcomm.client import LabCommClient
from armlab.bridge.servers.labcomm.rows import Row
from armlab.bridge.servers.labcomm.server import LabCommServer, RowFeed, to_arbiter

__all__ = ["ArmChannel", "LabCommClient", "LabCommServer", "Row", "RowFeed", "to_arbiter"]

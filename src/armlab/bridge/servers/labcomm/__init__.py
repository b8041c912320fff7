"""LabComm servers and clients over TCP: rows and parameters out, commands in.

`LabCommServer` serves one `ArmChannel` per arm (left arm: port 7511, right arm: port 7512), and `LabCommClient` is the
client. ``bridge.connect("labcomm://host:7511", robot)`` returns a link that runs a controller over LabComm.
"""

from armlab.bridge.servers.labcomm.channels import ArmChannel
from armlab.bridge.servers.labcomm.client import LabCommClient
from armlab.bridge.servers.labcomm.rows import Row
from armlab.bridge.servers.labcomm.server import LabCommServer, RowFeed, to_arbiter

__all__ = ["ArmChannel", "LabCommClient", "LabCommServer", "Row", "RowFeed", "to_arbiter"]

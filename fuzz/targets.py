"""Table of fuzz targets, documented by their functions. A target reports a finding by raising an exception."""

from __future__ import annotations

from collections.abc import Callable

from fuzz import clients, descriptions, files, fleet, wire

__all__ = ["TARGETS"]

TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        wire.egm_robot,
        wire.egm_sensor,
        wire.egm_session,
        wire.labcomm,
        wire.definitions,
        files.mcap,
        files.text,
        files.abb,
        files.bag,
        files.secrets,
        descriptions.robot_urdf,
        descriptions.robot_toml,
        descriptions.cell,
        descriptions.model,
        clients.rosbridge,
        clients.ros_command,
        clients.zenoh,
        clients.labcomm_client,
        clients.request,
        fleet.fleet,
    )
}

"""What a cell file may hold: its tables, as msgspec checks them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec

_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
_Port = Annotated[int, msgspec.Meta(ge=0, le=65535)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file."""


class RobotTable(_Table, frozen=True):
    """A robot: a name of the library or a file, and the url of its link."""

    name: str
    link: str
    extension: bool = False
    speed: float = 1.0
    torque: float | list[float] | None = None  # largest that is sent, of all joints or of each [N m]


class FieldTable(_Table, frozen=True):
    """A field of a source; what the glossary knows needs no unit."""

    shape: tuple[int, ...] = ()
    unit: str | None = None
    frame: str | None = None


class SourceTable(_Table, frozen=True):
    """A source of values beside the arms: datagrams of another program, or a sample of a LabComm server."""

    fields: dict[_Name, FieldTable]
    period: float
    port: _Port
    kind: Literal["udp", "labcomm"] = "udp"
    sample: str | None = None
    host: str = "127.0.0.1"
    layout: dict[str, str] | Literal["json"] = "json"
    max_age: float | None = None
    role: Literal["required", "optional"] = "optional"
    robot: str = ""
    calibration: str | None = None


class ParameterTable(_Table, frozen=True):
    """A parameter; see `Parameter`."""

    default: bool | int | float | str | list[float]
    type: str = "float"
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    text: str = ""
    rights: Literal["commander", "anyone"] = "commander"
    live: bool = True


class LabCommTable(_Table, frozen=True):
    """The LabComm server: a port per arm, for the parameters and for the fused rows."""

    ports: dict[str, _Port] = {}
    parameters: _Port = 7513
    rows: _Port = 7514
    order: Literal["abb", "chain"] = "abb"
    dialect: str = "2014v1"
    types: str | None = None
    follows_client: bool = False


class _Server(_Table, frozen=True):
    """The table of a server."""

    def options(self) -> dict[str, Any]:
        """Return what the process of the server is told; "guarded" where it knows a secret (see `listening`)."""
        return msgspec.to_builtins(self)


class Ros2Table(_Server, frozen=True):
    """ROS 2 over DDS; without a domain that of ROS_DOMAIN_ID."""

    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None


class RosbridgeTable(_Server, frozen=True):
    """The rosbridge server: its port, the dialect of clients that do not say, and what guards it."""

    port: _Port = 9090
    dialect: Literal["ros1", "ros2"] = "ros2"
    origins: list[str] = []
    token_file: str | None = None
    token_variable: str | None = None
    certificate: str | None = None
    key: str | None = None

    def options(self) -> dict[str, Any]:
        """Return the options; it is guarded with a token, certificate and key."""
        token = self.token_file or self.token_variable
        return {**super().options(), "guarded": bool(token and self.certificate and self.key)}


class ZenohTable(_Server, frozen=True):
    """The Zenoh server: name of the lab, where it is found, and who may come; see `zenoh.security.Security`."""

    lab: _Name = "lab"
    port: _Port = 7447
    router: str = ""
    ca: str = ""
    certificate: str = ""
    key: str = ""
    users: str = ""
    secret: str = ""

    def options(self) -> dict[str, Any]:
        return {**super().options(), "guarded": bool(self.ca and self.certificate and self.key and self.users)}


class RmwZenohTable(_Server, frozen=True):
    """ROS 2 over Zenoh, as rmw_zenoh speaks it; without a domain that of ROS_DOMAIN_ID."""

    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None
    distribution: Literal["humble", "jazzy", "kilted"] = "jazzy"
    port: _Port = 7447
    router: str = ""


class Ros1Table(_Server, frozen=True):
    """A node of ROS 1: its master, and the Python that has rospy."""

    master: str = "http://127.0.0.1:11311"
    python: str = "/usr/bin/python3"


class PlotJugglerTable(_Server, frozen=True):
    """Datagrams for PlotJuggler: where it runs, and which fields of a robot; None sends those that fit."""

    to: str = "127.0.0.1"
    port: _Port = 9870
    fields: list[str] | None = None


class ServersTable(_Table, frozen=True):
    """Servers that are enabled besides the local one."""

    labcomm: LabCommTable | None = None
    ros2: Ros2Table | None = None
    rosbridge: RosbridgeTable | None = None
    zenoh: ZenohTable | None = None
    rmw_zenoh: RmwZenohTable | None = None
    ros1: Ros1Table | None = None
    plotjuggler: PlotJugglerTable | None = None


class File(_Table, frozen=True):
    """The whole file."""

    robots: Annotated[list[RobotTable], msgspec.Meta(min_length=1)]
    name: _Name = "cell"
    commands: list[Literal["labcomm", "local", "rmw_zenoh", "ros1", "ros2", "rosbridge", "zenoh"]] = []
    pace: str | None = None
    record: str | None = None
    sources: dict[_Name, SourceTable] = {}
    parameters: dict[str, ParameterTable] = {}
    servers: ServersTable = ServersTable()

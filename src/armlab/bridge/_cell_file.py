"""What a cell file may hold: its tables, as msgspec checks them."""

from __future__ import annotations

import math
from typing import Annotated, Literal

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


class ServersTable(_Table, frozen=True):
    """Servers that are enabled besides the local one."""

    labcomm: LabCommTable | None = None


class File(_Table, frozen=True):
    """The whole file."""

    robots: Annotated[list[RobotTable], msgspec.Meta(min_length=1)]
    name: _Name = "cell"
    commands: list[Literal["labcomm", "local"]] = []
    pace: str | None = None
    record: str | None = None
    sources: dict[_Name, SourceTable] = {}
    parameters: dict[str, ParameterTable] = {}
    servers: ServersTable = ServersTable()

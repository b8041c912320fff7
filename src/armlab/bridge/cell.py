"""A cell: robots, sources, parameters and servers from one TOML file, and the bridge that runs it."""

from __future__ import annotations

import ipaddress
import math
import re
import socket
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec

from armlab import robots
from armlab.bridge.feed import OPERATOR, Exchange
from armlab.bridge.labcomm import LabCommSource
from armlab.bridge.labcomm.process import labcomm_options
from armlab.bridge.limits import Limits
from armlab.bridge.link import connect
from armlab.bridge.local import socket_path
from armlab.bridge.loop import Controller
from armlab.bridge.parameters import Parameter, Parameters
from armlab.bridge.rights import Arbiter
from armlab.bridge.run import Run
from armlab.bridge.servers import Servers, server_command
from armlab.bridge.sources import Source
from armlab.bridge.udp import UdpSource
from armlab.errors import ArmlabError, ConfigError, UnknownName
from armlab.log import Column
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Cell", "listening", "parse_cell", "run_cell"]

_SIDES = {"left": 7511, "right": 7512}
_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
_Port = Annotated[int, msgspec.Meta(ge=0, le=65535)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file."""


class _Robot(_Table, frozen=True):
    """A robot: a name of the library or a file, and the url of its link."""

    name: str
    link: str
    extension: bool = False
    speed: float = 1.0


class _Field(_Table, frozen=True):
    """A field of a source; what the glossary knows needs no unit."""

    shape: tuple[int, ...] = ()
    unit: str | None = None
    frame: str | None = None


class _Source(_Table, frozen=True):
    """A source of values beside the arms: datagrams of another program, or a sample of a LabComm server."""

    fields: dict[_Name, _Field]
    period: float
    port: _Port
    kind: Literal["udp", "labcomm"] = "udp"
    sample: str | None = None
    host: str = "127.0.0.1"
    layout: dict[str, str] | Literal["json"] = "json"
    max_age: float | None = None
    role: Literal["required", "optional"] = "optional"
    robot: str = ""


class _Parameter(_Table, frozen=True):
    """A parameter; see `Parameter`."""

    default: bool | int | float | str | list[float]
    type: str = "float"
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    text: str = ""
    rights: Literal["commander", "anyone"] = "commander"
    live: bool = True


class _LabComm(_Table, frozen=True):
    """The LabComm server: a port per arm, for the parameters and for the fused rows."""

    ports: dict[str, _Port] = {}
    parameters: _Port = 7513
    rows: _Port = 7514
    order: Literal["abb", "chain"] = "abb"
    dialect: str = "2014v1"
    types: str | None = None
    follows_client: bool = False


class _Servers(_Table, frozen=True):
    """Servers that are enabled besides the local one."""

    labcomm: _LabComm | None = None


class _File(_Table, frozen=True):
    """The whole file."""

    robots: Annotated[list[_Robot], msgspec.Meta(min_length=1)]
    name: _Name = "cell"
    commands: list[Literal["labcomm", "local"]] = []
    pace: str | None = None
    record: str | None = None
    sources: dict[_Name, _Source] = {}
    parameters: dict[str, _Parameter] = {}
    servers: _Servers = _Servers()


@dataclass(frozen=True)
class Cell:
    """What a cell file says, checked.

    Attributes
    ----------
    name : of the cell. robots, links : the arms and their urls. extension : send the research extension.
    limits : of each arm. commands : servers that may command. pace, record : see `Link.run`.
    parameters : declared. servers : options by name of the server.
    """

    name: str
    robots: tuple[Robot, ...]
    links: tuple[str, ...]
    extension: bool
    limits: tuple[Limits, ...]
    commands: tuple[str, ...]
    pace: str | None
    record: str | None
    parameters: tuple[Parameter, ...]
    servers: Mapping[str, Mapping[str, Any]]
    _sources: Mapping[str, _Source]

    def sources(self) -> list[Source]:
        """Return the sources, not yet started."""
        return [_source(name, one) for name, one in self._sources.items()]


def parse_cell(text: str, path: str = "cell.toml") -> Cell:
    """Return the cell that a TOML text describes.

    Parameters
    ----------
    text : of the file. path : its name, for messages.

    Raises
    ------
    ConfigError : no TOML, an unknown or wrong entry, or entries that contradict each other; one line with the path.
    """
    try:
        file = msgspec.convert(tomllib.loads(text), _File, strict=True)
        return _cell(file)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"Expected TOML in {path}: {_line(error)}.") from None
    except (msgspec.ValidationError, ArmlabError) as error:
        raise ConfigError(f"Expected another cell in {path}: {_line(error)}.") from None


def _cell(file: _File) -> Cell:
    arms = tuple(robots.load(one.name) for one in file.robots)
    names = [arm.name for arm in arms]
    if len(set(names)) < len(names):
        raise ConfigError(f"Expected robots with different names, got {', '.join(names)}.")
    if file.pace is not None and file.pace not in names:
        raise UnknownName.among("robot of this cell", file.pace, names)
    servers: dict[str, Mapping[str, Any]] = {OPERATOR: {}}
    if file.servers.labcomm is not None:
        servers["labcomm"] = _labcomm(file.servers.labcomm, arms)
    idle = [name for name in file.commands if name not in servers]
    if idle:
        raise ConfigError(
            f"Expected `commands` to name enabled servers, got {', '.join(idle)}. Add [servers.{idle[0]}]."
        )
    declared = []
    for name, one in file.parameters.items():
        fields = {field: getattr(one, field) for field in one.__struct_fields__}
        declared.append(Parameter(name, **fields))
    Parameters(declared)
    for name, source in file.sources.items():
        _source(name, source)
    return Cell(
        file.name,
        arms,
        tuple(one.link for one in file.robots),
        any(one.extension for one in file.robots),
        tuple(Limits.of(arm, speed=one.speed) for arm, one in zip(arms, file.robots, strict=True)),
        tuple(file.commands),
        file.pace,
        file.record,
        tuple(declared),
        servers,
        file.sources,
    )


def _labcomm(options: _LabComm, arms: Sequence[Robot]) -> dict[str, Any]:
    names = [arm.name for arm in arms]
    for name in options.ports:
        if name not in names:
            raise UnknownName.among("robot of this cell", name, names)
    sides = [_SIDES.get(arm.side, 7511) for arm in arms]
    ports = [options.ports.get(arm.name, side) for arm, side in zip(arms, sides, strict=True)]
    taken = [port for port in (*ports, options.parameters, options.rows) if port]
    if len(set(taken)) < len(taken):
        raise ConfigError(f"Expected a LabComm port of its own for each arm, parameters and rows, got {taken}.")
    return labcomm_options(
        arms,
        ports=ports,
        dialect=options.dialect,
        order=options.order,
        parameters=options.parameters,
        fused=options.rows,
        types=options.types,
        follows_client=options.follows_client,
    )


def _source(name: str, one: _Source) -> Source:
    fields = {field: Column(about.shape, about.unit, about.frame) for field, about in one.fields.items()}
    options = {"max_age": one.max_age, "role": one.role, "robot": one.robot}
    if one.kind == "labcomm":
        return LabCommSource(name, fields, one.period, one.port, one.host, one.sample, **options)
    return UdpSource(name, fields, one.period, one.port, one.layout, one.host, **options)


def listening(listen: Iterable[str], cell: Cell) -> dict[str, str]:
    """Return the address of each network server: loopback, or what the user asked for.

    Parameters
    ----------
    listen : "labcomm=192.168.1.5", "labcomm=0.0.0.0" or "labcomm=eth0". cell : whose servers.

    Raises
    ------
    ConfigError, UnknownName : another form, server or interface, or a server that may command beyond this computer.
    """
    found = {name: "127.0.0.1" for name in cell.servers if name != OPERATOR}
    for word in listen:
        server, _, place = word.partition("=")
        if server not in found:
            raise UnknownName.among("enabled server (--listen SERVER=ADDRESS)", server, found)
        found[server] = _address(place)
        if server in cell.commands and not ipaddress.ip_address(found[server]).is_loopback:
            raise ConfigError(
                f"Expected {server} on this computer only, since `commands` names it, got --listen {word}: it has no "
                "place for a secret and no encryption. Take it out of `commands`, or let clients come through an "
                "SSH tunnel."
            )
    return found


def _address(place: str) -> str:
    """Return the IPv4 address of an address or a network interface."""
    try:
        return str(ipaddress.IPv4Address(place))
    except ValueError:
        pass
    if place not in [name for _, name in socket.if_nameindex()]:
        known = ", ".join(name for _, name in socket.if_nameindex())
        raise ConfigError(
            f"Expected an IPv4 address or one of the interfaces {known} after --listen SERVER=, got {place!r}."
        )
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            answer = fcntl.ioctl(probe.fileno(), 0x8915, place.encode().ljust(256, b"\0"))  # SIOCGIFADDR
        except OSError as error:
            raise ConfigError(f"Expected an interface with an IPv4 address, got {place} ({error.strerror}).") from error
    return socket.inet_ntoa(answer[20:24])


def run_cell(
    cell: Cell,
    listen: Iterable[str] = (),
    seconds: float | None = None,
    patience: float = math.inf,
    ready: Callable[[str], None] = lambda line: None,
    controller: Controller | None = None,
    parameters: Parameters | None = None,
) -> Run:
    """Run the bridge of a cell until it ends: EGM to rows, rows to servers, commands of one client back.

    Parameters
    ----------
    cell : from `parse_cell`. listen : see `listening`. seconds : robot time under guidance after which to end.
    patience : s to wait for a robot. ready : told one line, who listens where, before the first packet is taken.
    controller : commands the arms in place of the clients, which then only read, set parameters and stop the arms.
    parameters : that the controller reads, made of `Cell.parameters`.

    Returns
    -------
    Run as of `Link.run`.

    Raises
    ------
    ConfigError, UnknownName, LinkError : see `listening`, `connect` and `Link.run`. LinkError also when a port or the
        socket of a server is taken: before any robot is heard.
    """
    addresses = listening(listen, cell)
    sources = cell.sources()
    about = {"cell": cell.name, "links": cell.links, "commands": cell.commands, "record": cell.record}
    exchange = Exchange(
        cell.robots,
        cell.servers,
        Parameters(cell.parameters) if parameters is None else parameters,
        cell.commands,
        sources={source.name: source.fields for source in sources},
        about=about,
        read_only=[name for name, host in addresses.items() if not ipaddress.ip_address(host).is_loopback],
    )
    if controller is not None:
        exchange.arbiter.reserve("the controller of the cell")
    commands = {OPERATOR: server_command(OPERATOR, {"path": str(socket_path(cell.name))})}
    for name, host in addresses.items():
        commands[name] = server_command(name, {**cell.servers[name], "host": host})
    with ExitStack() as stack:
        where = stack.enter_context(Servers(exchange, commands)).ready()
        link = stack.enter_context(
            connect(list(cell.links), list(cell.robots), extension=cell.extension, patience=patience)
        )
        egm = [f"{link.host}:{port} (egm {arm.name})" for arm, port in zip(cell.robots, link.ports, strict=True)]
        ready(f"Listening: {', '.join([*egm, *where])}.")
        return link.run(
            exchange.arbiter if controller is None else _stoppable(controller, exchange.arbiter),
            seconds=seconds,
            limits=list(cell.limits),
            record=cell.record,
            pace=cell.pace,
            feeds=[exchange],
            sources=sources,
        )


def _stoppable(controller: Controller, arbiter: Arbiter) -> Controller:
    """Return the controller that holds while somebody has stopped the arms."""

    def controlled(state: State) -> Any:
        arbiter.poll()
        return None if arbiter.stopped else controller(state)

    return controlled


def _line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error)).rstrip(".")

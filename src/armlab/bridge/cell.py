"""Robot cell: robots, sources, parameters and servers from one TOML file, and the bridge that runs them.

By default, network servers listen only on this computer. The option --listen opens these servers to other computers
(see `listening`).
"""

from __future__ import annotations

import ipaddress
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
import numpy as np

from armlab import models, robots
from armlab._files import TomlError, parsed
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.loop import Controller
from armlab.bridge.control.run import Run
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.inputs.sources import Source, UdpSource, check_source
from armlab.bridge.link import connect
from armlab.bridge.net.sockets import is_here, is_loopback, local_addresses
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.labcomm.client import LabCommSource
from armlab.bridge.servers.labcomm.process import labcomm_options
from armlab.bridge.servers.local import socket_path
from armlab.bridge.servers.supervisor import Servers, server_command, stoppable
from armlab.bridge.urls import choosing_arm
from armlab.errors import ArmlabError, ConfigError, UnknownName
from armlab.log import Column
from armlab.robots import Robot

__all__ = ["Cell", "cell_values", "is_open", "listening", "parse_cell", "run_cell"]

GUARDED = "guarded"
"""Server option: whether commanding clients need a secret and an encrypted connection."""

_ANYWHERE = "0.0.0.0"
_ZENOH = ("zenoh", "rmw_zenoh")  # with the same port, both share a router and receive each other's messages


def listening(listen: Iterable[str], cell: Cell) -> dict[str, str]:
    """Return the address of each network server: loopback, or the address from --listen."""
    found = {name: "127.0.0.1" for name in cell.servers if name != OPERATOR}
    for word in listen:
        server, _, place = word.partition("=")
        if server not in found:
            raise UnknownName.among("enabled server (--listen SERVER=ADDRESS)", server, found)
        found[server] = _address(place)
        if server == "ros1" and found[server] == _ANYWHERE:
            raise ConfigError(
                f"Expected an address at which other nodes can reach ros1, got --listen {word}. Specify that address."
            )
        options = cell.servers[server]
        if server in cell.commands and is_open(options, found[server]):
            why = "this server needs a secret and encryption. Set both in its table in the cell file, or remove"
            if GUARDED not in options:
                why = "this server supports neither a secret nor encryption. Remove"
            raise ConfigError(
                f"Expected {server} only on this computer, because `commands` lists it, got --listen {word}: "
                f"{why} it from `commands`, or let clients connect through an SSH tunnel."
            )
    _check_readers(cell, found)
    _check_routers(cell, found)
    _check_master(cell)
    return found


def is_open(options: Mapping[str, Any], address: str) -> bool:
    """Return whether clients on other computers can reach a server without a secret; these clients may only read."""
    return not options.get(GUARDED, False) and not ipaddress.ip_address(address).is_loopback


def _check_readers(cell: Cell, addresses: Mapping[str, str]) -> None:
    """Raise an error if a server sends rows to a remote router, but --listen does not allow remote readers."""
    for name in _ZENOH:
        router = cell.servers.get(name, {}).get("router", "")
        if router and not is_here(router) and ipaddress.ip_address(addresses[name]).is_loopback:
            raise ConfigError(
                f"Expected --listen {name}=ADDRESS too, because the router {router} is on another computer, where "
                "others can read the rows. Add this option."
            )


def _check_routers(cell: Cell, addresses: Mapping[str, str]) -> None:
    """Raise an error if commands could reach one Zenoh server through the unprotected router of the other."""
    places = {name: _router_port(cell.servers[name]) for name in _ZENOH if name in cell.servers}
    for name in places:
        for other, place in places.items():
            is_shared = other != name and place and place == places[name]
            if is_shared and name in cell.commands and is_open(cell.servers[other], addresses[other]):
                raise ConfigError(
                    f"Expected {other} only on this computer, got --listen {other}={addresses[other]}: it shares the "
                    f"router at port {place} with {name}, which `commands` lists, so any client could command the "
                    f"arms. Choose a different `port` for [servers.{other}]."
                )
    at = {addresses[name] for name, place in places.items() if place and not cell.servers[name]["router"]}
    if len(set(places.values())) == 1 and len(at) == 2 and _ANYWHERE in at:
        raise ConfigError(
            f"Expected zenoh and rmw_zenoh at the same address, because both share the router at port "
            f"{places['zenoh']}, and one of them listens on all addresses. Pass --listen for both, or set a different "
            "`port` for one of them."
        )


def _check_master(cell: Cell) -> None:
    """Raise an error if ROS 1 commands are enabled with a master on another computer; ROS masters have no
    authentication."""
    if "ros1" not in cell.commands:
        return
    master = cell.servers["ros1"]["master"]
    try:
        host = urlsplit(master).hostname or ""
    except ValueError:
        host = ""
    if host != "localhost" and not is_loopback(host):
        raise ConfigError(
            f"Expected the ROS 1 master on this computer, such as http://127.0.0.1:11311, because `commands` lists "
            f"ros1, got {master}: nodes in its network could command the arms without a secret. Remove ros1 from "
            "`commands`."
        )


def _router_port(options: Mapping[str, Any]) -> str:
    """Return the local router port of a Zenoh server, or "" if other servers cannot share the router."""
    host, _, port = options["router"].rpartition(":")
    if host:
        return port if is_here(options["router"]) else ""
    return str(options["port"] or "")


def _address(place: str) -> str:
    """Return the IPv4 address of `place`, which is an address or the name of a network interface."""
    try:
        address = ipaddress.IPv4Address(place)
    except ValueError:
        pass
    else:
        if address.is_multicast or address == ipaddress.IPv4Address("255.255.255.255"):
            raise ConfigError(f"Expected the address of a network interface after --listen SERVER=, got {place}.")
        return str(address)
    own = local_addresses()
    if place not in own:
        raise ConfigError(
            f"Expected an IPv4 address or one of the interfaces {', '.join(own)} after --listen SERVER=, got {place!r}."
        )
    return own[place]


_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
_Port = Annotated[int, msgspec.Meta(ge=0, le=65535)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Table of a cell file."""


class RobotTable(_Table, frozen=True):
    """Robot: library name or file, and URL of the link; for a URDF, base, tip and lock select the arm."""

    name: str
    link: str
    base: str | None = None
    tip: str | None = None
    lock: dict[str, float] = {}  # position of each locked joint [rad or m]
    extension: bool = False
    speed: float = 1.0
    torque: float | list[float] | None = None  # one limit for all joints, or one per joint [N m]


class FieldTable(_Table, frozen=True):
    """Field of a source; a field in the glossary needs no unit."""

    shape: tuple[int, ...] = ()
    unit: str | None = None
    frame: str | None = None


class SourceTable(_Table, frozen=True):
    """Source of external values: datagrams from another program, or samples from a LabComm server."""

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
    """Parameter of the cell; see `Parameter`."""

    default: bool | int | float | str | list[float]
    type: str = "float"
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    text: str = ""
    rights: Literal["commander", "anyone"] = "commander"
    live: bool = True


class LabCommTable(_Table, frozen=True):
    """LabComm server: one port per arm, one for the parameters and one for the fused rows."""

    ports: dict[str, _Port] = {}
    parameters: _Port = 7513
    rows: _Port = 7514
    order: Literal["abb", "chain"] = "abb"
    dialect: str = "2014v1"
    types: str | None = None
    follows_client: bool = False


class _Server(_Table, frozen=True):
    """Configuration table of a server."""

    def options(self) -> dict[str, Any]:
        """Return the options of the server process, with `GUARDED` if the server supports a secret."""
        return msgspec.to_builtins(self)


class Ros2Table(_Server, frozen=True):
    """ROS 2 server over DDS; default domain: ROS_DOMAIN_ID."""

    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None
    tf: bool = False


class RosbridgeTable(_Server, frozen=True):
    """rosbridge server: port, default dialect and access control."""

    port: _Port = 9090
    dialect: Literal["ros1", "ros2"] = "ros2"
    origins: list[str] = []
    token_file: str | None = None
    token_variable: str | None = None
    certificate: str | None = None
    key: str | None = None

    def options(self) -> dict[str, Any]:
        """Return the options; a token, a certificate and a key together set `GUARDED`."""
        token = self.token_file or self.token_variable
        return {**super().options(), GUARDED: bool(token and self.certificate and self.key)}


class ZenohTable(_Server, frozen=True):
    """Zenoh server: name of the lab, router and access control; see `zenoh.security.Security`."""

    lab: _Name = "lab"
    port: _Port = 7447
    router: str = ""
    ca: str = ""
    certificate: str = ""
    key: str = ""
    users: str = ""
    secret: str = ""

    def options(self) -> dict[str, Any]:
        return {**super().options(), GUARDED: bool(self.ca and self.certificate and self.key and self.users)}


class RmwZenohTable(_Server, frozen=True):
    """ROS 2 server over Zenoh, compatible with rmw_zenoh; default domain: ROS_DOMAIN_ID."""

    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None
    distribution: Literal["humble", "jazzy", "kilted"] = "jazzy"
    tf: bool = False
    port: _Port = 7447
    router: str = ""


class Ros1Table(_Server, frozen=True):
    """ROS 1 node: URI of the master, and a Python interpreter with rospy."""

    master: str = "http://127.0.0.1:11311"
    python: str = "/usr/bin/python3"


class PlotJugglerTable(_Server, frozen=True):
    """PlotJuggler server: destination of the datagrams, and fields to send per robot; default: all numeric fields."""

    to: str = "127.0.0.1"
    port: _Port = 9870
    fields: list[str] | None = None


class ServersTable(_Table, frozen=True):
    """Enabled servers, in addition to the local server."""

    labcomm: LabCommTable | None = None
    ros2: Ros2Table | None = None
    rosbridge: RosbridgeTable | None = None
    zenoh: ZenohTable | None = None
    rmw_zenoh: RmwZenohTable | None = None
    ros1: Ros1Table | None = None
    plotjuggler: PlotJugglerTable | None = None


class File(_Table, frozen=True):
    """Complete cell file."""

    robots: Annotated[list[RobotTable], msgspec.Meta(min_length=1)]
    name: _Name = "cell"
    commands: list[Literal["labcomm", "local", "rmw_zenoh", "ros1", "ros2", "rosbridge", "zenoh"]] = []
    pace: str | None = None
    record: str | None = None
    sources: dict[_Name, SourceTable] = {}
    parameters: dict[str, ParameterTable] = {}
    servers: ServersTable = ServersTable()


_SIDES = {"left": 7511, "right": 7512}


@dataclass(frozen=True)
class Cell:
    """Validated cell file; for `extension`, `pace` and `record`, see `connect` and `Link.run`."""

    name: str
    robots: tuple[Robot, ...]
    links: tuple[str, ...]  # URL of each arm
    extension: bool
    limits: tuple[Limits, ...]
    torque: tuple[str, ...]  # names of the arms that accept torque commands from clients
    commands: tuple[str, ...]  # servers whose clients may command
    pace: str | None
    record: str | None
    parameters: tuple[Parameter, ...]
    servers: Mapping[str, Mapping[str, Any]]  # options by server name
    _sources: Mapping[str, SourceTable]
    text: str = ""  # of the cell file, to be stored in recordings

    def sources(self) -> list[Source]:
        """Return new sources; the caller must start them."""
        return [_source(name, one) for name, one in self._sources.items()]


def parse_cell(text: str, path: str = "cell.toml") -> Cell:
    """Parse a cell from TOML text; invalid text raises a one-line `ConfigError` with the path."""
    try:
        file = msgspec.convert(parsed(text), File, strict=True)
        return replace(_cell(file), text=text)
    except TomlError as error:
        raise ConfigError(f"Expected valid TOML in {path}: {_line(error)}.") from None
    except (msgspec.ValidationError, ArmlabError) as error:
        raise ConfigError(f"Expected a valid cell in {path}: {_line(error)}.") from None


def _link(one: RobotTable) -> str:
    """Return the URL of a link; for a simulated robot, the URL includes the options that select the arm."""
    lock = ",".join(f"{joint}={value!r}" for joint, value in one.lock.items())
    chosen = {name: value for name, value in (("base", one.base), ("tip", one.tip), ("lock", lock)) if value}
    return choosing_arm(one.link, chosen)


def _cell(file: File) -> Cell:
    arms = tuple(robots.load(one.name, base=one.base, tip=one.tip, lock=one.lock or None) for one in file.robots)
    names = [arm.name for arm in arms]
    if len(set(names)) < len(names):
        raise ConfigError(f"Expected robots with different names, got {', '.join(names)}.")
    if len(names) > 1 and file.name in names:  # the cell name addresses all arms together
        raise ConfigError(f"Expected a cell name that differs from the names of its robots, got {file.name}.")
    if file.pace is not None and file.pace not in names:
        raise UnknownName.among("robot of this cell", file.pace, names)
    servers: dict[str, Mapping[str, Any]] = {OPERATOR: {}}
    for name in file.servers.__struct_fields__:
        table = getattr(file.servers, name)
        if table is not None:
            servers[name] = _labcomm(table, arms) if name == "labcomm" else table.options()
    idle = [name for name in file.commands if name not in servers]
    if idle:
        raise ConfigError(
            f"Expected `commands` to name enabled servers, got {', '.join(idle)}. Add [servers.{idle[0]}]."
        )
    declared = [Parameter(name, **msgspec.structs.asdict(one)) for name, one in file.parameters.items()]
    Parameters(declared)
    for name, source in file.sources.items():
        check_source(_source(name, source), arms)
    extension = any(one.extension for one in file.robots)
    limits = tuple(_limits(arm, one, extension) for arm, one in zip(arms, file.robots, strict=True))
    links, commands = tuple(_link(one) for one in file.robots), tuple(file.commands)
    torque = tuple(arm.name for arm, one in zip(arms, file.robots, strict=True) if one.torque is not None)
    settings = file.pace, file.record, tuple(declared), servers, file.sources
    return Cell(file.name, arms, links, extension, limits, torque, commands, *settings)


def _limits(arm: Robot, one: RobotTable, extension: bool) -> Limits:
    """Return the limits of an arm; `torque` requires a link that supports torques."""
    if one.torque is None:
        return Limits.of(arm, speed=one.speed)
    if not (one.link.startswith("sim:") or (extension and one.link.startswith("egm:"))):
        raise ConfigError(
            f"Expected a link for {arm.name} that supports torques, because `torque` is set, got {one.link}. Set "
            "extension = true if the robot's controller supports it, or remove `torque`."
        )
    most = np.asarray(one.torque, dtype=float)
    if most.shape not in ((), (arm.n,)) or not np.all(most > 0.0) or np.any(most > arm.tau_max):
        raise ConfigError(
            f"Expected `torque` of {arm.name} to be one number or {arm.n} numbers, positive and within its limits, got "
            f"{one.torque}."
        )
    return Limits.of(arm, speed=one.speed, tau_max=most)


def _labcomm(options: LabCommTable, arms: Sequence[Robot]) -> dict[str, Any]:
    names = [arm.name for arm in arms]
    for name in options.ports:
        if name not in names:
            raise UnknownName.among("robot of this cell", name, names)
    sides = [_SIDES.get(arm.side, 7511) for arm in arms]
    ports = [options.ports.get(arm.name, side) for arm, side in zip(arms, sides, strict=True)]
    taken = [port for port in (*ports, options.parameters, options.rows) if port]
    if len(set(taken)) < len(taken):
        raise ConfigError(
            f"Expected a different LabComm port for each arm, for the parameters and for the rows, got {taken}."
        )
    fields: dict[str, Any] = {**msgspec.structs.asdict(options), "ports": ports}
    fused = fields.pop("rows")
    return labcomm_options(arms, fused=fused, **fields)


def _source(name: str, one: SourceTable) -> Source:
    fields = {field: Column(about.shape, about.unit, about.frame) for field, about in one.fields.items()}
    options: dict[str, Any] = {"max_age": one.max_age, "role": one.role, "robot": one.robot}
    if one.calibration is not None:
        options["calibration"] = models.load(one.calibration, kind="force_sensor")
    if one.kind == "labcomm":
        return LabCommSource(name, fields, one.period, one.port, one.host, one.sample, **options)
    return UdpSource(name, fields, one.period, one.port, one.layout, one.host, **options)


def run_cell(
    cell: Cell,
    listen: Iterable[str] = (),
    seconds: float | None = None,
    patience: float = math.inf,
    ready: Callable[[str], None] = lambda line: None,
    ended: Callable[[Run], None] = lambda run: None,
    controller: Controller | None = None,
    parameters: Parameters | None = None,
) -> Run:
    """Run the bridge of a cell, which sends rows to the servers and client commands to the arms.

    Parameters
    ----------
    cell : Cell
        From `parse_cell`.
    listen : iterable of str
        Options ``SERVER=ADDRESS``; see `listening`.
    seconds : float, s
        The run ends after this much robot time under guidance.
    patience : float, s
        Time to wait for a robot.
    ready : callable
        Called before the first packet with one line that lists all listening addresses.
    ended : callable
        Called with the finished Run, even if an error is then raised.
    controller : callable
        Commands the arms instead of the clients, which may then only read, set parameters and stop the arms.
    parameters : Parameters
        Parameters of the controller, built from `Cell.parameters`.
    """
    addresses = listening(listen, cell)
    sources = cell.sources()
    about = {"cell": cell.name, "links": cell.links, "commands": cell.commands, "record": cell.record}
    about["speeds"] = {robot.name: limits.qd_max.tolist() for robot, limits in zip(cell.robots, cell.limits)}
    exchange = Hub(
        cell.robots,
        cell.servers,
        Parameters(cell.parameters) if parameters is None else parameters,
        cell.commands,
        sources={source.name: source.fields for source in sources},
        about=about,
        torque=cell.torque,
        read_only=[name for name, host in addresses.items() if is_open(cell.servers[name], host)],
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
        try:
            return link.run(
                exchange.arbiter if controller is None else stoppable(controller, exchange.arbiter),
                seconds=seconds,
                limits=list(cell.limits),
                record=cell.record,
                attachments={"cell.toml": cell.text.encode()} if cell.text else None,
                pace=cell.pace,
                feeds=[exchange],
                sources=sources,
            )
        finally:
            if link.last is not None:
                ended(link.last)


def _line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error)).rstrip(".")


def cell_values(text: str, path: str = "cell.toml") -> list[tuple[str, Any, bool]]:
    """Return (key path, value, whether the file sets the value) for all entries, with key paths such as
    `robots[0].speed`."""
    parse_cell(text, path)
    raw = parsed(text)
    return list(_values(msgspec.convert(raw, File, strict=True), raw, ""))


def _values(value: Any, raw: Any, place: str) -> Iterator[tuple[str, Any, bool]]:
    if isinstance(value, msgspec.Struct):
        for name in value.__struct_fields__:
            given = raw.get(name, _NOTHING) if isinstance(raw, dict) else _NOTHING
            yield from _values(getattr(value, name), given, f"{place}.{name}" if place else name)
    elif isinstance(value, dict) and value:
        for name, one in value.items():
            yield from _values(one, raw[name], f"{place}.{name}")
    elif isinstance(value, list) and value and isinstance(value[0], msgspec.Struct):
        for k, (one, given) in enumerate(zip(value, raw, strict=True)):
            yield from _values(one, given, f"{place}[{k}]")
    else:
        yield place, value, raw is not _NOTHING


_NOTHING = object()

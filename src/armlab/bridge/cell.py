"""A cell: robots, sources, parameters and servers from one TOML file, and the bridge that runs it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from armlab import models, robots
from armlab._toml import TomlError, parsed
from armlab.bridge.cell_file import File, LabCommTable, RobotTable, SourceTable
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.loop import Controller
from armlab.bridge.control.run import Run
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.inputs.sources import Source, UdpSource
from armlab.bridge.link import connect
from armlab.bridge.listen import is_open, listening
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.labcomm.client import LabCommSource
from armlab.bridge.servers.labcomm.process import labcomm_options
from armlab.bridge.servers.local import socket_path
from armlab.bridge.servers.supervisor import Servers, server_command, stoppable
from armlab.errors import ArmlabError, ConfigError, UnknownName
from armlab.log import Column
from armlab.robots import Robot

__all__ = ["Cell", "cell_values", "parse_cell", "run_cell"]

_SIDES = {"left": 7511, "right": 7512}


@dataclass(frozen=True)
class Cell:
    """What a cell file says, checked.

    Attributes
    ----------
    name : of the cell. robots, links : the arms and their urls. extension : send the research extension.
    limits : of each arm. torque : names of arms that clients may command by torque.
    commands : servers that may command. pace, record : see `Link.run`.
    parameters : declared. servers : options by name of the server. text : of the file, kept in recordings.
    """

    name: str
    robots: tuple[Robot, ...]
    links: tuple[str, ...]
    extension: bool
    limits: tuple[Limits, ...]
    torque: tuple[str, ...]
    commands: tuple[str, ...]
    pace: str | None
    record: str | None
    parameters: tuple[Parameter, ...]
    servers: Mapping[str, Mapping[str, Any]]
    _sources: Mapping[str, SourceTable]
    text: str = ""

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
        file = msgspec.convert(parsed(text), File, strict=True)
        return replace(_cell(file), text=text)
    except TomlError as error:
        raise ConfigError(f"Expected TOML in {path}: {_line(error)}.") from None
    except (msgspec.ValidationError, ArmlabError) as error:
        raise ConfigError(f"Expected another cell in {path}: {_line(error)}.") from None


def _cell(file: File) -> Cell:
    arms = tuple(robots.load(one.name) for one in file.robots)
    names = [arm.name for arm in arms]
    if len(set(names)) < len(names):
        raise ConfigError(f"Expected robots with different names, got {', '.join(names)}.")
    if len(names) > 1 and file.name in names:  # both arms are commanded under the name of the cell
        raise ConfigError(f"Expected a name of the cell that none of its robots has, got {file.name}.")
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
    declared = []
    for name, one in file.parameters.items():
        fields = {field: getattr(one, field) for field in one.__struct_fields__}
        declared.append(Parameter(name, **fields))
    Parameters(declared)
    for name, source in file.sources.items():
        _source(name, source).check(arms)
    extension = any(one.extension for one in file.robots)
    limits = tuple(_limits(arm, one, extension) for arm, one in zip(arms, file.robots, strict=True))
    return Cell(
        file.name,
        arms,
        tuple(one.link for one in file.robots),
        extension,
        limits,
        tuple(arm.name for arm, one in zip(arms, file.robots, strict=True) if one.torque is not None),
        tuple(file.commands),
        file.pace,
        file.record,
        tuple(declared),
        servers,
        file.sources,
    )


def _limits(arm: Robot, one: RobotTable, extension: bool) -> Limits:
    """Return the limits of an arm; torques only where the link carries them."""
    if one.torque is None:
        return Limits.of(arm, speed=one.speed)
    if not (one.link.startswith("sim:") or (extension and one.link.startswith("egm:"))):
        raise ConfigError(
            f"Expected a link that carries torques to {arm.name}, since `torque` is given, got {one.link}. Set "
            "extension = true, if the robot's controller understands it, or take `torque` out."
        )
    most = np.asarray(one.torque, dtype=float)
    if most.shape not in ((), (arm.n,)) or not np.all(most > 0.0) or np.any(most > arm.tau_max):
        raise ConfigError(
            f"Expected `torque` of {arm.name} as one number or {arm.n}, positive and within its limits, got "
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
    """Run the bridge of a cell until it ends: EGM to rows, rows to servers, commands of one client back.

    Parameters
    ----------
    cell : from `parse_cell`. listen : see `listening`. seconds : robot time under guidance after which to end.
    patience : s to wait for a robot. ready : told one line, who listens where, before the first packet is taken.
    ended : told the run that ended, also when it then raises.
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
    """Return (place, value, whether the file says it) of all that a cell file may say, as `robots[0].speed`.

    Parameters
    ----------
    text : of the file. path : its name, for messages.

    Raises
    ------
    ConfigError : as of `parse_cell`.
    """
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

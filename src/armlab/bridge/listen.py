"""`listening`: the addresses of a cell's network servers, this computer only unless the user asks otherwise."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Mapping
from typing import Any, Protocol
from urllib.parse import urlsplit

from armlab.bridge.net.sockets import is_here, is_loopback
from armlab.bridge.servers.hub import OPERATOR
from armlab.errors import ConfigError, UnknownName

__all__ = ["is_open", "listening"]

GUARDED = "guarded"
"""Option by which a server says that who commands through it has to know a secret, and that nobody can overhear it."""

_ANYWHERE = "0.0.0.0"
_ZENOH = ("zenoh", "rmw_zenoh")  # at one port they share a router, and what reaches one of them reaches the other


class _Cell(Protocol):
    """The fields of a cell that say who listens where."""

    @property
    def servers(self) -> Mapping[str, Mapping[str, Any]]: ...

    @property
    def commands(self) -> Iterable[str]: ...


def listening(listen: Iterable[str], cell: _Cell) -> dict[str, str]:
    """Return the address of each network server: loopback, or what the user asked for."""
    found = {name: "127.0.0.1" for name in cell.servers if name != OPERATOR}
    for word in listen:
        server, _, place = word.partition("=")
        if server not in found:
            raise UnknownName.among("enabled server (--listen SERVER=ADDRESS)", server, found)
        found[server] = _address(place)
        if server == "ros1" and found[server] == _ANYWHERE:
            raise ConfigError(f"Expected the address by which other nodes reach ros1, got --listen {word}. Name it.")
        options = cell.servers[server]
        if server in cell.commands and is_open(options, found[server]):
            raise ConfigError(
                f"Expected {server} on this computer only, since `commands` names it, got --listen {word}: "
                f"{_why(options)} Or take it out of `commands`, or let clients come through an SSH tunnel."
            )
    _check_readers(cell, found)
    _check_routers(cell, found)
    _check_master(cell)
    return found


def is_open(options: Mapping[str, Any], address: str) -> bool:
    """Return whether a server is reached from beyond this computer by clients that prove nothing: they only read."""
    return not options.get(GUARDED, False) and not ipaddress.ip_address(address).is_loopback


def _check_readers(cell: _Cell, addresses: Mapping[str, str]) -> None:
    """Refuse that rows go to a router elsewhere unless --listen says that this server is read from there."""
    for name in _ZENOH:
        router = cell.servers.get(name, {}).get("router", "")
        if router and not is_here(router) and ipaddress.ip_address(addresses[name]).is_loopback:
            raise ConfigError(
                f"Expected --listen {name}=ADDRESS too, since its router {router} is not on this computer: whoever "
                "reads there reads the rows. Add it."
            )


def _check_routers(cell: _Cell, addresses: Mapping[str, str]) -> None:
    """Refuse that commands of one Zenoh server come through the router of another that anybody reaches."""
    places = {name: _router_port(cell.servers[name]) for name in _ZENOH if name in cell.servers}
    for name in places:
        for other, place in places.items():
            is_shared = other != name and place and place == places[name]
            if is_shared and name in cell.commands and is_open(cell.servers[other], addresses[other]):
                raise ConfigError(
                    f"Expected {other} on this computer only, got --listen {other}={addresses[other]}: it shares the "
                    f"router at port {place} with {name}, which `commands` names, so that anybody could command. Give "
                    f"[servers.{other}] another `port`."
                )
    at = {addresses[name] for name, place in places.items() if place and not cell.servers[name]["router"]}
    if len(set(places.values())) == 1 and len(at) == 2 and _ANYWHERE in at:
        raise ConfigError(
            f"Expected zenoh and rmw_zenoh at the same address, since one is at port {places['zenoh']} of every one "
            "and both share that router. Give --listen for both, or another `port` to one of them."
        )


def _check_master(cell: _Cell) -> None:
    """Refuse commands of ROS 1 when the master is elsewhere: it tells us to read from nodes of its network."""
    if "ros1" not in cell.commands:
        return
    master = cell.servers["ros1"]["master"]
    try:
        host = urlsplit(master).hostname or ""
    except ValueError:
        host = ""
    if host != "localhost" and not is_loopback(host):
        raise ConfigError(
            f"Expected the master of ROS 1 on this computer, such as http://127.0.0.1:11311, since `commands` names "
            f"ros1, got {master}: nodes of its network could command, and prove nothing. Take ros1 out of `commands`."
        )


def _router_port(options: Mapping[str, Any]) -> str:
    """Return the port of the router on this computer that a Zenoh server uses, "" when it shares none."""
    host, _, port = options["router"].rpartition(":")
    if host:
        return port if is_here(options["router"]) else ""
    return str(options["port"] or "")


def _why(options: Mapping[str, Any]) -> str:
    if GUARDED in options:
        return "it asks for no secret, or does not encrypt. Give it both in its table of the cell."
    return "it has no place for a secret and no encryption."


def _address(place: str) -> str:
    """Return the IPv4 address of an address or a network interface."""
    try:
        address = ipaddress.IPv4Address(place)
    except ValueError:
        pass
    else:
        if address.is_multicast or address == ipaddress.IPv4Address("255.255.255.255"):
            raise ConfigError(f"Expected the address of a network card after --listen SERVER=, got {place}.")
        return str(address)
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

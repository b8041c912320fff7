"""`listening`: the addresses of a cell's network servers, this computer only unless the user asks otherwise."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable
from typing import TYPE_CHECKING

from armlab.bridge.feed import OPERATOR
from armlab.errors import ConfigError, UnknownName

if TYPE_CHECKING:
    from armlab.bridge.cell import Cell

__all__ = ["listening"]


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

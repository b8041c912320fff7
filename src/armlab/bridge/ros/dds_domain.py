"""A participant of a DDS domain that is heard on this computer only, or on one network by who may only read."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from armlab.bridge.ros._cyclone import DDSException, Domain, DomainParticipant
from armlab.errors import LinkError

__all__ = ["configuration", "joined", "tie_to_loopback"]

_PARTICIPANTS = 32  # of this computer that are looked for, as many as ROS 2 does
_LOOPBACK = b"lo"


def configuration(host: str) -> str:
    """Return the settings of Cyclone DDS as XML: where it speaks, and how others are found.

    On this computer the bridge announces itself to each port of 127.0.0.1 every 2 s, so that a node with multicast
    discovery also finds it. Cyclone DDS would drop ports that do not answer for 30 s, and with them every node started
    later. On a network participants are found by multicast.

    Parameters
    ----------
    host : IPv4 address of the interface.
    """
    if _is_local(host):
        found = (
            f"<Peers><Peer address='127.0.0.1'/></Peers><MaxAutoParticipantIndex>{_PARTICIPANTS}"
            "</MaxAutoParticipantIndex><SPDPInterval>2 s</SPDPInterval>"
            "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
        )
        interface, multicast = "<NetworkInterface address='127.0.0.1' multicast='false'/>", "false"
    else:
        found, interface, multicast = "", f"<NetworkInterface address='{host}'/>", "spdp"
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces>{interface}</Interfaces><AllowMulticast>{multicast}"
        f"</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>{found}</Discovery></Domain>"
        "</CycloneDDS>"
    )


@contextlib.contextmanager
def joined(domain: int, host: str) -> Iterator[DomainParticipant]:
    """Be a participant of a domain while the block runs.

    Parameters
    ----------
    domain : its number. host : see `configuration`; 127.0.0.1 for this computer only.

    Raises
    ------
    LinkError : there is no such interface, or the sockets cannot be kept to this computer.
    """
    try:
        settings = Domain(domain, configuration(host))
        participant = DomainParticipant(domain)
    except DDSException as error:
        raise LinkError(
            f"Expected to join DDS domain {domain} on {host}, but {error} Give the address of one network interface "
            "that is up."
        ) from None
    if _is_local(host):
        tie_to_loopback()
    try:
        yield participant
    finally:
        del participant, settings


def tie_to_loopback() -> int:
    """Keep what comes from other computers off the sockets of this process, and return of how many.

    Cyclone DDS binds what it receives by to every address, whatever the interface (its `ddsi_udp.c`).

    Raises
    ------
    LinkError : the system does not do that.
    """
    count = 0
    for entry in Path("/proc/self/fd").iterdir():
        if not entry.is_socket():
            continue
        with socket.socket(fileno=os.dup(int(entry.name))) as one:
            if one.family == socket.AF_INET and one.getsockname()[0] == "0.0.0.0":
                _tie(one)
                count += 1
    return count


def _tie(one: socket.socket) -> None:
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK)
    except OSError as error:
        raise LinkError(
            f"Expected to keep DDS to this computer, but the system does not ({error.strerror}). It needs Linux 5.7 "
            "or newer; on others, use rosbridge or Zenoh."
        ) from error


def _is_local(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback

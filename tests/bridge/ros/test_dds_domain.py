"""Which domain, and who can be heard."""

from __future__ import annotations

import os
import socket
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from armlab.errors import LinkError

from .dds_peers import free_domain

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.ros import dds_domain
from armlab.bridge.ros.dds_domain import configuration, joined, tie_to_loopback


def device(one: socket.socket) -> bytes:
    return one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0")


def test_settings_of_this_computer_and_of_a_network() -> None:
    local = ElementTree.fromstring(configuration("127.0.0.1"))
    interface = local.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "127.0.0.1", "multicast": "false"}
    assert local.findtext(".//AllowMulticast") == "false"
    assert local.find(".//Peer[@address='127.0.0.1']") is not None
    lab = ElementTree.fromstring(configuration("192.168.1.5"))
    interface = lab.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "192.168.1.5"}
    assert lab.findtext(".//AllowMulticast") == "spdp"
    assert lab.find(".//Peer") is None


def test_sockets_open_to_all_are_tied_to_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wide, socket.create_server(("127.0.0.1", 0)) as narrow:
        wide.bind(("0.0.0.0", 0))
        assert tie_to_loopback() >= 1
        assert device(wide) == b"lo"
        assert device(narrow) == b""
        monkeypatch.setattr(dds_domain, "_LOOPBACK", b"nowhere")
        with pytest.raises(LinkError, match="use rosbridge or Zenoh"):
            tie_to_loopback()


def test_a_participant_listens_on_this_computer_only() -> None:
    """Cyclone DDS binds to all addresses; every such socket is tied to the loopback interface."""
    domain = free_domain()
    before = len(list(Path("/proc/self/fd").iterdir()))
    found = {}
    with joined(domain, "127.0.0.1"):
        for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
            with socket.socket(fileno=os.dup(int(entry.name))) as one:
                if one.family == socket.AF_INET:
                    found[one.getsockname()[1]] = one.getsockname()[0], device(one)
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    for port in (7410 + 250 * domain, 7411 + 250 * domain):
        assert found[port][0] == "127.0.0.1" or found[port][1] == b"lo"
    wide = [about for about in found.values() if not about[0].startswith("127.")]
    assert all(tied == b"lo" for _, tied in wide)


def test_an_interface_that_is_not_there() -> None:
    with (
        pytest.raises(LinkError, match=r"on 192\.0\.2\.1, but .* Give the address"),
        joined(free_domain(), "192.0.2.1"),
    ):
        pass

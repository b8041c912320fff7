"""Which domain, and who can be heard."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from armlab.errors import LinkError

from .dds_peers import free_domain

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros import dds
from armlab.bridge.servers.ros.dds import configuration, joined, tie_to_loopback


def device(one: socket.socket) -> bytes:
    return one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0")


def test_settings_of_this_computer_and_of_a_network() -> None:
    local = ElementTree.fromstring(configuration("127.0.0.1"))
    interface = local.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "127.0.0.1", "multicast": "false"}
    assert local.findtext(".//AllowMulticast") == "false"
    assert local.find(".//Peer[@address='127.0.0.1']") is not None
    assert local.findtext(".//InitialLocatorPruneDelay") == "inf", "nodes may start at any time"
    lab = ElementTree.fromstring(configuration("192.168.1.5"))
    interface = lab.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "192.168.1.5"}
    assert lab.findtext(".//AllowMulticast") == "spdp"
    assert lab.find(".//Peer") is None
    assert lab.find(".//InitialLocatorPruneDelay") is None


def test_sockets_open_to_all_are_tied_to_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wide, socket.create_server(("127.0.0.1", 0)) as narrow:
        wide.bind(("0.0.0.0", 0))
        assert tie_to_loopback() >= 1
        assert device(wide) == b"lo"
        assert device(narrow) == b""
        monkeypatch.setattr(dds, "_LOOPBACK", b"nowhere")
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


OUTSIDE = """
import contextlib, os, socket, subprocess, sys
from pathlib import Path
from armlab.bridge.servers.ros.dds import joined

def ip(*words):
    subprocess.run(["ip", *words], check=True, timeout=20)

SENDS = '''
import socket, sys
print("there", flush=True)
for port in sys.stdin.readline().split():
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.settimeout(2.0)
    one.connect(("10.255.77.1", int(port)))
    one.send(b"RTPS")
    try:
        print(port, one.recv(10).decode(), flush=True)
    except ConnectionRefusedError:
        print(port, "refused", flush=True)
    except TimeoutError:
        print(port, "taken", flush=True)
'''

ip("link", "set", "lo", "up")
words = ["unshare", "-n", sys.executable, "-S", "-c", SENDS]
with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
    try:
        other.stdout.readline()
        ip("link", "add", "near0", "type", "veth", "peer", "name", "far0", "netns", str(other.pid))
        ip("addr", "add", "10.255.77.1/24", "dev", "near0")
        ip("link", "set", "near0", "up")
        theirs = ["nsenter", "-t", str(other.pid), "-n", "ip"]
        subprocess.run([*theirs, "addr", "add", "10.255.77.2/24", "dev", "far0"], check=True, timeout=20)
        subprocess.run([*theirs, "link", "set", "far0", "up"], check=True, timeout=20)
        with joined(0, "127.0.0.1"), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
            control.bind(("0.0.0.0", 0))
            control.settimeout(60.0)
            ports = set()
            for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
                with socket.socket(fileno=os.dup(int(entry.name))) as one:
                    if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                        ports.add(one.getsockname()[1])
            mine = control.getsockname()[1]
            ports.discard(mine)
            other.stdin.write(" ".join(map(str, [*sorted(ports), mine])) + chr(10))
            other.stdin.flush()
            _, sender = control.recvfrom(10)
            control.sendto(b"heard", sender)
            sys.stdout.write(other.stdout.read())
    finally:
        other.kill()
"""


@pytest.mark.slow
def test_packets_from_another_interface_reach_no_socket_of_a_participant() -> None:
    """Seen from a network namespace at the other end of a cable; one socket that is open to all shows that it holds."""
    try:
        cable = [
            "unshare",
            "-rn",
            "unshare",
            "-n",
            "ip",
            "link",
            "add",
            "near0",
            "type",
            "veth",
            "peer",
            "name",
            "far0",
        ]
        able = subprocess.run(cable, capture_output=True, check=False)
    except FileNotFoundError as error:
        pytest.skip(f"{error.filename} is not installed")
    if able.returncode:
        pytest.skip(f"no network namespaces and cables here: {able.stderr.decode().strip()}")
    words = ["unshare", "-rn", sys.executable, "-c", OUTSIDE]
    found = subprocess.run(words, capture_output=True, text=True, timeout=120.0, check=False)
    assert not found.returncode, found.stderr
    outcomes = dict(line.split() for line in found.stdout.splitlines())
    *dds, control = outcomes.values()
    assert control == "heard"
    assert {"7410", "7411"} <= set(outcomes)
    assert set(dds) == {"refused"}

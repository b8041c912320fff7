"""The network, and what comes to a port while nothing is sent to a robot."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from armlab.bridge.doctor import network
from armlab.bridge.doctor.findings import Finding
from armlab.bridge.doctor.network import addresses, firewall, listen, local_addresses, route_to
from armlab.robots import Robot


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        return one.getsockname()[1]


@contextmanager
def streaming(peer: Any) -> Iterator[None]:
    """Let a peer send at 500 Hz while the block runs."""
    over = threading.Event()

    def play() -> None:
        while not over.wait(0.002):
            peer.send()

    thread = threading.Thread(target=play, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(10)


def named(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.name: finding for finding in findings}


def test_own_addresses() -> None:
    found = local_addresses()
    assert found["lo"] == "127.0.0.1"
    assert addresses({"lo": "127.0.0.1", "eth0": "192.0.2.1"}).verdict == "ok"
    assert "eth0 192.0.2.1" in addresses({"lo": "127.0.0.1", "eth0": "192.0.2.1"}).value
    alone = addresses({"lo": "127.0.0.1"})
    assert alone.verdict == "warning"
    assert "cable" in alone.advice
    assert addresses({}).value == "none"


def test_route() -> None:
    assert route_to("127.0.0.1") == "127.0.0.1"
    assert route_to("no such host") == ""


def test_firewall(tmp_path: Path) -> None:
    file = tmp_path / "ufw.conf"
    assert firewall(file).verdict == "ok"
    file.write_text("# comment\nENABLED=no\n", encoding="utf-8")
    assert firewall(file).verdict == "ok"
    file.write_text("ENABLED=yes\n", encoding="utf-8")
    assert firewall(file).verdict == "warning"
    assert "ufw allow" in firewall(file).advice


def test_a_port_that_another_holds() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        number = other.getsockname()[1]
        (found,) = listen([number], 0.01, [None], asked=True)
    assert (found.name, found.verdict) == (f"port {number}", "failure")
    assert f"process {os.getpid()}" in found.advice


def test_silence_is_told_once_when_nobody_asked() -> None:
    one, two = free_port(), free_port()
    found = named(listen([one, two], 0.01, [None, None], asked=False))
    assert found[f"port {one}"].verdict == "ok"
    assert found[f"port {one}, self-test"].verdict == "ok"
    assert found[f"port {one}, packets"].verdict == "warning"
    assert f"port {two}, packets" not in found
    found = named(listen([one, two], 0.01, [None, None], asked=True))
    assert found[f"port {two}, packets"].verdict == "warning"


def test_a_robot_is_heard_and_gets_nothing(robot: Robot, make_peer: Any) -> None:
    number = free_port()
    peer = make_peer(robot, number)
    with streaming(peer):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert peer.surplus() == 0
    assert "7 axes" in found[f"port {number}, first packet"].value
    assert "leave from 127.0.0.1" in found[f"port {number}, route"].value
    assert found[f"port {number}, senders"].verdict == "ok"
    assert f"from 127.0.0.1:{peer.socket.getsockname()[1]}" in found[f"port {number}, packets"].value


def test_two_robots_on_one_port(robot: Robot, make_peer: Any) -> None:
    number = free_port()
    first, second = make_peer(robot, number), make_peer(robot, number)
    with streaming(first), streaming(second):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert found[f"port {number}, senders"].verdict == "failure"
    assert first.surplus() == second.surplus() == 0


def test_no_route_to_a_robot(robot: Robot, make_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "route_to", lambda host: "")
    number = free_port()
    peer = make_peer(robot, number)
    with streaming(peer):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert found[f"port {number}, route"].verdict == "failure"
    assert "network of 127.0.0.1" in found[f"port {number}, route"].advice


def test_a_rule_that_drops_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a firewall does: an address of this computer from which nothing arrives."""
    monkeypatch.setattr(network, "local_addresses", lambda: {"eth9": "203.0.113.9"})
    number = free_port()
    found = named(listen([number], 0.01, [None], asked=True))[f"port {number}, self-test"]
    assert found.verdict == "failure"
    assert "203.0.113.9" in found.advice

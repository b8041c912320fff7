"""Routers, and the robots found through them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema
from armlab.bridge.servers.zenoh.messages import EVERY
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import LabAddress, close_session
from armlab.cli.bridge import write_certificates
from armlab.errors import ConfigError, LinkError
from armlab.fleet import Router, list_robots
from armlab.fleet.discovery import FleetRobot, _Seen

from ..processes import PATIENCE, Started, free_port, until

RATES = {"ur5e": 20.0, "yumi_left": 100.0, "yumi_right": 250.0}


@pytest.mark.slow
def test_robots_and_how_they_do(processes: Callable[..., Started]) -> None:
    with Router(port=(port := free_port())):
        for name, rate in RATES.items():
            processes("publisher", port, name, name, str(1.0 / rate))
        found: list[FleetRobot] = []

        def rates_are_right() -> bool:
            found[:] = list_robots(LabAddress(port=port, lab="lab1"), 1.2)
            return {one.robot for one in found} == set(RATES) and all(
                0.9 * RATES[one.robot] < one.rate < 1.1 * RATES[one.robot] for one in found
            )

        until(rates_are_right, 4.0 * PATIENCE)
        for one in found:
            assert (one.lab, one.commander, one.damaged) == ("lab1", "", 0)
            assert one.loss >= 0
            assert math.isfinite(one.age)
            assert one.age < 5.0
        assert list_robots(LabAddress(port=port, lab="another"), 0.2) == []


def test_beyond_this_computer_it_asks_for_certificates_and_users() -> None:
    with pytest.raises(ConfigError, match=r"Expected certificates and users for the router at 0.0.0.0"):
        Router("0.0.0.0", 0)
    with pytest.raises(ConfigError, match="Expected the address of a network interface"):
        Router("eth0", 0)
    with pytest.raises(ConfigError, match=r"Expected certificates and users for the router connected to 192.168.1.9:1"):
        Router(port=0, connect=["192.168.1.9:1"])


def test_nobody_is_there_and_a_taken_port_is_told() -> None:
    with Router(port=(port := free_port())):
        assert list_robots(LabAddress(port=port, lab=EVERY)) == []
        with pytest.raises(LinkError, match="in use"):
            Router(port=port)


def test_damaged_rows_are_counted_and_what_cannot_be_read_is_shown_without_rows() -> None:
    robot, seen, unread = robots.load("ur5e"), _Seen("lab1", "ur5e"), _Seen("lab1", "ur5e")
    about = {"schema": RowSchema.of([robot]).text.decode(), "robots": {robot.name: robots.to_toml(robot)}}
    seen.describe(json.dumps([about]).encode())
    seen.take(None)
    assert seen.summary()[2:5] == (0.0, 0, 1)
    unread.describe(b"[" * 200_000)
    unread.take(b"ALR1" + bytes(60))
    assert unread.summary()[2:5] == (0.0, 0, 0)


def test_who_has_no_password_is_not_let_in(tmp_path: Path) -> None:
    write_certificates(tmp_path)
    lab = {name: tmp_path / file for name, file in {"ca": "lab.pem", "certificate": "bridge.pem"}.items()}
    safe = Security(**lab, key=tmp_path / "bridge.key", users=tmp_path / "users.txt")
    with Router(port=(port := free_port()), security=safe) as router:
        assert router.where == f"tls/127.0.0.1:{port}"
        viewer = Security(ca=tmp_path / "lab.pem", secret=tmp_path / "viewer.secret")
        close_session(LabAddress(port=port, security=viewer).open_behind())
        for stranger in (Security(ca=tmp_path / "lab.pem"), Security()):
            with pytest.raises(LinkError, match="the certificates and the password"):
                LabAddress(port=port, security=stranger).open_behind(0.1)


def test_routers_that_are_connected_pass_on_what_is_read() -> None:
    near, far = free_port(), free_port()
    with Router(port=far), Router(port=near, connect=[f"127.0.0.1:{far}"]):
        reader, writer, came = LabAddress(port=near).open_behind(), LabAddress(port=far).open_behind(), []
        rows = reader.declare_subscriber("armlab/*/*/state", lambda sample: came.append(sample.payload.to_bytes()))

        def has_come() -> bool:
            writer.put("armlab/lab1/arm/state", b"row")
            return bool(came)

        until(has_come)
        rows.undeclare()
        close_session(reader)
        close_session(writer)
    assert set(came) == {b"row"}

"""`Router`: where it listens, and what it asks of those beyond this computer."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.bridge.servers.zenoh import Place, Security, close_session
from armlab.cli.certificates import write_certificates
from armlab.errors import ConfigError, LinkError
from armlab.fleet import Router

from ..processes import free_port, until


def test_beyond_this_computer_it_asks_for_certificates_and_users() -> None:
    with pytest.raises(ConfigError, match=r"Expected certificates and users for a router at 0.0.0.0"):
        Router("0.0.0.0", 0)
    with pytest.raises(ConfigError, match="Expected the address of a network card"):
        Router("eth0", 0)
    with pytest.raises(ConfigError, match=r"Expected certificates and users for a router connected to 192.168.1.9:1"):
        Router(port=0, connect=["192.168.1.9:1"])


def test_a_taken_port_is_told() -> None:
    with Router(port=(port := free_port())), pytest.raises(LinkError, match="in use"):
        Router(port=port)


def test_who_has_no_password_is_not_let_in(tmp_path: Path) -> None:
    write_certificates(tmp_path)
    lab = {name: tmp_path / file for name, file in {"ca": "lab.pem", "certificate": "bridge.pem"}.items()}
    safe = Security(**lab, key=tmp_path / "bridge.key", users=tmp_path / "users.txt")
    with Router(port=(port := free_port()), security=safe) as router:
        assert router.where == f"tls/127.0.0.1:{port}"
        viewer = Security(ca=tmp_path / "lab.pem", secret=tmp_path / "viewer.secret")
        close_session(Place(port=port, security=viewer).open_behind())
        for stranger in (Security(ca=tmp_path / "lab.pem"), Security()):
            with pytest.raises(LinkError, match="certificates and password"):
                Place(port=port, security=stranger).open_behind(0.3)


def test_routers_that_are_connected_pass_on_what_is_read() -> None:
    near, far = free_port(), free_port()
    with Router(port=far), Router(port=near, connect=[f"127.0.0.1:{far}"]):
        reader, writer, came = Place(port=near).open_behind(), Place(port=far).open_behind(), []
        rows = reader.declare_subscriber("armlab/*/*/state", lambda sample: came.append(sample.payload.to_bytes()))

        def has_come() -> bool:
            writer.put("armlab/lab1/arm/state", b"row")
            return bool(came)

        until(has_come)
        rows.undeclare()
        close_session(reader)
        close_session(writer)
    assert set(came) == {b"row"}

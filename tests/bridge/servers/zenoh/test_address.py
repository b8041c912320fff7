"""Where a lab is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.bridge.servers.zenoh.address import LAB, PORT, Place
from armlab.bridge.servers.zenoh.security import Security
from armlab.errors import ConfigError, LinkError

from .conftest import free_port


def test_urls(tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text("")
    assert Place.read("zenoh://host") == Place("host", PORT, LAB)
    assert Place.read("zenoh://host:1/a") == Place("host", 1, "a", Security())
    assert Place.read(f"zenoh://host/a?ca={tmp_path}/lab.pem").security == Security(ca=tmp_path / "lab.pem")
    for url in ("http://host", "zenoh://", "zenoh://host/a/b", "zenoh://host/*", "zenoh://host:x", "zenoh"):
        with pytest.raises(ConfigError, match="Expected a place like"):
            Place.read(url)
    with pytest.raises(ConfigError, match="Invalid IPv6"):
        Place.read("zenoh://[::1/a")
    with pytest.raises(ConfigError, match="only ca and secret"):
        Place.read("zenoh://host?seed=1")
    with pytest.raises(ConfigError, match="there is none"):
        Place.read(f"zenoh://host?secret={tmp_path}/none")


def test_nobody_there() -> None:
    with pytest.raises(LinkError, match="See whether it runs"):
        Place("127.0.0.1", free_port()).open(0.3)
    with pytest.raises(LinkError, match="Expected a Zenoh router"):
        Place(port=free_port()).open_behind(0.2)

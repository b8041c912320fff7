"""The client of the local feed where no bridge is; with one see `test_local_server`."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from armlab.bridge.servers.local import LocalFeed, cells, socket_path
from armlab.errors import LinkError


def test_what_a_killed_bridge_left_is_no_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(socket_path("test")))
    assert cells() == []
    with pytest.raises(LinkError, match="found none"):
        LocalFeed()
    with pytest.raises(LinkError, match="'test' to run"):
        LocalFeed("test")


def test_a_folder_open_to_others_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "armlab").mkdir()
    (tmp_path / "armlab").chmod(0o755)
    with pytest.raises(LinkError, match="only you"):
        socket_path("test")

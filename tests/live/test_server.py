"""The server serves the view on this computer only, prints nothing, and opens no tunnel."""

from __future__ import annotations

import logging
import sys
import urllib.request
from typing import Any

import pytest

from armlab import live
from armlab.errors import ConfigError, LinkError, MissingExtra
from armlab.live.server import HOST, address, is_own, start, stop


def test_a_view_is_served_on_this_computer_only(server: Any) -> None:
    assert server.get_host() == HOST == "127.0.0.1"
    assert address(server) == f"http://127.0.0.1:{server.get_port()}"
    with urllib.request.urlopen(address(server), timeout=10.0) as page:
        assert page.status == 200
    assert logging.getLogger("websockets.server").level == logging.CRITICAL
    with pytest.raises(ConfigError, match="local view"):
        server.request_share_url()  # also called by viser's page


def test_nothing_is_printed_and_a_port_that_is_taken_is_left_alone(
    server: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = server.get_port()
    with pytest.raises(LinkError, match=f"Expected port {port} to be free for the view, but it is in use"):
        start(port)
    monkeypatch.setattr("armlab.live.server._PORT", port)
    other = start()
    try:
        assert other.get_port() > port, "nobody asked for this one: the next will do"
    finally:
        stop(other)
    assert capfd.readouterr() == ("", "")


def test_a_page_of_another_site_sees_nothing(server: Any, page: Any) -> None:
    """A browser would let it connect, so the server must check the origin. Other programs send no origin."""
    from websockets.exceptions import ConnectionClosed

    port = server.get_port()
    foreign = ("https://example.com", "http://example.com", f"http://{HOST}", f"http://{HOST}:{port + 1}", "null")
    for origin in (*foreign, f"http://localhost:{port}"):  # asked for as 127.0.0.1, which is another site
        with page(port, origin) as one, pytest.raises(ConnectionClosed) as closed:
            one.recv(timeout=10.0)
        assert closed.value.rcvd is not None, origin
        assert closed.value.rcvd.code == 1008, origin
    for origin in (None, address(server)):
        with page(port, origin) as one:
            assert len(one.recv(timeout=10.0)) > 16


def test_origins_are_compared_with_the_server_that_was_asked() -> None:
    assert is_own([], ["localhost:8080"])
    for host in ("localhost:8080", "127.0.0.1:9000", "[::1]:8080"):  # 9000 forwarded by ssh
        assert is_own([f"http://{host}"], [host])
    for origins, hosts in (
        (["http://localhost:8888"], ["localhost:8080"]),
        (["http://example.com:8080"], ["example.com:8080"]),  # a name made to resolve to this computer
        (["http://127.0.0.1.example.com:8080"], ["127.0.0.1.example.com:8080"]),
        (["http://localhost:8080@example.com"], ["localhost:8080@example.com"]),
        (["https://localhost:8080"], ["localhost:8080"]),
        (["http://localhost:8080", "http://example.com"], ["localhost:8080"]),
        (["http://localhost:8080"], []),
        (["http://localhost:8080"], ["localhost:8080", "example.com"]),
        (["null"], ["localhost:8080"]),
        ([""], [""]),
    ):
        assert not is_own(origins, hosts), (origins, hosts)


@pytest.mark.parametrize("port", [-1, 65536, "8080", 80.0])
def test_ports_that_are_none_are_refused(port: Any) -> None:
    with pytest.raises(ConfigError, match="port from 0 to 65535"):
        live.start(port)


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtra, match=r"pip install 'armlab\[live\]'"):
        live.start(0)

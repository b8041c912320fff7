"""Server of a browser view: prints nothing to the console, and is accessible only from this computer."""

from __future__ import annotations

import contextlib
import io
import logging
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from armlab.errors import ConfigError, LinkError, MissingExtra

if TYPE_CHECKING:
    from viser import ViserServer

HOST = "127.0.0.1"
"""The only address on which the server listens."""

_OWN_PAGE = re.compile(r"http://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")  # any port, because it may be forwarded
_PORT = 8080
_WIDTH = 420  # width of the panel in pixels


def start(port: int | None = None, *, label: str = "armlab") -> ViserServer:
    """Start the server of a view and return it.

    The server listens only on 127.0.0.1, rejects pages of other sites, and blocks viser's share links, which are public
    tunnels. Make all updates of a frame inside ``with server.atomic():``.

    Parameters
    ----------
    port : port to listen on, or 0 for any free port; default: the first free port from 8080.
    label : title of the panel.

    Raises
    ------
    MissingExtra : viser is not installed.
    ConfigError : the port is outside 0 to 65535.
    LinkError : the port is in use.
    """
    if port is not None and not (isinstance(port, int) and 0 <= port < 2**16):
        raise ConfigError(f"Expected a port from 0 to 65535, got {port!r}. Use 0 for any free port.")
    try:
        import viser
    except ImportError:
        raise MissingExtra(
            "Expected the package viser for a browser view, but it is not installed. Install it: pip install "
            "'armlab[live]'."
        ) from None
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # closing the browser is not an error
    with contextlib.redirect_stdout(io.StringIO()):  # suppresses viser's banner
        server = viser.ViserServer(host=HOST, port=_PORT if port is None else port, label=label, verbose=False)
    if port and server.get_port() != port:  # viser falls back to the next free port
        stop(server)
        raise LinkError(
            f"Expected port {port} to be free for the view, but it is in use. Choose another port with --port."
        )
    _refuse_other_sites(server)
    server.request_share_url = _refused  # because a web page can also request a share link
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_WIDTH)
    return server


def address(server: ViserServer) -> str:
    """Return the address of a view, to open in a browser.

    Parameters
    ----------
    server : the server returned by `start`.
    """
    return f"http://{HOST}:{server.get_port()}"


def stop(server: ViserServer) -> None:
    """Stop the server. Browsers keep showing the last frame.

    Parameters
    ----------
    server : the server returned by `start`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def is_own(origins: Sequence[str], hosts: Sequence[str]) -> bool:
    """Return whether a connection comes from a page of this server or from a program other than a browser.

    Web pages cannot forge the Origin and Host headers. The host must be a local name, because any other domain name may
    resolve to this computer.
    """
    if not origins:
        return True
    return list(origins) == [f"http://{host}" for host in hosts] and bool(_OWN_PAGE.fullmatch(origins[0]))


def _refuse_other_sites(server: ViserServer) -> None:
    """Close connections from pages of other sites before sending data, because viser does not check the origin."""
    sockets = server._websock_server  # viser provides no public access to the request headers

    async def look(client: Any) -> None:
        connection: Any = sockets._live_connections[client.client_id]
        headers = connection.request.headers
        if not is_own(headers.get_all("Origin"), headers.get_all("Host")):
            await connection.close(1008, "Expected a page from this server.")

    sockets.on_client_connect(look)
    sockets.disconnect_all_clients()  # closes earlier connections; pages of this server reconnect


def _refused(*_: Any, **__: Any) -> NoReturn:
    raise ConfigError("Expected a local view, got a request for a public tunnel. Forward the port with ssh.")

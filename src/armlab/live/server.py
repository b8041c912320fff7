"""The browser's server: on this computer only, silent, and it never opens a way in from outside."""

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
"""The only address that is listened on."""

_OWN_PAGE = re.compile(r"http://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")  # by any port: it may be a forwarded one
_PORT = 8080
_WIDTH = 420  # pixels of the panel


def start(port: int | None = None, *, label: str = "armlab") -> ViserServer:
    """Start the server of a view and return it; nothing is printed.

    It listens on 127.0.0.1 only, and a page of another site that is open in the same browser is not let in. Share links
    of viser, public tunnels, are refused. Bundle what makes up one picture in ``with server.atomic():``.

    Parameters
    ----------
    port : to listen on, 0 for any; from 8080 on the first that is free when None.
    label : title of the panel.

    Raises
    ------
    MissingExtra : viser is not installed. ConfigError : no port from 0 to 65535. LinkError : the port is taken.
    """
    if port is not None and not (isinstance(port, int) and 0 <= port < 2**16):
        raise ConfigError(f"Expected a port from 0 to 65535, got {port!r}. 0 takes any that is free.")
    try:
        import viser
    except ImportError:
        raise MissingExtra(
            "Expected viser for a view in the browser, got none. Install it: pip install 'armlab[live]'."
        ) from None
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # a browser that closes is no news
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=HOST, port=_PORT if port is None else port, label=label, verbose=False)
    if port and server.get_port() != port:  # viser goes on to the next one
        stop(server)
        raise LinkError(f"Expected port {port} to be free for the view, but it is taken. Choose another: --port.")
    _refuse_other_sites(server)
    server.request_share_url = _refused  # its pages have a way to ask, too
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_WIDTH)
    return server


def address(server: ViserServer) -> str:
    """Return the address to open in a browser.

    Parameters
    ----------
    server : of `start`.
    """
    return f"http://{HOST}:{server.get_port()}"


def stop(server: ViserServer) -> None:
    """End the server; browsers keep their last picture.

    Parameters
    ----------
    server : of `start`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def is_own(origins: Sequence[str], hosts: Sequence[str]) -> bool:
    """Return whether a page that asks for a connection came from the server that it asks; also a program, not a page.

    A page cannot forge these headers. Its name must be one of this computer: a foreign name may lead here as well.
    """
    if not origins:
        return True
    return list(origins) == [f"http://{host}" for host in hosts] and bool(_OWN_PAGE.fullmatch(origins[0]))


def _refuse_other_sites(server: ViserServer) -> None:
    """Close connections of pages of other sites before anything is sent: viser does not look at the origin."""
    sockets = server._websock_server  # viser has no public way to the request

    async def look(client: Any) -> None:
        connection: Any = sockets._live_connections[client.client_id]
        headers = connection.request.headers
        if not is_own(headers.get_all("Origin"), headers.get_all("Host")):
            await connection.close(1008, "Expected a page of this server.")

    sockets.on_client_connect(look)
    sockets.disconnect_all_clients()  # who came in before; a page of this server tries again by itself


def _refused(*_: Any, **__: Any) -> NoReturn:
    raise ConfigError("Expected a view of this computer only: armlab opens no public tunnel. Forward the port by ssh.")

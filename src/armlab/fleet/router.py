"""`Router`: where bridges and those who read them find each other, when they are many."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from types import TracebackType

from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.zenoh import Security, close_session, open_session
from armlab.errors import ConfigError

__all__ = ["Router"]


class Router:
    """A Zenoh router in this process; a context manager.

    Parameters
    ----------
    host, port : where it listens; port 0 lets the system choose.
    connect : "HOST:PORT" of other routers, whose robots are seen through this one; they are tried for ever.
    security : certificates and users; see `bridge.zenoh.Security`.

    Attributes
    ----------
    where : address in words.

    Raises
    ------
    ConfigError : not on this computer alone, or connected to a router elsewhere, and without certificates and users:
        whoever comes could command.
    LinkError : the port is taken. MissingExtra : no Zenoh.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 7447,
        connect: Sequence[str] = (),
        security: Security | None = None,
    ) -> None:
        safe = security or Security()
        try:
            is_near = ipaddress.ip_address(host).is_loopback
        except ValueError:
            raise ConfigError(f"Expected the address of a network card to listen at, got {host!r}.") from None
        far = [f"at {host}"] if not is_near else [f"connected to {other}" for other in connect if not is_here(other)]
        if far and not safe.is_safe:
            raise ConfigError(
                f"Expected certificates and users for a router {far[0]}, since commands to robots pass through it. "
                "Write them: armlab bridge certificates; then give ca, certificate, key and users."
            )
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._session = open_session("router", [place], list(connect), safe)
        self.where = f"{'tls' if safe.ca is not None else 'tcp'}/{place}"

    def __enter__(self) -> Router:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it: those who were connected try to come again."""
        close_session(self._session)

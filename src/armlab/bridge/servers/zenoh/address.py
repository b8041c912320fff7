"""`Place`: where a lab is found, ``zenoh://HOST:PORT/LAB``, and a session that goes there."""

from __future__ import annotations

import time
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import close_session, open_session, queried, wait_for_router
from armlab.bridge.urls import split_url
from armlab.errors import ConfigError, LinkError

__all__ = ["LAB", "PORT", "Place"]

LAB = "lab"
"""Name of a lab that was given none."""

PORT = 7447
"""Where Zenoh's routers listen."""

_PATIENCE = 5.0  # s for the first connection
_TRIED = 0.1  # s between two tries to reach a router
_ANSWER = 2.0  # s for an answer
_AGAIN = 0.1  # s until it is asked again: who has just connected does not know all of those who could answer
_OPTIONS = ("ca", "secret")


class Place(NamedTuple):
    """Where a lab is found.

    Attributes
    ----------
    host, port : of a bridge or of a router. lab : its name. security : certificates and passwords.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    lab: str = LAB
    security: Security = Security()

    @classmethod
    def read(cls, url: str) -> Place:
        """Return the place of a url.

        Parameters
        ----------
        url : ``zenoh://HOST:PORT/LAB?ca=FILE&secret=FILE``; all but the host may be left out.

        Raises
        ------
        ConfigError : another form, other options, or see `Security`.
        """
        parts = split_url(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        lab = parts.path.strip("/")
        if parts.scheme != "zenoh" or not host or "/" in lab or "*" in lab:
            raise ConfigError(f"Expected a place like zenoh://192.168.1.5:7447/lab1, got {url!r}.")
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        return cls.of(host, PORT if port is None else port, {"lab": lab, **options})

    @classmethod
    def of(cls, host: str, port: int, options: dict[str, str]) -> Place:
        """Return the place of a url that was taken apart.

        Parameters
        ----------
        host, port : of a bridge or a router. options : "lab", "ca" and "secret", or some of them.

        Raises
        ------
        ConfigError : other options, or see `Security`.
        """
        unknown = sorted(set(options) - {"lab", *_OPTIONS})
        if unknown:
            raise ConfigError(f"Expected only ca and secret as options of a zenoh link, got {', '.join(unknown)}.")
        return cls(host, port, options.get("lab") or LAB, Security.of(options))

    def open(self, patience: float = _PATIENCE) -> Any:
        """Return a session there; see `session.close_session`.

        Parameters
        ----------
        patience : s to wait for whoever is there.

        Raises
        ------
        LinkError : nobody answers, or our certificate or password is not accepted. MissingExtra : no Zenoh.
        """
        where = f"{self.host}:{self.port}"
        listen = ["127.0.0.1:0"] if self.security.ca is None and self.host.startswith("127.") else []
        session = open_session("peer", listen, [where], self.security)
        if not wait_for_router(session, patience):
            close_session(session)
            secrets = "its certificates and passwords fit" if self.security.ca or self.security.secret else "it runs"
            raise LinkError(
                f"Expected a bridge or a Zenoh router at {where} within {patience:g} s, but none let us in. "
                f"See whether {secrets}."
            )
        return session

    def open_behind(self, patience: float = _PATIENCE) -> Any:
        """Return a session all of whose messages go through the router, however many robots there are.

        Parameters
        ----------
        patience : s to wait for it.

        Raises
        ------
        LinkError : nobody is there. MissingExtra : no Zenoh.
        """
        where, until = f"{self.host}:{self.port}", time.monotonic() + patience
        while True:
            try:
                return open_session("client", [], [where], self.security)
            except LinkError:
                if time.monotonic() > until:
                    raise LinkError(
                        f"Expected a Zenoh router at {where} within {patience:g} s, but none let us in. Start it: "
                        "armlab fleet router; or see whether certificates and password fit."
                    ) from None
                time.sleep(_TRIED)

    def ask(self, session: Any, selector: str, patience: float = _ANSWER) -> bytes:
        """Return the one answer to a query.

        Parameters
        ----------
        session : of `open`. selector : key. patience : s to wait.

        Raises
        ------
        LinkError : nobody answered.
        """
        until = time.monotonic() + patience
        while not (found := queried(session, selector, patience)):
            if time.monotonic() > until:
                raise LinkError(
                    f"Expected an answer to {selector} at {self.host}:{self.port}, but none came. See whether the "
                    "bridge of that robot runs and serves this lab."
                )
            time.sleep(_AGAIN)
        return found[0][1]

"""`Nodes`: which node of rmw_zenoh wrote a message, by the liveliness tokens of the graph."""

from __future__ import annotations

from collections.abc import Callable

from armlab.bridge.ros.rmw_zenoh_names import Origin, Writer

__all__ = ["Nodes"]

_MOST = 4096  # writers that are known; more are a flood


class Nodes:
    """Nodes that have writers. A message says its writer, a hash of the writer's token; the token says its node.

    All writers of a node are one client: with one it commands, with another it sets a parameter.

    Parameters
    ----------
    left : told the client whose last writer has gone.
    """

    def __init__(self, left: Callable[[str], None]) -> None:
        self._left = left
        self._clients: dict[bytes, str] = {}

    def token(self, token: str, is_there: bool) -> None:
        """Take note of a writer's token that has come or gone.

        Parameters
        ----------
        token : its key. is_there : whether it has come.
        """
        words = token.split("/")
        if len(words) < 9:
            return
        writer = Writer(token).id
        if is_there:
            if len(self._clients) < _MOST:
                self._clients[writer] = f"{words[7].replace('%', '/').rstrip('/')}/{words[8]}@{words[2]}"
        elif (client := self._clients.pop(writer, None)) is not None and client not in list(self._clients.values()):
            self._left(client)

    def client(self, origin: Origin) -> str:
        """Return who wrote a message, ``/NODE@SESSION``; the writer itself when no token of it is known.

        Parameters
        ----------
        origin : attached to the message.
        """
        return self._clients.get(origin.writer, origin.client)

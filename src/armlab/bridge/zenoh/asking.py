"""`Asking`: what bridges say of themselves, asked without waiting."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from armlab.bridge.zenoh.keys import key
from armlab.bridge.zenoh.session import zenoh

__all__ = ["Asking"]

_PERIOD = 0.5  # s between two questions to a bridge
_ANSWER = 2.0  # s for an answer


class Asking:
    """Asks "about" of bridges, each at most twice a second.

    Parameters
    ----------
    session : open. answered : told lab, robot and what was said, in a thread of Zenoh's.
    """

    def __init__(self, session: Any, answered: Callable[[str, str, bytes], None]) -> None:
        self._session, self._answered = session, answered
        self._due: dict[tuple[str, str], float] = {}

    def ask(self, lab: str, robot: str) -> None:
        """Ask when it is time to.

        Parameters
        ----------
        lab, robot : names.
        """
        now = time.monotonic()
        if now < self._due.get((lab, robot), 0.0):
            return
        self._due[lab, robot] = now + _PERIOD

        def take(reply: Any) -> None:
            if reply.ok is not None:
                self._answered(lab, robot, reply.ok.payload.to_bytes())

        with contextlib.suppress(zenoh().ZError):  # the session is being closed
            self._session.get(key(lab, robot, "about"), take, timeout=_ANSWER)

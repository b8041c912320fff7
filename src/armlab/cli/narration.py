"""What a run tells while it goes on, as messages on standard error: `Narrator`, a feed of the bridge."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from armlab.cli.output import note

if TYPE_CHECKING:
    from armlab.log import Tick
    from armlab.state import Command, State

__all__ = ["Narrator"]

_MCI_RUNNING = 3
_HOME = 0.05  # rad or m
_QUIET = logging.NullHandler()


class Narrator:
    """Writes the events of a run to standard error, and what a listener should know of the first packets.

    Parameters
    ----------
    listens : nothing is sent: an arm that waits for references is told of.
    q_home : robot name -> home posture; an arm that begins elsewhere is told of. Empty: no matter.
    """

    def __init__(self, listens: bool = False, q_home: dict[str, list[float]] | None = None) -> None:
        self._listens, self._q_home = listens, dict(q_home or {})
        self._guided: set[str] = set()
        # Without a handler Python would write the warnings of the bridge to standard error, where they stand already.
        logging.getLogger("armlab.bridge").addHandler(_QUIET)

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Look at one row.

        Parameters
        ----------
        state, command, tick : of the packet.
        """
        if self._listens and state.mci == _MCI_RUNNING and state.robot not in self._guided:
            self._guided.add(state.robot)
            note(
                f"warning: {state.robot} is in EGM guidance and waits for references. Nothing is sent here, so its "
                "controller will report 41822 and stop. To record motion by hand, let RAPID run EGMStreamStart only."
            )
        home = self._q_home.pop(state.robot, None)
        if home is None:
            return
        away = [abs(at - there) for at, there in zip(state.q.tolist(), home)]
        worst = max(range(len(away)), key=away.__getitem__)
        if away[worst] > _HOME:
            note(
                f"warning: {state.robot} does not begin in its home posture: joint {worst + 1} is {away[worst]:.2f} "
                "rad or m away. The log is as good, but a replay will begin where this one did."
            )

    def event(self, text: str, warn: bool = False) -> None:
        """Write one sentence.

        Parameters
        ----------
        text : the sentence. warn : something is wrong.
        """
        note(f"warning: {text}" if warn else text)

"""Between a loop and a LabComm server: `RowFeed` publishes rows, `Commander` is a controller that clients command."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from armlab.bridge.labcomm.channels import FusedArm
from armlab.bridge.labcomm.rows import Row
from armlab.bridge.labcomm.server import LabCommServer
from armlab.log import Tick
from armlab.state import Command, State

__all__ = ["Commander", "RowFeed"]

_LEASE = 0.1  # s after which a command is stale
_ENTRY = 0.05  # rad between the arm and the first command of a client


class RowFeed:
    """Publishes each row of a run; see `recording.Feed`. Measured torques are those that the state has.

    Parameters
    ----------
    server : where to. channels : channel by name of the robot. With a channel "fused", the newest rows of all arms are
        published there with each row of the first.
    """

    def __init__(self, server: LabCommServer, channels: Mapping[str, str]) -> None:
        self._server, self._channels = server, dict(channels)
        self._fused = "fused" in server.ports
        self._newest: dict[str, FusedArm] = {}

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Publish one row.

        Parameters
        ----------
        state : of the arm. command, tick : not used.
        """
        name = self._channels.get(state.robot)
        if name is None:
            return
        tm = state.robot_ns // 10**6 if state.robot_ns else round(1e3 * state.t)
        row = Row(tm, state.q, state.qd, state.tau)
        self._server.row(name, row)
        if self._fused:
            t_us = state.t_receive // 1000
            self._newest[name] = FusedArm(name, t_us, row)
            if name == next(iter(self._channels.values())):
                self._server.fused(t_us, list(self._newest.values()))

    def event(self, text: str, warn: bool = False) -> None:
        """Take one sentence: rows have no place for it.

        Parameters
        ----------
        text, warn : see `recording.Feed`.
        """


class Commander:
    """A controller whose commands come from the client that holds the arm; it holds while there is none.

    A client that begins, or begins again after 100 ms of silence, must do so within 0.05 rad of where the arm is.
    Pass `take` to an `ArmChannel` as `on_command`, and the object itself to ``Link.run``.

    Attributes
    ----------
    refused : commands that would have begun too far away.
    """

    def __init__(self) -> None:
        self._newest: tuple[Row, str, float] | None = None
        self._obeyed = ""
        self.refused = 0

    def take(self, name: str, row: Row, client: str) -> None:
        """Take a command; only the newest counts.

        Parameters
        ----------
        name : of the channel. row : the command. client : who holds the arm.
        """
        self._newest = (row, client, time.monotonic())

    def __call__(self, state: State) -> Command | None:
        """Return the newest command, None when it is older than 100 ms or begins too far away."""
        newest = self._newest
        if newest is None or time.monotonic() - newest[2] > _LEASE:
            self._obeyed = ""
            return None
        row, client, _ = newest
        if client != self._obeyed:
            if row.q is None or np.abs(row.q - state.q).max() > _ENTRY:
                self.refused += 1
                return None
            self._obeyed = client
        return Command(row.q, row.qd, row.tau)

"""Between a loop and a LabComm server: `RowFeed` publishes rows, `to_arbiter` passes commands on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from armlab.bridge.labcomm.channels import FusedArm, OnCommand
from armlab.bridge.labcomm.rows import Row
from armlab.bridge.labcomm.server import LabCommServer
from armlab.bridge.order import Order
from armlab.bridge.rights import Arbiter
from armlab.log import Tick
from armlab.state import Command, State

__all__ = ["RowFeed", "to_arbiter"]


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


def to_arbiter(arbiter: Arbiter, arm: str, order: Literal["abb", "chain"] = "abb") -> OnCommand:
    """Return what an `ArmChannel` calls so that its clients command an arm by the rights of an arbiter.

    Parameters
    ----------
    arbiter : the controller of the run; it must allow the server "labcomm". arm : name of the robot.
    order : of the joints on the channel, so that a refusal names the number that its client sent.
    """

    def submit(name: str, row: Row, client: str) -> None:
        arbiter.submit(Order(f"labcomm {client}", arm, row.q, row.qd, row.tau, by_axis=order == "abb"))

    return submit

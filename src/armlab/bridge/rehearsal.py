"""`Rehearsal`: the work of a cycle done once more just before the next packet, so that it finds warm caches.

A cycle that runs once in 4 ms finds cold caches and takes two to three times as long as one that runs all the time.
What is rehearsed is the loop's own code, from the datagram to the reply: a second loop, whose arm sends to itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from armlab.bridge.arm import Arm
from armlab.bridge.fusion import Fusion
from armlab.bridge.limits import Limits
from armlab.bridge.loop import Loop
from armlab.bridge.port import Arrival, Port
from armlab.bridge.session import Session
from armlab.bridge.states import Guide
from armlab.bridge.supervision import Settings
from armlab.bridge.torque import Admittance
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Codec

__all__ = ["Rehearsal"]


class Rehearsal:
    """A second loop, one packet behind the real one, that nobody listens to.

    Parameters
    ----------
    robot, limits, admittance : as in `Guide`. codec : one of its own, since it is reset with the sessions.
    port : one that sends to itself.
    """

    def __init__(
        self, robot: Robot, limits: Limits, codec: Codec, port: Port, admittance: Admittance | None = None
    ) -> None:
        softness = None if admittance is None else replace(admittance, model=None)  # the user's may remember its calls
        guide = Guide(robot, limits, capabilities=codec.capabilities, admittance=softness)
        session, settings = Session(codec, float("inf")), Settings(patience=float("inf"))
        nobody: Any = _Nobody()
        self._port, self._stage = port, _Stage()
        self._arm = Arm(robot, port, codec, session, guide, nobody, settings, 0, Fusion(()))
        self._loop = Loop([self._arm], self._stage, self._obey, settings)
        self._command: Command | None = None

    def __call__(self, arrival: Arrival, command: Command | None) -> None:
        """Do everything that the loop did with a packet.

        Parameters
        ----------
        arrival : the last packet. command : what the controller returned for it.
        """
        self._stage.arrival, self._command = arrival, command
        self._loop.cycle()
        self._port.flush()

    def _obey(self, state: State) -> Command | None:
        return self._command


class _Stage:
    """In place of `Waiting`: the packet is there."""

    arrival: Arrival

    def next(self, seconds: float) -> tuple[int, Arrival]:
        return 0, self.arrival


class _Nobody:
    """In place of a `Recording`."""

    def keep(self, *_: Any) -> None:
        """Forget a row."""

    def pass_on(self, *_: Any) -> None:
        """Nobody gets it."""

    def event(self, *_: Any, **__: Any) -> None:
        """Forget a sentence."""

    def catch_up(self) -> None:
        """Nothing waits."""

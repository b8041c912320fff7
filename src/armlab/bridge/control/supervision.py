"""When a run ends for reasons outside the controller: silence, a robot that is gone, sessions that end at once.

`Settings` of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from armlab.bridge.control.session import EGM_ERROR, Session
from armlab.bridge.control.state_machine import Mode, StateMachine
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import Port
from armlab.errors import ControllerFailed, LinkError, NoRobot, SessionEnded

_CHECKLIST_AFTER = 5.0  # s without any packet
_BRIEF = 0.1  # s under guidance: a session that ends sooner did not move the run on
_BRIEF_IN_A_ROW = 10  # end the run: `Settings.seconds` counts time under guidance, of which they have none


@dataclass(frozen=True)
class Settings:
    """How a loop runs."""

    seconds: float | None = None
    resume: bool = True
    clock: Literal["wall", "robot"] = "wall"
    patience: float = 30.0
    alive: Callable[[], str] = str  # says why the robot is gone, "" while it is not
    progress: Callable[[float], None] | None = None


class Supervisor:
    """Looks, whenever no packet came or a session begins, whether the session or the run is over."""

    def __init__(self, port: Port, session: Session, machine: StateMachine, settings: Settings, on_event: Tell) -> None:
        self._port, self._session, self._machine, self._settings = port, session, machine, settings
        self._on_event = on_event
        port.on_lost = self._stop_without_descriptors
        self._told = False
        self._elapsed, self._brief = 0.0, 0

    def check_silence(self, heard_ns: int) -> None:
        """End the session after silence, and the run when nothing more can come."""
        machine, session, now = self._machine, self._session, time.monotonic_ns()
        if session.silent(now):
            machine.lose(session.end(), self._settings.resume)
        failure = None
        try:
            gone = self._settings.alive()
        except LinkError as error:
            gone, failure = "the robot is gone", error
        quiet = 1e-9 * (now - heard_ns)
        if not gone and quiet > self._settings.patience:
            gone, failure = "no packet came", self._silence()
        if gone:
            machine.stop(gone, failure)
            session.end()
            machine.lose(gone, resume=False)
        elif quiet > _CHECKLIST_AFTER and not session.number and not self._told:
            self._told = True
            self._on_event(f"No packet yet. {check_list(self._port)}", warn=True)

    def judge(self) -> None:
        """End the run when too many sessions in a row ended at once. Called before the machine observes another one.

        Without guidance a robot may wait for its operator, and such a session does not count; in lockstep nobody comes.
        """
        machine, session = self._machine, self._session
        gained, self._elapsed = machine.elapsed - self._elapsed, machine.elapsed
        if gained >= _BRIEF:
            self._brief = 0
        elif (
            machine.guided
            or machine.mode is Mode.LISTENING
            or session.reason == EGM_ERROR
            or self._settings.clock == "robot"
        ):
            self._brief += 1
        if self._brief >= _BRIEF_IN_A_ROW:
            kind = "packets" if machine.mode is Mode.LISTENING else "guidance"
            failure = SessionEnded(
                f"Expected a session with {kind} for {_BRIEF:g} s or more, but {self._brief} in a row ended sooner, "
                f"the last because {session.reason}. The event log of the robot's controller says more; a usual cause "
                "is a reference that it refuses, too far away or too fast."
            )
            machine.stop("sessions ended at once", failure)

    def _stop_without_descriptors(self) -> None:
        """Bring the arm to rest over the socket that was bound again."""
        self._machine.stop(
            "file descriptors were closed",
            ControllerFailed(
                "The controller, or other code in this process, closed file descriptors that it had not opened, the "
                "bridge's socket among them. The arm was stopped. Close only the files that the controller opens."
            ),
        )

    def _silence(self) -> LinkError:
        session, seconds = self._session, self._settings.patience
        if session.number:
            return SessionEnded(f"Expected another packet within {seconds:g} s, but none came: {session.end()}.")
        others = ", ".join(f"{number} {kind}" for kind, number in session.drops.items())
        heard = f" Datagrams that are no packets of a robot came: {others}." if others else ""
        return NoRobot(
            f"Expected packets from a robot within {seconds:g} s, but none came.{heard} {check_list(self._port)}"
        )


def check_list(port: Port) -> str:
    """Return what to check when no packet comes, in sentences."""
    loopback = " That address hears programs on this computer only." if port.host.startswith("127.") else ""
    return (
        f"Listening on {port.host}:{port.port}.{loopback} Check that the controller's UDPUC device has this computer's "
        f"address and port {port.port}, that RAPID runs EGMStreamStart or EGMRunJoint, and that no firewall drops UDP."
    )

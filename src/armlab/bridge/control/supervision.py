"""`Supervisor`, which ends a run after silence, robot loss or very short sessions; `Settings` of a run."""

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
_BRIEF = 0.1  # s under guidance: a shorter session does not advance the run
_BRIEF_IN_A_ROW = 10  # consecutive short sessions that end the run, because `Settings.seconds` counts only guidance


@dataclass(frozen=True)
class Settings:
    """Settings of a control loop."""

    seconds: float | None = None
    resume: bool = True
    clock: Literal["wall", "robot"] = "wall"
    patience: float = 30.0
    alive: Callable[[], str] = str  # returns why the robot was lost, "" while it is running
    progress: Callable[[float], None] | None = None


class Supervisor:
    """Detects the end of sessions and of the run; called after silence and at the beginning of a session."""

    def __init__(self, port: Port, session: Session, machine: StateMachine, settings: Settings, on_event: Tell) -> None:
        self._port, self._session, self._machine, self._settings = port, session, machine, settings
        self._on_event = on_event
        port.on_lost = self._stop_without_descriptors
        self._reported = False
        self._elapsed, self._brief = 0.0, 0

    def check_silence(self, last_packet_ns: int) -> None:
        """End the session when packets stop, and end the run if the robot is lost or sends no packet for longer than
        the patience period."""
        machine, session, now = self._machine, self._session, time.monotonic_ns()
        if session.silent(now):
            machine.lose(session.end(), self._settings.resume)
        try:
            lost, failure = self._settings.alive(), None
        except LinkError as error:
            lost, failure = "the robot is lost", error
        quiet = 1e-9 * (now - last_packet_ns)
        if not lost and quiet > self._settings.patience:
            lost, failure = "no packet arrived", self._silence()
        if lost:
            machine.stop(lost, failure)
            session.end()
            machine.lose(lost, resume=False)
        elif quiet > _CHECKLIST_AFTER and not session.number and not self._reported:
            self._reported = True
            self._on_event(f"No packet yet. {check_list(self._port)}", warn=True)

    def judge(self) -> None:
        """End the run after too many consecutive short sessions; called before a new session is observed.

        Sessions without guidance are usually not counted as short sessions, because the robot may be waiting for its
        operator. Sessions without guidance count only in listening or lockstep runs, or after an EGM error.
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
                f"Expected a session with {kind} for {_BRIEF:g} s or more, got {self._brief} consecutive shorter "
                f"sessions; the last session ended because {session.reason}. Read the event log of the robot "
                "controller; a common cause is a reference that was rejected as too far away or too fast."
            )
            machine.stop("sessions ended immediately", failure)

    def _stop_without_descriptors(self) -> None:
        """Bring the arm to rest through the re-bound socket."""
        self._machine.stop(
            "file descriptors were closed",
            ControllerFailed(
                "The controller or other code in this process closed file descriptors that it had not opened, "
                "including the socket of the bridge. The arm was stopped. Close only files that the controller opens."
            ),
        )

    def _silence(self) -> LinkError:
        session, seconds = self._session, self._settings.patience
        if session.number:
            return SessionEnded(f"Expected another packet within {seconds:g} s, got no packet: {session.end()}.")
        others = ", ".join(f"{number} {kind}" for kind, number in session.drops.items())
        received = f" Other datagrams arrived: {others}." if others else ""
        return NoRobot(
            f"Expected packets from a robot within {seconds:g} s, got no packet.{received} {check_list(self._port)}"
        )


def check_list(port: Port) -> str:
    """Return advice for a port at which no packet arrives."""
    loopback = " This address receives packets only from this computer." if port.host.startswith("127.") else ""
    return (
        f"Listening on {port.host}:{port.port}.{loopback} Check that the UDPUC device of the controller has this "
        f"computer's address and port {port.port}, that RAPID runs EGMStreamStart or EGMRunJoint, and that no "
        "firewall drops UDP packets."
    )

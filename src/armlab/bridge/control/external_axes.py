"""`ExternalReferences`: limited references for external axes, and RAPID data to send."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.bridge.control.feedback import READY_AFTER
from armlab.bridge.control.limits import Limiter, Limits, Reply, numbers
from armlab.errors import CommandRefused
from armlab.state import Command
from armlab.wire.egm import Beside, Packet

_MOST_DATA = 40  # maximum number of values in EgmRAPIDdata
_OUTSIDE, _STEP, _FASTER = 0.1, 0.02, 2.0  # as in `feedback`
_KNOWS_DATA = "7"  # RobotWare version that supports RAPID data


class ExternalReferences:
    """Computes the references of the external axes and the RAPID data for each packet.

    The first `Command.q_ext` of a session enables the axes. Each later reply contains a reference for these axes,
    because the robot controller would otherwise keep the last reference, including its speed. RAPID data are sent once.
    """

    moves: bool

    def __init__(self, limits: Limits | None, capabilities: frozenset[str]) -> None:
        self._limits, self._capabilities = limits, capabilities
        self._limiter = None if limits is None else Limiter(limits)
        self.begin()

    @property
    def at_rest(self) -> bool:
        return not self.moves or self._limiter is None or self._limiter.at_rest

    @property
    def memory(self) -> tuple[bool, bool, Any]:
        """State of the limiter, which is restored if a reply is not sent."""
        return self.moves, self._entered, None if self._limiter is None else self._limiter.memory

    @memory.setter
    def memory(self, memory: tuple[bool, bool, Any]) -> None:
        """Restore a state of the limiter."""
        self.moves, self._entered, sent = memory
        if self._limiter is not None:
            self._limiter.memory = sent

    def begin(self) -> None:
        """Begin a session with disabled axes."""
        self.moves = self._entered = False
        self._plausible, self._since = 0, 0.0
        self._q: np.ndarray | None = None

    def observe(self, packet: Packet, dt: float) -> str:
        """Check the feedback; return an error message for the first of several consecutive implausible packets,
        otherwise "".

        Implausible feedback must never become a reference.
        """
        limits, q = self._limits, packet.q_ext
        if limits is None or q.shape != limits.q_min.shape:
            return ""
        self._since += dt
        reach = _STEP + _FASTER * limits.qd_max * self._since
        false = not ((q >= limits.q_min - _OUTSIDE) & (q <= limits.q_max + _OUTSIDE)).all()
        if false or (self._q is not None and (np.abs(q - self._q) > reach).any()):
            first, self._plausible = self._plausible > 0, 0
            what = f"Expected external axes within their position and speed limits, got feedback of {q}."
            return f"{what} This feedback is ignored." if first else ""
        self._plausible, self._q, self._since = self._plausible + 1, q, 0.0
        return ""

    def rest(self, packet: Packet) -> Beside | None:
        """Return the measured positions as the external references, for a robot that does not follow references.

        The next commanded position must be near the measured positions. If the limits are for a different number of
        axes, the axes are disabled.
        """
        self._entered = False
        if not self.moves or self._limiter is None or self._q is None or packet.q_ext.shape != self._limiter.q.shape:
            self.moves = False
            return None
        reply = self._limiter.rest(self._q)
        return Beside(reply.q, reply.qd)

    def hold(self, dt: float, longest: float) -> Beside | None:
        """Return references that bring the axes to rest, without RAPID data; see `Limiter.step`."""
        if not self.moves or self._limiter is None:
            return None
        reply = self._limiter.hold(dt, longest)
        return Beside(reply.q, reply.qd)

    def follow(self, command: Command, packet: Packet, dt: float, longest: float) -> Beside | None:
        if command.rapid_data is None and command.rapid_digital is None and command.q_ext is None:
            return self.hold(dt, longest)
        data = self._data(command, packet)
        q_ext = command.q_ext
        moved = self.hold(dt, longest) if q_ext is None else self._moved(q_ext, packet, dt, longest)
        return (moved or Beside())._replace(rapid_data=data, rapid_digital=command.rapid_digital)

    def _data(self, command: Command, packet: Packet) -> np.ndarray | None:
        if command.rapid_data is None and command.rapid_digital is None:
            return None
        if "rapid_data" not in self._capabilities or packet.robotware != _KNOWS_DATA:
            got = (
                f"RobotWare {packet.robotware}"
                if "rapid_data" in self._capabilities
                else "a codec that cannot send RAPID data"
            )
            raise CommandRefused(
                f"Expected no rapid_data or rapid_digital in the Command: they require RobotWare 7, but this is {got}."
            )
        digital = command.rapid_digital
        if digital is not None and not isinstance(digital, bool | np.bool_):
            raise CommandRefused(f"Expected True, False or None in Command.rapid_digital, got {digital!r}.")
        if command.rapid_data is None:
            return None
        data = _numbers("rapid_data", command.rapid_data)
        if data.ndim != 1 or len(data) > _MOST_DATA:
            raise CommandRefused(
                f"Expected a vector of at most {_MOST_DATA} numbers in Command.rapid_data, got shape {data.shape}."
            )
        return data

    def _moved(self, q_ext: Any, packet: Packet, dt: float, longest: float) -> Beside:
        limiter, limits, measured = self._limiter, self._limits, packet.q_ext
        if "external_axes" not in self._capabilities:
            raise CommandRefused("Expected no q_ext in the Command: the codec of this link cannot send external axes.")
        if limits is None or limiter is None:
            raise CommandRefused(
                "Expected no q_ext in the Command, because the limits of the external axes are unknown. "
                "Run with limits=Limits.of(robot, external=Limits.of_axes(q_min, q_max, qd_max))."
            )
        wanted = _numbers("q_ext", q_ext)
        if not wanted.shape == measured.shape == limits.q_min.shape:
            raise CommandRefused(
                f"Expected {len(measured)} values in Command.q_ext and in the limits, one per external axis of the "
                f"robot, got shape {wanted.shape} and limits of {len(limits.q_min)}."
            )
        if not self._entered:
            if self._plausible < READY_AFTER or self._q is None:
                raise CommandRefused(
                    f"Expected the external axes to report positions within their limits, {limits.q_min} to "
                    f"{limits.q_max}, three times in a row before they are moved, got {measured}."
                )
            if not self.moves:
                limiter.rest(self._q)
            held = limiter.q
            far = np.flatnonzero(np.abs(wanted - held) > limits.entry)
            if len(far):
                k = int(far[0])
                raise CommandRefused(
                    f"Expected the first position of external axis {k + 1} within {limits.entry[k]:g} of its current "
                    f"position, {held[k]:.4f}, got {wanted[k]:.4f}. Begin at state.q_ext."
                )
            self.moves = self._entered = True
        before, memory = limiter.q, limiter.memory
        reply = limiter.step(wanted, None, dt, longest)
        if reply.refused:
            limiter.memory = memory  # this reply is not sent, so the hold continues from the previous reply
            k = abs(reply.refused) - 1
            raise CommandRefused(
                f"Expected a position of external axis {k + 1} near the last position sent, {before[k]:.4f}, got "
                f"{wanted[k]:.4f}. Move there gradually."
            )
        return Beside(reply.q, reply.qd)


def joined(reply: Reply, beside: Beside | None) -> Reply:
    return reply if beside is None else reply._replace(beside=beside)


def _numbers(name: str, values: Any) -> np.ndarray:
    try:
        array = np.array(numbers(values), dtype=np.float64)
    except Exception as error:  # a controller may return anything
        raise CommandRefused(f"Expected numbers in Command.{name}, got {values!r} ({error}).") from error
    if not np.isfinite(array).all():
        raise CommandRefused(f"Expected finite numbers in Command.{name}, got {array}. NaN is never sent to a robot.")
    array.flags.writeable = False
    return array

"""Whether a robot follows references: motors, RAPID and guidance."""

from __future__ import annotations

from armlab.wire.egm import Packet

__all__ = ["MCI_RUNNING", "Readiness", "obstacle"]

MCI_RUNNING = 3
"""State of EGM while it guides."""

_MOTORS_ON = 1
_RAPID_MOVES = (0, 2)  # undefined (0) stays after a restart of the controller although RAPID runs
_ABSENT = 3  # packets in a row without a state count


def obstacle(motors: int, rapid: int, mci: int) -> str:
    """Return why the robot would not follow a reference, "" when it would; states as in a `Packet`."""
    if motors != _MOTORS_ON:
        return "the motors are off" if motors else "its packets have no state of the motors"
    if rapid not in _RAPID_MOVES:
        return "RAPID is stopped"
    return "" if mci == MCI_RUNNING else "guidance has not begun (EGMRunJoint)"


class Readiness:
    """The states of the newest packets; one or two packets without a state do not end a motion.

    Attributes
    ----------
    is_unknown : packets without a state have followed a robot that was ready.
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget the session before."""
        self._motors = self._mci = self._absent = 0
        self.is_unknown = False

    def obstacle(self, packet: Packet) -> str:
        """Return why the robot would not follow a reference, "" when it would."""
        absent = not (packet.motors and packet.mci)
        self._absent = self._absent + 1 if absent else 0
        if self._absent in range(1, _ABSENT):
            return obstacle(packet.motors or self._motors, packet.rapid, packet.mci or self._mci)
        was_ready = not obstacle(self._motors, packet.rapid, self._mci)
        self.is_unknown = absent and (self.is_unknown or was_ready)
        self._motors, self._mci = packet.motors, packet.mci
        return obstacle(packet.motors, packet.rapid, packet.mci)

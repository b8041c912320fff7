"""`zenoh://host:7447/lab` as a link: `ZenohPort` and `ZenohCodec` let the loop run on another computer than the bridge.

The loop sees rows of the bridge as it sees packets of EGM; each is answered by one command.
"""

from __future__ import annotations

import secrets
import time
from typing import Any, cast

import numpy as np

from armlab.bridge.net.sockets import Arrival, Port, pair
from armlab.bridge.servers.row import RowsAsPackets, RowSchema, clock_ms, read_row
from armlab.bridge.servers.zenoh.messages import Attachment, Gaps, key, undamaged
from armlab.bridge.servers.zenoh.session import LabAddress, close_session, zenoh
from armlab.errors import ArmlabError, LinkError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm import Codec, Drop, Packet, Reference

_LARGEST = 2**14
_DAMAGED = b"damaged"  # in place of a row that was
_USED = (
    *("q", "qd", "tau", "q_planned", "q_ext", "seq", "robot_ns", "session_t", "T_frame_tool", "wrench_raw"),
    *("motors", "mci", "rapid", "converged", "utilization"),
)


def far_end(robot: Robot, host: str, port: int, options: dict[str, str]) -> tuple[Port, Codec]:
    """Return the port and codec of an arm behind a Zenoh server."""
    end = ZenohPort(robot, LabAddress.of(host, port, options))
    return cast(Port, end), ZenohCodec(robot, end.schema)


class ZenohPort:
    """Rows of an arm in place of datagrams; never blocks and never raises after construction.

    Zenoh connects again by itself. Rows come in a thread of Zenoh's, which hands them over by a socket.
    """

    def __init__(self, robot: Robot, place: LabAddress) -> None:
        self.host, self.port, self.errors = place.host, place.port, 0
        self._session = place.open()
        self._seq, self._sender = 0, secrets.token_bytes(16)
        try:
            self.schema = RowSchema.read(place.ask(self._session, key(place.lab, robot.name, "schema")))
            _check(self.schema, robot)
        except ArmlabError:
            close_session(self._session)
            raise
        self.gaps = Gaps(self.schema, robot.name)
        self._inner, self._outer = pair()
        self._outer.setblocking(False)
        drop = zenoh().CongestionControl.DROP
        self._commands = {
            kind: self._session.declare_publisher(
                key(place.lab, robot.name, f"command/{kind}"), congestion_control=drop, express=True
            )
            for kind in ("position", "motion")
        }
        self._n = robot.n
        self._rows = self._session.declare_subscriber(key(place.lab, robot.name, "live"), self._take)

    def fileno(self) -> int:
        return self._outer.fileno()

    def close(self) -> None:
        close_session(self._session)
        self._inner.close()
        self._outer.close()

    def receive(self) -> Arrival | None:
        """Return the next row, or None when there is none."""
        try:
            data = self._outer.recv(_LARGEST)
        except OSError:
            return None
        return Arrival(data, (self.host, self.port), time.monotonic_ns()) if data else None

    def flush(self) -> None:
        """Throw away rows that came while nobody listened."""
        for _ in range(4000):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one command; return whether Zenoh took it."""
        self._seq += 1
        kind = "position" if len(data) == 8 * self._n else "motion"
        try:
            self._commands[kind].put(data, attachment=Attachment(self._sender, self._seq, time.time_ns()).pack())
        except zenoh().ZError:
            self.errors += 1
            return False
        return True

    def _take(self, sample: Any) -> None:
        data = undamaged(sample) or _DAMAGED
        if data[8:16] == self.schema.id and len(data) == self.schema.size:
            self.gaps.take(data)
        try:
            self._inner.send(data)
        except OSError:  # full: the loop does not look; or closed
            self.errors += 1


class ZenohCodec(RowsAsPackets):
    """Rows as packets of the loop."""

    def __init__(self, robot: Robot, schema: RowSchema) -> None:
        super().__init__()
        _check(schema, robot)
        self._name, self._schema = robot.name, schema

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet of a row, or why it is dropped."""
        if data == _DAMAGED:
            return Drop("damaged", "a row whose checksum is another one")
        try:
            values = read_row(self._schema, data).values
        except LinkError as error:
            return Drop("unparsable", str(error))
        one = {name: values[f"{self._name}.{name}"] for name in _USED}
        tm_ms = clock_ms(one["robot_ns"], one.pop("session_t"))
        if tm_ms is None:
            return Drop("not finite", "the time of a row")
        q_ext = one.pop("q_ext")
        return self._packet(
            seqno=one.pop("seq") % 2**32,
            tm_ms=tm_ms % 2**32,
            q_ext=q_ext[np.isfinite(q_ext)],
            converged=one.pop("converged") == 1,
            **one,
        )

    def encode(self, ref: Reference) -> bytes:
        """Return positions, or positions and velocities, as they go out."""
        parts = [ref.q] if ref.qd is None else [ref.q, ref.qd]
        return np.concatenate(parts).astype("<f8").tobytes()


def _check(schema: RowSchema, robot: Robot) -> None:
    """Refuse rows without this arm, or with another one of its name."""
    if robot.name not in schema.robots:
        raise UnknownName.among("robot of the bridge", robot.name, schema.robots)
    schema.require(robot)

"""`ReplyQueue`: messages of the peer: matched with the packets they answer, checked and queued.

Replies are matched with packets by the sequence number that the research extension echoes, else by the `tm` of the
header, else by order. By order is right only for a peer that answers every packet. Several packets of one millisecond
share their `tm`: the oldest of them without an answer is meant.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import Statistics
from armlab.wire.egm import Drop
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage
from armlab.wire.egm.types import StandingQueue

QUEUE_LENGTH = 64
"""Messages that wait; more are dropped. The packets that a reply can be matched with are as many."""

_CONTENT = {
    "joint": ("q", "no joints", "joint references"),
    "pose": ("T_frame_tool", "no pose", "a pose"),
    "path": ("path_yz", "no path correction", "a path correction"),
}


@dataclass(slots=True)
class Sent:
    """A packet that can be answered: number, `tm`, cycle, whether in guidance, clock just before sending [ns]."""

    seq: int
    tm_ms: int
    cycle: int
    guiding: bool
    stamp_ns: int = 0
    answered: bool = False


class ReplyQueue:
    """Queue of replies of one motion task, bounded, in the order that the settings ask for."""

    def __init__(self, codec: RobotSideCodec, statistics: Statistics, settings: ControllerSettings) -> None:
        self._codec, self._statistics = codec, statistics
        self._field, self._missing, self._wanted = _CONTENT[settings.mode]
        self._takes_newest, self._period = settings.queue == "newest", settings.period
        self.begin()

    def __len__(self) -> int:
        return len(self._queue)

    def begin(self) -> None:
        """Forget everything: a new session."""
        self._queue: deque[tuple[SensorMessage, int | None]] = deque()
        self._sent: deque[Sent] = deque(maxlen=QUEUE_LENGTH)
        self._standing = StandingQueue()
        self._ordered = -1  # number of the packet that the last reply without an echo answered
        self._last_seqno: int | None = None

    def note(self, sent: Sent) -> None:
        """Remember a packet that was built."""
        self._sent.append(sent)

    def stamp(self, nanoseconds: int, uptime: float) -> None:
        """Note when the newest packet left, by the wall clock [ns] and in robot time [s].

        A reply to the packet before it that has not arrived by now is late or missing.
        """
        if self._sent:
            self._sent[-1].stamp_ns = nanoseconds
        if len(self._sent) > 1 and self._sent[-2].guiding and not self._sent[-2].answered:
            self._statistics.miss(uptime)

    def read(self, data: bytes, count: bool = True) -> SensorMessage | Drop:
        """Decode a datagram; return the message, or the reason why it is not valid in this mode."""
        found = self._codec.decode_sensor(data)
        if isinstance(found, SensorMessage):
            self._statistics.mtypes[found.mtype] += count
            if getattr(found, self._field) is None:
                return Drop(self._missing, f"a message without {self._wanted}, which this mode needs")
        return found

    def match(self, message: SensorMessage, arrival_ns: int, uptime: float) -> Sent | None:
        """Return the packet that a message answers, or None; count duplicates and round trips. Arrival 0 is unknown."""
        counts = self._statistics.counts
        counts["duplicates"] += message.seqno is not None and message.seqno == self._last_seqno
        self._last_seqno = message.seqno
        how, sent = self._find(message)
        if sent is None or sent.answered:
            return sent
        counts[f"matched by {how}"] += 1
        sent.answered = True
        if sent.stamp_ns and arrival_ns:
            self._statistics.trip(1e-9 * (arrival_ns - sent.stamp_ns), uptime)
        return sent

    def put(self, message: SensorMessage, cycle: int | None) -> bool:
        """Append a message and the cycle of the packet it answers, if known. Return False when the queue is full."""
        if len(self._queue) >= QUEUE_LENGTH:
            return False
        self._queue.append((message, cycle))
        return True

    def take(self, cycle: int) -> SensorMessage | None:
        """Return the next message, or None, and note its age. Mode newest drops all messages before it."""
        self._statistics.queue[len(self._queue)] += 1
        if not self._queue:
            return None
        if self._takes_newest:
            self._statistics.counts["overtaken"] += len(self._queue) - 1
            self._queue = deque([self._queue[-1]])
        message, asked = self._queue.popleft()
        if asked is not None:
            self._statistics.last_age = cycle - asked
            self._statistics.age[cycle - asked] += 1
        return message

    def standing(self) -> str:
        """Return a sentence when the queue has not been empty for 1 s, "" otherwise. Call it once per cycle."""
        return self._standing.after(len(self._queue), self._period)

    def _find(self, message: SensorMessage) -> tuple[str, Sent | None]:
        if message.echo_mono_ns or message.echo_seq:
            return "echo", next((sent for sent in reversed(self._sent) if sent.seq == message.echo_seq), None)
        if message.tm_ms:  # abb_libegm sends 0, the Python clients nothing
            same = [sent for sent in self._sent if sent.tm_ms == message.tm_ms]
            return "tm", next((sent for sent in same if not sent.answered), same[-1] if same else None)
        if self._ordered < 0:  # the first reply of a session may come late; the last packet built may not have left
            left = [sent.seq for sent in self._sent if sent.stamp_ns]
            self._ordered = left[-1] - 1 if left else -1
        self._ordered += 1
        return "order", next((sent for sent in self._sent if sent.seq == self._ordered), None)

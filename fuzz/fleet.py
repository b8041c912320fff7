"""Data from remote bridges over Zenoh: descriptions, texts, rows."""

from __future__ import annotations

import contextlib
import json
import struct
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from armlab import robots
from armlab.bridge.servers.row import RowSchema, RowWriter, beginning
from armlab.bridge.servers.zenoh.feed import ZenohCodec, ZenohFeed, ZenohPort
from armlab.bridge.servers.zenoh.messages import Gaps, Inbox, checksum, read_about
from armlab.errors import ArmlabError, LinkError
from armlab.fleet.discovery import _Seen
from armlab.fleet.recorder import RobotRecord
from armlab.live.fleet_view import SeenRobot, _words
from armlab.live.live_bridge import Running
from armlab.log import Tick
from armlab.robots import Robot, to_toml
from armlab.state import State
from armlab.wire.egm import Packet

__all__ = ["fleet", "seeds"]

_NAME = "yumi_left"
_FOLDER = tempfile.TemporaryDirectory(prefix="armlab-fuzz-")


@cache
def _arm() -> Robot:
    return robots.load(_NAME)


@cache
def _schema() -> RowSchema:
    return RowSchema.of([_arm()])


def fleet(data: bytes) -> None:
    """Answer to "about", text and row, separated by NUL; every reader must accept or reject them cleanly.

    The row is also read with the schema in the answer or, if there is none, with the schema of the arm.
    """
    about, _, rest = data.partition(b"\0")
    text, _, row = rest.partition(b"\0")
    schema = _schema()
    with contextlib.suppress(ArmlabError):
        schema = read_about(about).schema
    whole = (beginning(schema) + row[16:].ljust(schema.size, b"\0"))[: schema.size]
    for read in (_viewed, _listed, _recorded, _monitored):
        read(about, text, [row, whole])
    _driven(schema, [row, whole])


def _viewed(about: bytes, text: bytes, rows: list[bytes]) -> None:
    seen = SeenRobot(f"lab1/{_NAME}")
    seen.live(True)
    seen.describe(about)
    seen.status(text)
    for row in rows:
        seen.take(row)
        if seen.robot is not None and seen.value("q") is not None:
            assert seen.value("q").shape == (seen.robot.n,)
    assert all(isinstance(word, str) for word in _words(seen))
    seen.status(about)
    seen.describe(text)


def _listed(about: bytes, text: bytes, rows: list[bytes]) -> None:
    seen = _Seen("lab1", _NAME)
    for said in (text, about):
        seen.describe(said)
        for row in rows:
            seen.take(row)
    seen.summary()


def _recorded(about: bytes, text: bytes, rows: list[bytes]) -> None:
    record = RobotRecord(f"lab1/{_NAME}", Path(_FOLDER.name) / "a.mcap", lambda sentence: None)
    for row in rows:
        record.take(row)
    for said in (text, about):
        record.write()
        record.describe(said)
    record.close()
    for path in record.paths:
        path.unlink()


class _Bytes(bytes):
    def to_bytes(self) -> bytes:
        """Return the bytes, as in Zenoh's own type."""
        return bytes(self)


def _sample(data: bytes) -> Any:
    return SimpleNamespace(payload=_Bytes(data), attachment=_Bytes(checksum(data)))


def _monitored(about: bytes, text: bytes, rows: list[bytes]) -> None:
    feed, schema = object.__new__(ZenohFeed), _schema()  # without a session
    feed._messages, feed._next, feed._schema = Inbox(100), None, schema
    feed._gaps = {_NAME: Gaps(schema, _NAME)}
    feed._patience, feed._gone, feed._pace, feed._run, feed._is_unsure = 0.0, None, None, "", True
    feed.cell, feed.damaged, feed.lost, feed.refused = "", 0, 0, 0
    running = Running()
    for said in (text, about):
        feed._is_unsure = True
        feed._answered("lab1", _NAME, said)
        feed._take_text(SimpleNamespace(payload=_Bytes(said)))
        feed._is_unsure, feed._pace = False, None
        for row in rows:
            feed._take_row(_sample(row))
        while feed.wait(0.0):
            with contextlib.suppress(LinkError):  # only rows with a different schema were queued
                running._take(feed.receive())
        assert all(isinstance(line, str) for line in (*running.watch.lines(0), *running.watch.notes()))


def _driven(schema: RowSchema, rows: list[bytes]) -> None:
    try:
        codec = ZenohCodec(_arm(), schema)
    except ArmlabError:
        return
    port = object.__new__(ZenohPort)
    port.schema, port.gaps, port.errors = schema, Gaps(schema, _NAME), 0
    port._inner = SimpleNamespace(send=lambda data: None)  # type: ignore[assignment]
    for row in rows:
        port._take(_sample(row))
        packet = codec.decode(row)
        if isinstance(packet, Packet):
            assert np.isfinite(packet.q).all()
            assert packet.tm_ms is not None
            assert 0 <= packet.tm_ms < 2**32


def seeds() -> Iterator[tuple[str, str, bytes]]:
    """Yield seed inputs: target, name, input."""
    said = {"kind": "about", "run": "a", "cell": "c", "schema": _schema().text.decode()}
    about = json.dumps([{**said, "robots": {_NAME: to_toml(_arm())}}, {"kind": "recording", "files": ["a"]}]).encode()
    arm = {"rate": 249.5, "p50": 90.0, "p99": None, "missed": 1, "late": 0, "drops": 2, "clamps": {"position": [1, 0]}}
    q = np.linspace(-0.3, 0.3, _arm().n)
    state = State(t=1.5, dt=0.004, q=q, qd=q, tau=q, robot=_NAME)
    row = RowWriter(_schema()).row(state, None, Tick(3, -1, 10**18, 10**18, -1, 0), 10**18)
    late = bytearray(row)
    struct.pack_into("<d", late, _schema().fields[f"{_NAME}.session_t"].offset, 1.7e308)
    status = b'{"kind": "status", "lost": 2, "arms": {"yumi_left": %s}}'
    for name, text, last in (
        ("status", status % json.dumps(arm).encode(), row),
        ("event", b'{"kind": "event", "stamp_ns": 1000000000, "text": "Hello."}', bytes(late)),
    ):
        yield "fleet", name, about + b"\0" + text + b"\0" + last
    for name, text in (
        ("infinity", status % b'{"missed": Infinity}'),
        ("number_of_400_digits", status % (b'{"rate": 1%s}' % (b"0" * 400))),
        ("brackets", b"[" * 3000),
        ("number", b"5"),
        ("no_kind", b"{}"),
    ):
        yield "fleet", name, b"[]\0" + text + b"\0" + row[:64]

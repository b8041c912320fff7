"""What goes out only while somebody reads it."""

from __future__ import annotations

from typing import Any

from armlab.bridge.servers.zenoh.publisher import Output, Waiting
from armlab.bridge.servers.zenoh.session import close_session, open_session

from .conftest import free_port, until


def test_nothing_is_sent_to_nobody_and_a_waiting_output_counts_what_found_no_room() -> None:
    port = free_port()
    router = open_session("router", [f"127.0.0.1:{port}"])
    reader = open_session("peer", ["127.0.0.1:0"], [f"127.0.0.1:{port}"])
    seen: list[int] = []
    outputs = [Output(router, "a", lambda: seen.append(len(seen))), Waiting(router, "b")]
    for one in outputs:
        one.put(b"nobody")
        assert (one.wanted, one.sent, one.dropped) == (False, 0, 0)
    samples: list[Any] = []
    subscribers = [reader.declare_subscriber(name, samples.append) for name in "ab"]
    until(lambda: all(one.wanted for one in outputs) and seen == [0])
    for one in outputs:
        one.put(b"1", b"attached")
    until(lambda: len(samples) == 2)
    assert [one.attachment.to_bytes() for one in samples] == [b"attached", b"attached"]
    assert [one.sent for one in outputs] == [1, 1]
    for one in subscribers:
        one.undeclare()
    until(lambda: not any(one.wanted for one in outputs) and seen == [0, 1])
    waiting = outputs[1]
    assert isinstance(waiting, Waiting)
    waiting.close()
    waiting.wanted = True
    for _ in range(2501):
        waiting.put(b"2")
    assert (waiting.sent, waiting.dropped) == (1, 1)
    close_session(reader)
    close_session(router)

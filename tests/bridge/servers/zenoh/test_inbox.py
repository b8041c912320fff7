"""`Inbox`: what waits is bounded in number and in bytes."""

from __future__ import annotations

import threading

import pytest

from armlab.bridge.servers.zenoh.rows import Inbox

from .conftest import PATIENCE


def test_the_oldest_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.rows._LARGEST", 10_000)
    inbox: Inbox[int] = Inbox(5)
    for number in range(8):
        inbox.put(number)
    assert [inbox.get() for _ in range(6)] == [3, 4, 5, 6, 7, None]
    for number in range(4):
        inbox.put(number, 4000)
    assert [inbox.get() for _ in range(3)] == [2, 3, None]
    inbox.put(9, 10**9)  # one message is always kept
    assert (len(inbox), inbox.get(), inbox._size) == (1, 9, 0)


def test_who_waits_is_woken() -> None:
    inbox: Inbox[str] = Inbox(5)
    assert not inbox.wait(0.0)
    assert inbox.get(0.01) is None
    sender = threading.Timer(0.05, inbox.put, ["came"])
    sender.start()
    assert inbox.wait(PATIENCE)
    assert inbox.get(PATIENCE) == "came"
    sender.join()

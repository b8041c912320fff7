"""What a client hears of, by its level."""

from __future__ import annotations

import json

from armlab.bridge.servers.rosbridge.session import Session, Setting


def heard(session: Session) -> list[dict[str, object]]:
    return [json.loads(one) for one in session.outbox.take(10**6)]


def test_errors_by_default_and_the_rest_as_asked() -> None:
    session = Session("me", may_ask=True)

    def levels() -> list[object]:
        for level in ("info", "warning", "error"):
            session.status(level, "text", 0)
        return [one["level"] for one in heard(session)]

    assert levels() == ["error"]
    session.level = "info"
    assert levels() == ["info", "warning", "error"]
    session.level = "none"
    assert levels() == []


def test_ids_come_back_when_there_were_any() -> None:
    session = Session("me", may_ask=True)
    session.status("error", "why", 0, "7")
    session.response("/s", None, {"a": 1}, True, 0)
    session.response("/s", 8, "why", False, 0)
    assert heard(session) == [
        {"op": "status", "id": "7", "level": "error", "msg": "why"},
        {"op": "service_response", "service": "/s", "values": {"a": 1}, "result": True},
        {"op": "service_response", "id": 8, "service": "/s", "values": "why", "result": False},
    ]


def test_settings_that_wait_are_told_apart_by_their_call() -> None:
    assert Setting("/s", "a", "gain", 1.0, 5) != Setting("/s", "b", "gain", 1.0, 5)

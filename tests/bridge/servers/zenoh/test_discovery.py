"""Bridges are asked what they say of themselves, not too often, and nobody waits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from armlab.bridge.servers.zenoh import Asking, close_session, open_session

from .conftest import free_port, until


def test_the_answer_comes_and_a_question_is_not_repeated_at_once(session: Callable[..., Any]) -> None:
    port = free_port()
    router, asked = open_session("router", [f"127.0.0.1:{port}"]), []

    def answer(query: Any) -> None:
        asked.append(str(query.key_expr))
        with query:
            query.reply(query.key_expr, b"here")

    answering = router.declare_queryable("armlab/lab1/*/about", answer)
    told: list[tuple[str, str, bytes]] = []
    asking = Asking(session(port), lambda *words: told.append(words))
    until(lambda: asking.ask("lab1", "arm") or told)  # it does not know at once of who can answer
    assert told[0] == ("lab1", "arm", b"here")
    before = len(asked)
    asking._due.clear()
    for _ in range(100):
        asking.ask("lab1", "other")
    until(lambda: ("lab1", "other", b"here") in told)
    assert len(asked) == before + 1
    assert answering is not None
    close_session(router)
    asking._due.clear()
    asking.ask("lab1", "arm")  # nobody answers: nothing is raised

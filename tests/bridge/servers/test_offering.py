"""Rows of a link on the local feed: who looks sees them, a stop holds the arm, and nobody commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.bridge import connect
from armlab.bridge.servers.local import LocalFeed, cells
from armlab.bridge.servers.messages import CommandRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row
from armlab.bridge.servers.supervisor import Offering, stoppable
from armlab.errors import LinkError
from armlab.robots import Robot
from armlab.state import Command, State

MESSAGES = 2000  # among which there is a row


def test_rows_of_a_link_are_offered_and_a_stop_holds_it(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In lockstep: the controller lets the client act between two packets."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with connect(f"sim://{robot.name}?lockstep=true", robot, offer="small") as link, LocalFeed() as feed:
        assert link._offering is not None
        exchange = link._offering.exchange
        assert cells() == ["small"]
        feed.ask(Subscribe(rate=None))
        feed.ask(CommandRequest(arm=robot.name, qd=[0.1] * 7))
        answers: list[str] = []

        def heard(true: Callable[[Any], bool]) -> Any:
            while not true(message := feed.receive()):
                pass
            return message

        def controller(state: State) -> Command:
            if len(answers) < 1 and state.t > 0.1:
                exchange.poll()
                answers.append(heard(lambda message: isinstance(message, dict) and message["kind"] == "answer")["text"])
                feed.ask(Stop())
                while not exchange.arbiter.stopped:
                    exchange.poll()
            return Command(qd=np.full(7, 0.05))

        run = link.run(controller, seconds=0.6)
        assert f"{robot.name}.q" in heard(lambda message: isinstance(message, Row)).values
    assert "the controller of the run" in answers[0], "who holds the arm"
    sent = run.table["qd_sent"]
    assert sent.max() > 0.04
    assert np.abs(sent[-10:]).max() < 1e-9, "it came to rest and held"
    assert cells() == []


def test_a_name_that_is_taken(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The link that was opened for nothing leaves its port free."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    offering = Offering([robot], "small")
    try:
        with pytest.raises(LinkError, match="Expected the server local to listen"):
            connect("egm://127.0.0.1:0", robot, offer="small")
    finally:
        offering.close()
    assert cells() == []


def test_who_only_listens_offers_what_it_hears(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Again in the next run of the same link."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with connect(f"sim://{robot.name}", robot, offer="small") as link, LocalFeed() as feed:
        feed.ask(Subscribe(rate=None))
        for _ in range(2):
            link.run(None, seconds=0.05)
            for _ in range(MESSAGES):
                message = feed.receive()
                if isinstance(message, Row):
                    break
            else:
                pytest.fail("no row came")


def test_a_controller_holds_while_somebody_has_stopped_the_arms() -> None:
    arbiter = SimpleNamespace(stopped=False, polled=0)
    arbiter.poll = lambda: setattr(arbiter, "polled", arbiter.polled + 1)
    controlled = stoppable(lambda state: Command(qd=np.ones(7)), arbiter)  # type: ignore[arg-type]
    state: Any = None
    assert controlled(state) is not None
    arbiter.stopped = True
    assert controlled(state) is None
    assert arbiter.polled == 2

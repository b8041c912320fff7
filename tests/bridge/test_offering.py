"""Rows of a link on the local feed: who looks sees them, a stop holds the arm, and nobody commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.bridge import connect
from armlab.bridge.local import LocalFeed, cells
from armlab.bridge.messages import CommandRequest, Stop, Subscribe
from armlab.bridge.offering import offered, stoppable
from armlab.bridge.row import Row
from armlab.errors import LinkError
from armlab.robots import Robot
from armlab.state import Command, State


def test_rows_of_a_link_are_offered_and_a_stop_holds_it(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In lockstep: the controller lets the client act between two packets."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with offered([robot], "small") as exchange, LocalFeed() as feed:
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

        with connect(f"sim://{robot.name}?lockstep=true", robot) as link:
            run = link.run(stoppable(controller, exchange.arbiter), seconds=0.6, feeds=[exchange])
        assert f"{robot.name}.q" in heard(lambda message: isinstance(message, Row)).values
    assert "the controller of the run" in answers[0], "who holds the arm"
    sent = run.table["qd_sent"]
    assert sent.max() > 0.04
    assert np.abs(sent[-10:]).max() < 1e-9, "it came to rest and held"
    assert cells() == []


def test_a_name_that_is_taken(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with (
        offered([robot], "small"),
        pytest.raises(LinkError, match="Expected the server local to listen"),
        offered([robot], "small"),
    ):
        pass

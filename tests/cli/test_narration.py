"""What a run tells while it goes on."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np

from armlab.cli.support.output import Narrator
from armlab.log import Tick
from armlab.state import State

TICK = Tick(number=0, seq_sent=-1, stamp_ns=0, receive_ns=0, send_ns=-1, step_ns=0)


def state(q: list[float], mci: int = 2) -> State:
    return State(t=0.0, dt=0.004, q=np.array(q), qd=np.zeros(2), tau=np.zeros(2), mci=mci, robot="arm")


def test_events_become_messages(capsys: Any) -> None:
    narrator = Narrator()
    narrator.event("Session 1 began.")
    narrator.event("The robot is not ready.", warn=True)
    narrator.row(state([1.0, 2.0], mci=3), None, TICK)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "Session 1 began.\nwarning: The robot is not ready.\n"


def test_a_warning_is_written_once() -> None:
    """Python's handler of last resort would write it again: seen in a process of its own, without pytest's handlers."""
    program = (
        "import logging; from armlab.cli.support.output import Narrator; narrator = Narrator()\n"
        "logging.getLogger('armlab.bridge').warning('Twice.'); narrator.event('Twice.', warn=True)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stderr
    assert said == "warning: Twice.\n"


def test_what_a_listener_should_know_is_said_once(capsys: Any) -> None:
    narrator = Narrator(listens=True, q_home={"arm": [0.0, 0.0]})
    for _ in range(3):
        narrator.row(state([0.01, -0.3], mci=3), None, TICK)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "waits for references" in lines[0]
    assert "joint 2 is 0.30" in lines[1]


def test_an_arm_at_home_is_not_worth_a_word(capsys: Any) -> None:
    Narrator(listens=True, q_home={"arm": [0.0, 0.0]}).row(state([0.01, -0.03]), None, TICK)
    assert not capsys.readouterr().err

"""Sentences for the user."""

from __future__ import annotations

import logging

import pytest

from armlab.bridge.events import Tell, nobody
from armlab.bridge.recording import Recording
from armlab.robots import Robot


def test_what_is_wrong_is_a_warning(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    recording = Recording(robot, None, None, wait=False, clock=lambda: 7)
    tell: Tell = recording.event
    with caplog.at_level(logging.INFO, "armlab.bridge"):
        tell("All is well.")
        tell("The motors are off.", warn=True)
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("INFO", "All is well."),
        ("WARNING", "The motors are off."),
    ]
    assert list(recording.events) == [(7, "All is well."), (7, "The motors are off.")]


def test_nobody_listens(capsys: pytest.CaptureFixture[str]) -> None:
    nobody("anything", warn=True)
    assert capsys.readouterr() == ("", "")

"""Sentences for the user."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.control.recording import Recording
from armlab.bridge.net.events import Limited, Tell, nobody
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


SECOND = 10**9


def told_of(*said: tuple[str, float], each: bool = False) -> list[tuple[str, int]]:
    """What is passed on of sentences at times [s], and when it came."""
    told: list[tuple[str, int]] = []
    limited = Limited(lambda text, warn, stamp_ns: told.append((text, stamp_ns)))
    for text, seconds in said:
        limited(text, False, round(SECOND * seconds), each)
    limited.close()
    return told


def test_of_a_kind_one_a_second() -> None:
    """The first at once, the last of those that came too soon in its turn, with the number left out."""
    said = [(f"Joint {k} of 'a{k}' flaps.", 0.1 * k) for k in range(25)]
    assert told_of(*said) == [
        ("Joint 0 of 'a0' flaps.", 0),
        ("Joint 9 of 'a9' flaps. (8 like it left out.)", 900_000_000),
        ("Joint 19 of 'a19' flaps. (9 like it left out.)", 1_900_000_000),
        ("Joint 24 of 'a24' flaps. (4 like it left out.)", 2_400_000_000),
    ]


def test_other_kinds_are_not_touched() -> None:
    said = [("Ready.", 0.0), ("Not ready.", 0.1), ("Stopped by a 1.", 0.2), ("Ready.", 0.3), ("Not ready.", 5.0)]
    assert [text for text, _ in told_of(*said)] == [text for text, _ in said]


def test_what_must_be_told_one_by_one_is_unless_it_floods() -> None:
    """Ten a second for ten seconds, as the lease allows; a client that takes an arm and lets go of it in every tick."""
    said = [(f"zenoh {k} commands arm.", 0.1 * k) for k in range(100)]
    assert [text for text, _ in told_of(*said, each=True)] == [text for text, _ in said]
    told = told_of(*((f"zenoh {k} commands arm.", 0.004 * k) for k in range(1000)), each=True)
    assert len(told) == 4 * 50 + 1
    assert told[50] == ("zenoh 249 commands arm. (199 like it left out.)", 996_000_000)


def test_a_clock_that_begins_anew() -> None:
    assert len(told_of(("A.", 100.0), ("A.", 0.0), ("A.", 0.5), ("A.", 1.0))) == 4


@given(st.lists(st.tuples(st.integers(0, 200), st.floats(0.0, 0.3)), max_size=400))
def test_nothing_is_lost_without_being_counted(steps: list[tuple[int, float]]) -> None:
    """Few sentences a second whatever comes; those told and those left out are all."""
    now, said = 0.0, []
    for kind, wait in steps:
        now += wait
        said.append((f"{'x' * kind} {now}", now))
    told = told_of(*said)
    left_out = sum(int(text.partition("(")[2].split()[0]) for text, _ in told if "(" in text)
    assert len(told) + left_out == len(said)
    assert len(told) <= 2 * 65 * (int(now) + 2)


def test_a_recording_keeps_what_waited(robot: Robot) -> None:
    """Readiness that flaps with each packet for four seconds: about two events a second, and the last state."""
    stamps = [0]
    recording = Recording(robot, None, None, wait=False, clock=lambda: stamps[0])
    for k in range(1000):
        stamps[0] = 4_000_000 * (k + 1)
        recording.event("The robot is ready and holds." if k % 2 else "The robot is not ready: the motors are off.")
        recording.catch_up()
    recording.close({})
    assert 8 <= len(recording.events) <= 10
    assert recording.events[-1] == (stamps[0], "The robot is ready and holds. (124 like it left out.)")

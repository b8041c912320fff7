"""One arm of a loop, fed by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from armlab.bridge import Limits
from armlab.bridge.assembly import End, assemble
from armlab.bridge.control.arm import Arm, Turn
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Arrival, Port
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm import EgmCodec

PERIOD_NS = 4_000_000


@pytest.fixture
def arm(robot: Robot) -> Iterator[Arm]:
    port = Port("127.0.0.1", 0)
    options: dict[str, Any] = {
        "commands": True,
        "answer_stream": True,
        "record": None,
        "extra": None,
        "attachments": {},
        "feeds": (),
        "sources": (),
    }
    [made] = assemble([End(robot, port, EgmCodec(robot), ())], [Limits.of(robot)], Settings(), **options)
    yield made
    port.close()


def take(arm: Arm, packets: Any, k: int) -> Turn:
    turn = arm.take(Arrival(packets(), ("127.0.0.1", arm.port.port), arm.stamp_ns + k * PERIOD_NS))
    assert turn is not None
    return turn


def test_how_long_a_packet_waited_for_the_loop_is_recorded(arm: Arm, packets: Any) -> None:
    came = time.monotonic_ns() - 3_000_000
    turn = arm.take(Arrival(packets(), ("127.0.0.1", arm.port.port), came))
    assert turn is not None
    assert 3_000_000 <= turn.wake_ns <= time.monotonic_ns() - came
    later = arm.take(Arrival(packets(), ("127.0.0.1", arm.port.port), came + 10**12))  # while the loop ran
    assert later is not None
    assert later.wake_ns == 0
    arm.reply(turn, None, arm.guide.answer(None, arm.period))
    arm.record()
    assert arm.recording.table()["wake_ns"][0] == turn.wake_ns


def test_the_newest_is_answered_and_both_are_recorded(arm: Arm, packets: Any) -> None:
    first = take(arm, packets, 0)
    second = arm.take(Arrival(packets(), ("127.0.0.1", arm.port.port), first.sample.arrival_ns + PERIOD_NS), first)
    assert second is not None
    assert arm.newest is second
    arm.reply(second, None, arm.guide.answer(None, arm.period))
    assert (arm.replies, arm.overtaken) == (1, 1)
    assert len(arm.recording.table()) == 0
    arm.record()
    table = arm.recording.table()
    np.testing.assert_array_equal(table["seq"], [0, 1])
    np.testing.assert_array_equal(np.isfinite(table["seq_sent"].astype(float)), [False, True])
    assert arm.deadline(second.sample) == second.sample.arrival_ns + 0.75 * PERIOD_NS


def test_a_command_that_was_given_serves_for_a_time(arm: Arm, packets: Any) -> None:
    command = Command(qd=np.ones(7))
    take(arm, packets, 0)
    arm.give(command)
    served = [arm.given(take(arm, packets, k).sample, 0.0101) is not None for k in range(1, 5)]
    assert served == [True, True, False, False]
    arm.give(command)
    assert arm.given(take(arm, packets, 5).sample, 0.0101) is not None
    arm.give(None)
    assert arm.given(take(arm, packets, 6).sample, 0.0101) is None


def test_what_the_controller_writes_later_is_not_commanded(arm: Arm, packets: Any) -> None:
    sample, qd = take(arm, packets, 0).sample, np.zeros(7)
    arm.give(Command(qd=qd))
    qd[2] = 1.0
    command = arm.given(sample, 1.0)
    assert command is not None
    assert command.qd is not None
    assert not command.qd.any()


@pytest.mark.parametrize(("ahead_ns", "times"), [(PERIOD_NS // 2, 2), (50_000, 1)])
def test_another_rehearsal_needs_time_before_the_packet(arm: Arm, packets: Any, ahead_ns: int, times: int) -> None:
    rehearsed: list[Arrival] = []
    arm._rehearsals = [lambda arrival, _: rehearsed.append(arrival)] * 2
    arm.rehearse()
    assert not rehearsed  # nothing has come
    turn = take(arm, packets, 0)
    arm.prediction.add(time.monotonic_ns() - PERIOD_NS + ahead_ns, 1, 1e-9 * PERIOD_NS)
    arm.rehearse()
    assert [one.ns for one in rehearsed] == [turn.sample.arrival_ns] * times
    arm.rehearse()
    assert len(rehearsed) == times  # once for each packet


def test_a_reply_that_the_system_refuses_is_told_and_is_no_step(
    arm: Arm, packets: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    fast = Command(qd=np.full(7, 0.5))
    for k in range(60):
        if k == 30:
            monkeypatch.setattr(arm.port, "send", lambda data, to: False)
        if k == 50:
            monkeypatch.undo()
        turn = take(arm, packets, k)
        arm.reply(turn, fast, arm.guide.answer(fast, arm.period))
        arm.record()
    table = arm.recording.table()
    answered = np.isfinite(np.asarray(table["seq_sent"], dtype=float))
    np.testing.assert_array_equal(np.flatnonzero(~answered), np.arange(30, 50))
    steps = np.diff(table["q_sent"][answered], axis=0)[15:]
    np.testing.assert_allclose(np.delete(steps, 14, axis=0), 0.5 * arm.period)
    np.testing.assert_allclose(steps[14], 3 * arm.robot.qd_max.min() * arm.period, rtol=1e-6)
    told = [text for _, text in arm.recording.events if "did not go out" in text]
    assert told == [
        f"A reply to 127.0.0.1:{arm.port.port} did not go out: the system refused it. The robot keeps the last one."
    ]

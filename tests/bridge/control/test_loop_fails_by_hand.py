"""The loop on a clock of its own when something fails: the arm comes to rest, the reason is told, the run ends."""

from __future__ import annotations

import errno
from typing import Any, ClassVar

import pytest

from armlab import robots
from armlab.errors import ControllerFailed, LinkError
from armlab.state import Command, State

from .by_hand import Hands, Make, drift

RIGHT = robots.load("yumi_right")


@pytest.fixture
def one(monkeypatch: pytest.MonkeyPatch) -> Make:
    """Return what makes a loop of one arm."""
    return lambda controller, **options: Hands(monkeypatch, [RIGHT], controller, **options)


def test_an_interrupt_in_a_call_that_does_not_hang_is_the_controllers_or_the_second_one(one: Make) -> None:
    def controller(state: State) -> Command:
        raise KeyboardInterrupt

    hands = one(controller)
    hands.cycle()
    assert isinstance(hands.loop.failure, ControllerFailed)
    assert isinstance(hands.loop.failure.__cause__, KeyboardInterrupt)
    hands = one(controller)
    hands.cycle(mci=2)
    hands.loop.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        hands.cycle()


@pytest.mark.parametrize("method", ["decode", "encode"])
def test_an_error_while_the_guard_answers_ends_the_run_and_the_guard_goes_on(
    one: Make, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    def controller(state: State) -> Command:
        if state.seq == 5:
            hands.put()
            with monkeypatch.context() as patch:
                patch.setattr(hands.arms[0].codec, method, lambda data: 1 / 0)
                hands.loop.answer_for_controller()
        return drift(state)

    hands = one(controller)
    for _ in range(6):
        hands.cycle()
    assert len(hands.ports[0].sent) == 5  # the packet has been taken: the controller's reply would be late
    assert hands.loop.reason == "the bridge failed"
    assert isinstance(hands.loop.failure, LinkError)
    assert isinstance(hands.loop.failure.__cause__, ZeroDivisionError)


def test_a_display_of_progress_that_fails_stops_the_arm(one: Make) -> None:
    hands = one(drift, progress=lambda done: 1 / 0)
    hands.cycle()
    assert hands.loop.reason == "the display of progress failed"
    assert isinstance(hands.loop.failure, ControllerFailed)
    assert isinstance(hands.loop.failure.__cause__, ZeroDivisionError)


def test_a_run_ends_when_an_error_comes_again(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first brings the arm to rest; while that fails too nothing can be sent."""
    hands = one(drift)
    for _ in range(5):
        hands.cycle()
    errors: list[Exception] = [ZeroDivisionError("division by zero"), ValueError("another")]

    def raises(reference: Any) -> bytes:
        raise errors.pop(0)

    monkeypatch.setattr(hands.arms[0].codec, "encode", raises)
    for _ in range(2):
        hands.put()
    coming = list(hands.ports[0].waiting)
    hands.ports[0].waiting.clear()
    monkeypatch.setattr(hands, "next", lambda seconds: (0, coming.pop(0)) if coming else None)
    hands.loop.run()
    assert not coming
    assert "ZeroDivisionError: division by zero" in str(hands.loop.failure)
    assert isinstance(hands.loop.failure, LinkError)
    assert hands.warned == [str(hands.loop.failure)]


@pytest.mark.parametrize("fails", [1, 1000])
def test_a_run_that_stops_already_ends_with_the_error(one: Make, fails: int) -> None:
    hands, failed = one(drift), []
    hands.cycle()
    hands.loop.interrupt()
    hands.loop.cycle()
    encode = hands.arms[0].codec.encode

    def fails_at_first(reference: Any) -> bytes:
        failed.append(reference)
        return encode(reference) if len(failed) > fails else 1 / 0  # type: ignore[return-value]

    hands.arms[0].codec.encode = fails_at_first  # type: ignore[method-assign]
    hands.run()
    assert hands.loop.reason == "interrupted"
    assert "ZeroDivisionError" in str(hands.loop.failure)
    assert len(failed) >= min(fails, 2)


def test_one_error_brings_the_arm_to_rest_and_is_raised(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    hands = one(drift)
    for _ in range(10):
        hands.cycle()
    encode, failed = hands.arms[0].codec.encode, []

    def fails_once(reference: Any) -> bytes:
        failed.append(reference)
        return encode(reference) if len(failed) > 1 else 1 / 0  # type: ignore[return-value]

    monkeypatch.setattr(hands.arms[0].codec, "encode", fails_once)
    hands.run()
    assert hands.speed() == 0.0
    assert hands.loop.reason == "the bridge failed"
    assert "ZeroDivisionError" in str(hands.loop.failure)
    assert 125 <= len(hands.rows) - 10 < 150  # it rests half a second


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("of whatever"), "raised MemoryError: no memory is left. The arm"),
        (ValueError("bad luck"), "raised ValueError: bad luck. The arm"),
        (ValueError(), "raised ValueError. The arm"),
    ],
)
def test_what_fails_is_named_and_memory_is_given_back(one: Make, error: Exception, words: str) -> None:
    def raises(_: Any) -> None:
        raise error

    for hands in (one(raises), one(drift, progress=raises)):
        hands.cycle()
        assert words in str(hands.loop.failure)


class Reserve:
    """Stands for `mmap`: what was set aside and given back."""

    made: ClassVar[list[Reserve]] = []

    def __init__(self, file: int, size: int) -> None:
        assert (file, size) == (-1, 2**24)
        self.given_back = False
        self.made.append(self)

    def close(self) -> None:
        self.given_back = True


@pytest.fixture
def reserves(monkeypatch: pytest.MonkeyPatch) -> list[Reserve]:
    """What a run sets aside."""
    monkeypatch.setattr(Reserve, "made", [])
    monkeypatch.setattr("armlab.bridge.control.loop.mmap", Reserve)
    return Reserve.made


class Looks(Exception):
    """Tells whether memory had been given back when its text was made."""

    def __str__(self) -> str:
        return f"{len(Reserve.made)} set aside, back {Reserve.made[0].given_back}"


@pytest.mark.parametrize("where", ["controller", "progress", "bridge"])
def test_memory_is_given_back_before_words_are_made(one: Make, reserves: list[Reserve], where: str) -> None:
    def raises(_: Any) -> None:
        assert not reserves[0].given_back
        raise Looks

    hands = one(raises if where == "controller" else drift, **({"progress": raises} if where == "progress" else {}))
    if where == "bridge":
        encode, left = hands.arms[0].codec.encode, [1]
        hands.arms[0].codec.encode = lambda reference: raises(left.pop()) if left else encode(reference)
    hands.run()
    assert "1 set aside, back True" in str(hands.loop.failure)


def test_memory_is_given_back_at_the_end(one: Make, reserves: list[Reserve]) -> None:
    hands = one(drift, seconds=0.1)
    hands.run()
    assert hands.loop.reason == "the time is up"
    assert [one.given_back for one in reserves] == [True]


def test_without_memory_for_its_end_no_run_begins(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: Any) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr("armlab.bridge.control.loop.mmap", none_left)
    hands = one(drift)
    with pytest.raises(LinkError, match=r"Expected 16 MiB of memory .*: Cannot allocate memory\. End other programs"):
        hands.run()
    assert hands.loop.reason == "there is no memory for its end"


def test_an_error_that_cannot_be_told_brings_the_arm_to_rest(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the event nor the text of the error: the arm stops all the same, and the run says so."""

    class Mute(Exception):
        def __str__(self) -> str:
            raise MemoryError

    def raises(*_: Any, **__: Any) -> None:
        raise MemoryError

    hands = one(drift)
    for _ in range(10):
        hands.cycle()
    encode, left = hands.arms[0].codec.encode, [Mute()]

    def fails_once(reference: Any) -> bytes:
        if left:
            monkeypatch.setattr(hands.arms[0].recording, "event", raises)
            raise left.pop()
        monkeypatch.undo()
        return encode(reference)

    hands.arms[0].codec.encode = fails_once  # type: ignore[method-assign]
    hands.run()
    assert hands.speed() == 0.0
    assert hands.loop.reason == "the bridge failed"
    assert str(hands.loop.failure) == "Expected a cycle without errors, got Mute: its text cannot be read."


def test_a_run_ends_when_an_error_cannot_be_told_and_another_comes(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def raises(*_: Any, **__: Any) -> None:
        raise MemoryError

    hands = one(drift)
    hands.cycle()
    monkeypatch.setattr(hands.arms[0].recording, "event", raises)
    monkeypatch.setattr(hands, "next", raises)
    hands.loop.run()
    assert hands.loop.reason == "the bridge failed"
    assert "MemoryError" in str(hands.loop.failure)


def test_a_stop_of_which_the_system_sends_nothing_ends_the_run(one: Make) -> None:
    hands = one(drift)
    for _ in range(10):
        hands.cycle()
    hands.ports[0].works = False
    hands.loop.interrupt()
    count = 0
    while not hands.loop._have_ended():
        assert count < 1000
        hands.cycle()
        count += 1
    assert count == 501  # the first is the packet after which the interrupt is seen
    assert isinstance(hands.loop.failure, LinkError)
    assert any("Expected the replies that bring the arm to rest to go out" in text for text in hands.warned)

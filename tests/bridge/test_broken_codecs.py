"""Codecs of the user's that raise, against their protocol: in the loop, in the guard, and while the arm stops."""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log
from armlab.bridge.control.recording import Recording
from armlab.errors import LinkError
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec

BROKEN = r"^Expected a cycle without errors, got ZeroDivisionError: division by zero\.$"


def test_an_error_outside_the_controller_stops_the_arm_first(play: Any, robot: Any) -> None:
    """A codec of the user's that raises, against its protocol."""

    class Broken(EgmCodec):
        decoded = 0

        def decode(self, data: bytes) -> Any:
            self.decoded += 1
            if self.decoded == 40:
                raise ZeroDivisionError("division by zero")
            return super().decode(data)

    def script(peer: Any) -> None:
        while not peer.over.is_set():  # one packet has no answer
            peer.send()
            with contextlib.suppress(TimeoutError):
                peer.answer(0.05)

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(script, lambda state: Command(qd=np.full(7, 0.1)), play.link(codec=Broken(robot)))
    sent = caught.value.table["qd_sent"]
    assert np.nanmax(sent) > 0.05
    assert not sent[-1].any()


def test_an_error_in_the_guard_stops_the_arm(play: Any, robot: Any) -> None:
    """While the guard answers for a controller that sleeps, the codec raises: the run ends and says so."""
    asleep, raised = threading.Event(), threading.Event()

    class Broken(EgmCodec):
        def encode(self, reference: Any) -> bytes:
            if asleep.is_set() and not raised.is_set():
                raised.set()
                raise ZeroDivisionError("division by zero")
            return super().encode(reference)

    def controller(state: State) -> Command:
        if state.t > 0.05 and not asleep.is_set():
            asleep.set()
            assert raised.wait(5.0)
        return Command(qd=np.full(7, 0.1))

    def script(peer: Any) -> None:
        peer.begin()
        while not peer.over.is_set():  # one packet has no answer
            peer.send()
            with contextlib.suppress(TimeoutError):
                peer.answer(0.02)

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(script, controller, play.link(clock="wall", codec=Broken(robot)))
    sent = caught.value.table["qd_sent"]
    assert not sent[-1].any()


def answered(peer: Any) -> None:
    """Guided packets until the run has ended, which the loop under test sees to."""
    peer.begin()
    until = time.monotonic() + 20.0
    while not peer.over.is_set():
        assert time.monotonic() < until
        peer.send()
        with contextlib.suppress(TimeoutError):
            peer.answer(0.05)


def test_errors_while_the_arm_stops_end_the_run(play: Any, robot: Any) -> None:
    """A codec that raises from then on: the loop must not go round for ever."""

    class Broken(EgmCodec):
        broken = False

        def decode(self, data: bytes) -> Any:
            if self.broken:
                raise ZeroDivisionError("division by zero")
            return super().decode(data)

    codec = Broken(robot)

    def controller(state: State) -> Command:
        codec.broken = state.t > 0.1
        return Command.stop() if codec.broken else Command(qd=np.full(7, 0.1))

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(answered, controller, play.link(codec=codec))
    assert np.nanmax(caught.value.table["qd_sent"]) > 0.05


def test_a_row_for_which_there_is_no_memory_is_recorded_later(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """No hole and none twice: the table has a row for each packet."""
    keep, failures = Recording.keep, [MemoryError()]

    def fails_once(self: Recording, state: State, command: Command | None, tick: Any) -> Command | None:
        if tick.number == 30 and failures:
            raise failures.pop()
        return keep(self, state, command, tick)

    monkeypatch.setattr(Recording, "keep", fails_once)

    with pytest.raises(LinkError, match=r"without errors, got MemoryError: no memory is left\.") as caught:
        play(answered, lambda state: Command(qd=np.full(7, 0.1)))
    table = caught.value.table
    np.testing.assert_array_equal(table["tick"], np.arange(len(table)))
    assert len(table) > 31
    assert not table["qd_sent"][-1].any()


def test_rows_for_which_there_is_never_memory_leave_the_reason_and_a_whole_file(
    play: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    keep = Recording.keep

    def fails(self: Recording, state: State, command: Command | None, tick: Any) -> Command | None:
        if tick.number >= 30:
            raise MemoryError
        return keep(self, state, command, tick)

    monkeypatch.setattr(Recording, "keep", fails)

    link = play.link()
    with pytest.raises(LinkError, match=r"got MemoryError: no memory is left\."):
        play(answered, lambda state: Command(qd=np.full(7, 0.1)), link, record=tmp_path / "run.mcap")
    assert len(log.read(tmp_path / "run.mcap")) == 30
    assert "The last rows were not recorded: MemoryError." in link.last.statistics["problems"]


def test_a_run_without_memory_for_its_end_does_not_begin(
    play: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def none_left(*_: Any) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr("armlab.bridge.control.loop.mmap", none_left)
    link = play.link()
    with pytest.raises(LinkError, match=r"Expected 16 MiB .* of the run: Cannot allocate memory\. End other"):
        play(lambda peer: None, lambda state: None, link, record=tmp_path / "run.mcap")
    assert log.inspect(tmp_path / "run.mcap").finished
    assert link.last.reason == "there is no memory for its end"

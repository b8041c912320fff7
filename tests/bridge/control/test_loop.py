"""The loop against a robot's controller played in the test: one reply per packet, and what never reaches the wire."""

from __future__ import annotations

import math
import socket
import threading
import time
from typing import Any

import numpy as np
import pytest

from armlab.bridge.control.loop import Controller, Loop
from armlab.errors import CommandRefused, ControllerFailed, ControllerLate
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Reference

CYCLES = 60


def sway(state: State) -> Command:
    return Command(state.q_start + 0.05 * math.sin(3.0 * state.t) * np.ones(7))


def test_names() -> None:
    controller: Controller = sway
    assert callable(controller)
    assert hasattr(Loop, "run")


def test_one_reply_per_packet(play: Any) -> None:
    def script(peer: Any) -> None:
        peer.rest()

    run = play(script, sway, seconds=0.004 * CYCLES)
    assert play.peer.surplus() == 0
    sent = play.peer.replies[: len(run.table)]
    assert len(run.table) == run.statistics["packets"] == run.statistics["replies"]
    assert [reply.seqno for reply in sent] == list(range(len(sent)))
    assert [reply.tm_ms for reply in sent] == [10_000 + 4 * k for k in range(len(sent))]
    np.testing.assert_allclose(run.table["q_sent"], [reply.q for reply in sent], rtol=1e-14)
    np.testing.assert_allclose(run.table["qd_sent"], [reply.qd for reply in sent], atol=1e-14)


def test_the_reply_to_a_ready_robot_follows_the_controller(play: Any) -> None:
    def script(peer: Any) -> None:
        home = peer.packets.q
        waiting = peer.cycles(3, mci=2)
        np.testing.assert_allclose([reply.q for reply in waiting], [home] * 3, rtol=1e-14)
        moving = peer.cycles(CYCLES)
        t = 0.004 * np.arange(CYCLES)
        expected = home + 0.05 * np.sin(3.0 * t)[:, None] * np.ones(7)
        np.testing.assert_allclose([reply.q for reply in moving[5:]], expected[5:], atol=1e-12)
        peer.rest()

    play(script, sway, seconds=0.004 * (CYCLES + 2))


def test_overtaken_packets_get_no_reply_but_a_row(play: Any) -> None:
    """Five packets wait when the loop wakes: the newest is answered, once."""
    started = threading.Event()

    def controller(state: State) -> Command:
        if state.seq == 10:
            started.set()
            time.sleep(0.05)
        return sway(state)

    def script(peer: Any) -> None:
        peer.cycles(10)
        peer.send()
        assert started.wait(5.0)
        for _ in range(4):
            peer.send()
        reply = peer.answer()
        assert reply.tm_ms == 10_000 + 4 * 14
        peer.rest()

    run = play(script, controller, seconds=0.3)
    table = run.table
    assert play.peer.surplus() == 0
    assert run.statistics["overtaken"] == 4
    assert run.statistics["packets"] == run.statistics["replies"] + 4
    answered = np.isfinite(np.asarray(table["seq_sent"], dtype=float))
    np.testing.assert_array_equal(table["seq"][~answered], [10, 11, 12, 13])
    np.testing.assert_allclose(table["dt"], 0.004)


@pytest.mark.parametrize(("garbage", "packets"), [(0, 90), (64, 1), (63, 1), (100, 1)])
def test_after_a_stall_only_the_newest_is_answered_and_none_is_lost(play: Any, garbage: int, packets: int) -> None:
    started, go = threading.Event(), threading.Event()

    def controller(state: State) -> Command:
        if state.seq == 10:
            started.set()
            go.wait(5.0)
        return sway(state)

    def script(peer: Any) -> None:
        peer.cycles(10)
        peer.send()
        assert started.wait(5.0)
        for _ in range(garbage):
            peer.send(b"garbage")
        for _ in range(packets):
            peer.send()
        go.set()
        if garbage >= 64:  # the stalled packet is answered before the flood is through
            peer.answer()
        assert peer.answer().tm_ms == 10_000 + 4 * (10 + packets)
        peer.rest()

    run = play(script, controller, seconds=0.6)
    assert play.peer.surplus() == 0
    np.testing.assert_array_equal(run.table["seq"], np.arange(len(run.table)))
    assert run.statistics["overtaken"] == packets - (garbage >= 64)
    assert sum(run.statistics["drops"].values()) == garbage


def test_overtaken_rows_stay_in_order(play: Any) -> None:
    """Packets wait before the controller is called and more come while it computes: rows in the order of arrival."""
    sent, more, go, held, called = (threading.Event() for _ in range(5))

    def progress(*_: Any) -> None:
        if go.is_set() and not sent.is_set():
            held.set()
            sent.wait(5.0)

    def controller(state: State) -> Command:
        if sent.is_set() and not called.is_set():
            called.set()
            more.wait(5.0)
        return sway(state)

    def script(peer: Any) -> None:
        peer.cycles(40)
        go.set()
        while not held.is_set() and peer.packets.cycle < 2000:  # progress, ten times a second, holds the loop up
            peer.send()
            until = time.monotonic() + 5.0
            while not held.is_set() and peer.surplus() == 0 and time.monotonic() < until:
                time.sleep(1e-4)
        for _ in range(3):
            peer.send()
        sent.set()
        called.wait(5.0)
        peer.send()
        peer.send()
        more.set()
        peer.rest()

    run = play(script, controller, seconds=0.5, progress=progress)
    assert held.is_set()
    assert called.is_set()
    np.testing.assert_array_equal(run.table["seq"], np.arange(len(run.table)))
    assert run.statistics["overtaken"] >= 4


def test_duplicates_and_old_packets_get_no_reply(play: Any) -> None:
    def script(peer: Any) -> None:
        peer.packets.seq = 100
        for _ in range(CYCLES):
            data = peer.packets()
            old = peer.packets.codec.encode_robot(peer.packets.message(seqno=peer.packets.seq - 3))
            peer.packets.seq, peer.packets.cycle = peer.packets.seq + 2, peer.packets.cycle - 1
            peer.send(data)
            peer.answer()
            peer.send(data)
            peer.send(old)
        peer.rest()

    run = play(script, sway, seconds=0.2)
    assert play.peer.surplus() == 0
    assert run.statistics["replies"] == run.statistics["packets"]
    assert run.statistics["drops"]["duplicate"] > 30
    assert run.statistics["drops"]["old"] > 30


class Noise:
    """Garbage from the robot's own address, and anything at all from another."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __call__(self, peer: Any) -> None:
        good = peer.packets()
        peer.packets.seq, peer.packets.cycle = peer.packets.seq - 1, peer.packets.cycle - 1
        wrong_type = peer.packets.codec.encode_robot(peer.packets.message())[11:]
        peer.packets.seq, peer.packets.cycle = peer.packets.seq - 1, peer.packets.cycle - 1
        for _ in range(20):
            garbage = [
                self.rng.bytes(int(self.rng.integers(0, 1500))),
                good[: self.rng.integers(60)],
                b"\x0a\x06\x08\x05\x10\x01\x18\x03" + wrong_type,
                EgmCodec(peer.packets.robot).encode(Reference(peer.packets.q, None, None, 5, 5)),
            ]
            peer.socket.sendto(garbage[self.rng.integers(4)], peer.to)
            self.other.sendto([good, good[: self.rng.integers(len(good))]][self.rng.integers(2)], peer.to)


def disturbed_by(play: Any, noise: Any) -> Any:
    def script(peer: Any) -> None:
        peer.cycles(2)
        for _ in range(50):
            noise(peer)
            peer.cycle()
        peer.rest()

    return play(script, sway, play.link(), seconds=0.2)


def test_a_flood_of_garbage_changes_no_reference(play: Any) -> None:
    """Bit for bit what an undisturbed run sends; nothing of it is answered."""
    noise = Noise()
    disturbed = disturbed_by(play, noise)
    assert play.peer.surplus() == 0
    undisturbed = disturbed_by(play, lambda peer: None)
    noise.other.close()
    np.testing.assert_array_equal(disturbed.table["q_sent"], undisturbed.table["q_sent"])
    for run, tells in (disturbed, True), (undisturbed, False):
        assert any("Dropped a datagram from " in text for _, text in run.events) == tells


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_never_reaches_the_wire(play: Any, bad: float) -> None:
    def controller(state: State) -> Command:
        return Command(np.full(7, bad)) if state.seq >= 20 else sway(state)

    def script(peer: Any) -> None:
        peer.rest()
        for reply in peer.replies:
            assert np.isfinite(reply.q).all()
            assert np.isfinite(reply.qd).all()

    with pytest.raises(CommandRefused, match="finite") as caught:
        play(script, controller)
    table = caught.value.table
    assert len(table) > 100
    assert np.isfinite(table["q_sent"]).all()
    np.testing.assert_array_equal(table["qd_sent"][-1], 0.0)
    assert table["q_sent"][22:].max() <= table["q_sent"][19].max() + 0.01


def test_an_exception_stops_the_arm_and_keeps_the_table(play: Any) -> None:
    def controller(state: State) -> Command:
        if state.seq == 30:
            raise ValueError("bad luck")
        return sway(state)

    with pytest.raises(ControllerFailed, match="ValueError: bad luck") as caught:
        play(lambda peer: peer.rest(), controller)
    assert isinstance(caught.value.__cause__, ValueError)
    table = caught.value.table
    np.testing.assert_array_equal(table["seq"][:31], np.arange(31))
    np.testing.assert_array_equal(table["qd_sent"][-1], 0.0)
    assert play.peer.surplus() == 0


def test_a_controller_that_exits_stops_the_arm_first(play: Any) -> None:
    """`sys.exit()` is no Exception: the arm must not go on at its last speed."""

    def controller(state: State) -> Command:
        if state.seq == 30:
            raise SystemExit(1)
        return sway(state)

    with pytest.raises(ControllerFailed, match="SystemExit") as caught:
        play(lambda peer: peer.rest(), controller)
    np.testing.assert_array_equal(caught.value.table["qd_sent"][-1], 0.0)
    assert len(caught.value.table) > 100


def test_a_display_of_progress_that_fails_stops_the_arm_first(play: Any) -> None:
    def progress(done: float, total: float, what: str) -> None:
        if done > 0.1:
            raise BrokenPipeError("nobody reads")

    with pytest.raises(ControllerFailed, match="`progress` raised BrokenPipeError: nobody reads") as caught:
        play(lambda peer: peer.rest(), sway, progress=progress)
    np.testing.assert_array_equal(caught.value.table["qd_sent"][-1], 0.0)
    assert len(caught.value.table) > 100


def test_a_new_session_starts_over(play: Any) -> None:
    seen: list[tuple[int, float]] = []

    def controller(state: State) -> Command:
        seen.append((state.session, state.t))
        return sway(state)

    def script(peer: Any) -> None:
        peer.cycles(20)
        peer.packets.seq = 0
        peer.packets.q = peer.packets.q + 0.2
        restarted = peer.cycles(20)
        assert restarted[0].seqno == 0
        np.testing.assert_allclose(restarted[0].q, peer.packets.q, rtol=1e-14)
        peer.rest()

    run = play(script, controller, seconds=0.004 * 38)
    assert run.statistics["sessions"] == 2
    assert (2, 0.0) in seen
    assert max(t for session, t in seen if session == 2) < 0.1


def test_listening_writes_nothing(play: Any) -> None:
    def script(peer: Any) -> None:
        while not peer.over.is_set():
            peer.send()
            time.sleep(0.001)

    run = play(script, None, play.link(clock="wall"), seconds=0.004 * 40)
    assert play.peer.surplus() == 0
    assert run.statistics["replies"] == 0
    assert len(run.table) >= 40
    assert "q_sent" not in run.table


def test_a_busy_controller_is_answered_for_by_the_guard(play: Any) -> None:
    """Real time: while the controller sleeps, every packet is answered with a hold, and then the run ends."""
    asleep, done = threading.Event(), threading.Event()

    def controller(state: State) -> Command:
        if state.t > 0.1 and not asleep.is_set():
            asleep.set()
            done.wait(5.0)
        return Command(qd=np.full(7, 0.2))

    def script(peer: Any) -> None:
        peer.begin()
        while not asleep.is_set():
            peer.cycle()
            time.sleep(0.004)
        held = []
        until = time.monotonic() + 0.3
        while time.monotonic() < until or len(held) <= 10:
            held += [peer.cycle()]
            time.sleep(0.004)
        assert np.abs(held[-1].qd).max() == 0.0
        done.set()
        peer.rest(pause=0.004)

    with pytest.raises(ControllerLate, match=r"^The controller was too slow: one call took 0\.\d+ s") as caught:
        play(script, controller, play.link(clock="wall"), wait="block")
    table = caught.value.table
    assert play.peer.surplus() == 0
    assert table["late"].sum() > 10
    answered = np.asarray(table["seq_sent"], dtype=float)
    np.testing.assert_array_equal(answered[np.isfinite(answered)], np.arange(np.isfinite(answered).sum()))


def test_progress_and_extra_columns(play: Any) -> None:
    from armlab.log import Column

    told: list[tuple[float, float, str]] = []

    def controller(state: State) -> Command:
        return Command(sway(state).q, record={"mine": state.t})

    run = play(
        lambda peer: peer.rest(),
        controller,
        seconds=0.2,
        progress=lambda *what: told.append(what),
        extra={"mine": Column(unit="s")},
    )
    assert told == sorted(told)
    assert 2 <= len(told) <= 8
    mine = run.table["mine"]
    np.testing.assert_allclose(mine[2:50], run.table["session_t"][2:50])

"""The rehearsal does what the loop does, and nobody hears it."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.bridge.assembly import Rehearsal
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.torque import Admittance
from armlab.bridge.net.sockets import Arrival, Port
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Reference


class Recorded(EgmCodec):
    """Remembers what it encoded."""

    encoded: list[Reference]

    def encode(self, ref: Reference) -> bytes:
        self.encoded.append(ref)
        return super().encode(ref)


def test_it_encodes_what_the_loop_would(robot: Robot, packets: Any) -> None:
    codec = Recorded(robot)
    codec.encoded = []
    port = Port("127.0.0.1", 0, to_itself=True)
    rehearsal = Rehearsal(robot, Limits.of(robot), codec, port)
    for k in range(10):
        arrival = Arrival(packets(), ("127.0.0.1", 5), 4_000_000 * k)
        rehearsal(arrival, Command(robot.q_home + 1e-4 * k))
    assert [ref.seq for ref in codec.encoded] == list(range(10))
    np.testing.assert_allclose(codec.encoded[-1].q, robot.q_home + 9e-4)
    rehearsal(Arrival(b"garbage", ("127.0.0.1", 5), 0), None)
    assert len(codec.encoded) == 10
    port.close()


def test_it_asks_no_model_of_the_user(robot: Robot, packets: Any) -> None:
    """The model of an admittance may remember its calls, as a filter does: the rehearsal is none of them."""
    calls = []
    admittance = Admittance(np.ones(robot.n), lambda q, qd: np.array(calls.append(0) or np.zeros(robot.n)))
    port = Port("127.0.0.1", 0, to_itself=True)
    rehearsal = Rehearsal(robot, Limits.of(robot), EgmCodec(robot), port, admittance)
    for k in range(3):
        rehearsal(Arrival(packets(), ("127.0.0.1", 5), 4_000_000 * k), Command(tau=np.ones(robot.n)))
    assert not calls
    port.close()


def test_it_never_sends_and_changes_no_reference(play: Any) -> None:
    """A polling run, which rehearses, answers each packet once and exactly as one that blocks."""

    def steady(state: State) -> Command:
        return Command(state.q_start + 1e-5 * (state.seq - first.setdefault(state.session, state.seq)))

    first: dict[int, int] = {}

    def script(peer: Any) -> None:
        peer.begin()
        peer.rest(pause=0.004)

    run = play(script, steady, play.link(clock="wall"), wait="spin", seconds=0.2)
    assert play.peer.surplus() == 0
    assert run.statistics["replies"] + run.statistics["overtaken"] == run.statistics["packets"]
    commanded = run.table["q_ref"]
    rows = np.isfinite(commanded).all(axis=1) & ~run.table["clamped"].astype(bool).any(axis=1)
    np.testing.assert_array_equal(run.table["q_sent"][rows], commanded[rows])

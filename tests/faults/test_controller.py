"""A controller that raises, sleeps, or returns an invalid command; in virtual time.

One that closes file descriptors runs in a separate process in real time, so that the tests' own descriptors stay open.
Some rows of the matrix are slow.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from armlab import log
from armlab.errors import CommandRefused, ControllerFailed, ControllerLate, LinkError
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec

from .bench import LONGEST, PERIOD, ROBOT, Bench, Motion, SimulatedRobot, free_port, is_whole, judge, program
from .matrix import Cell, shows

BEGINS = {"holding": 0.0, "running": 0.3}
AFTER = 0.5  # s of motion after the fault


class Wrong(NamedTuple):
    """What the controller does, how often, and the exception that the run then raises."""

    does: Callable[[Bench, State], Any]
    times: float = np.inf
    failure: type[BaseException] | None = None


def raises(error: BaseException) -> Callable[[Bench, State], Any]:
    def does(bench: Bench, state: State) -> Any:
        raise error

    return does


def returns(make: Callable[[State], Any]) -> Callable[[Bench, State], Any]:
    return lambda bench, state: make(state)


def sleeps(seconds: float) -> Callable[[Bench, State], Any]:
    def does(bench: Bench, state: State) -> Any:
        bench.pass_time(seconds)
        return Command(qd=np.full(7, 0.2))

    return does


def nan(state: State) -> Command:
    return Command(np.full(7, np.nan))


JUMP = returns(lambda state: Command(state.q_start + 0.5))
WRONG = {
    "raises": Wrong(raises(ValueError("bad luck")), 1, ControllerFailed),
    "exits": Wrong(raises(SystemExit(1)), 1, ControllerFailed),
    "runs out of memory": Wrong(raises(MemoryError()), 1, ControllerFailed),
    "returns no Command": Wrong(returns(lambda state: "left"), 1, CommandRefused),
    "returns a wrong shape": Wrong(returns(lambda state: Command(state.q[:6])), 1, CommandRefused),
    "returns NaN repeatedly": Wrong(returns(nan), np.inf, CommandRefused),
    "returns an infinite speed": Wrong(returns(lambda state: Command(qd=np.full(7, np.inf))), np.inf, CommandRefused),
    "returns a jump repeatedly": Wrong(JUMP, np.inf, CommandRefused),
    "is late repeatedly": Wrong(sleeps(0.0035), np.inf, ControllerLate),
    "sleeps for seconds": Wrong(sleeps(1.5), 1, ControllerLate),
    "returns nothing": Wrong(returns(lambda state: None), 50),
    "returns NaN once": Wrong(returns(nan), 1),
    "returns a jump once": Wrong(JUMP, 1),
    "begins far from the arm position": Wrong(returns(lambda state: Command(state.q_start + 0.06)), 300),
    "is late once": Wrong(sleeps(0.0035), 1),
    "takes half of the period": Wrong(sleeps(0.5 * PERIOD), 50),
}


@shows
def test_the_run_ends(bench: Bench, cell: Cell) -> None:
    wrong, good, at = WRONG[cell.fault], Motion(), BEGINS[cell.state]
    done = [0]

    def script(t: float, state: State) -> Any:
        if t < at or done[0] >= wrong.times:
            return good(t, state)
        done[0] += 1
        return wrong.does(bench, state)

    outcome = bench.run(script)
    assert type(outcome.failure) is wrong.failure
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    assert not bench.heard()[-1].qd.any(), "it came to rest"
    assert np.ptp([reply.q for reply in bench.heard()[-50:]], axis=0).max() < 1e-9, "and rested"
    gaps = np.diff([sent.t for sent in bench.sent])
    assert gaps.max() < 2.0 * PERIOD, "no packet had to wait for the controller"
    failure: Any = outcome.failure
    assert len(failure.table) > 100, "the error has the last rows"
    bench.move_again()


CLOSES = """
import os
import sys
import numpy as np
from armlab import bridge, robots
from armlab.errors import ControllerFailed
from armlab.state import Command
port, path, phase, own = sys.argv[1:]
files = []
def controller(state):
    if state.t > 0.3 and not files:
        os.closerange(3, 1000)
        files.extend(open(f"{own}{k}", "w") for k in range(8))
    return None if phase == "holding" else Command(state.q_start + 0.1 * (1.0 - np.cos(4.0 * state.t)))
with bridge.connect(f"egm://127.0.0.1:{port}", robots.load("yumi_right"), offer=f"closes-{port}") as link:
    try:
        link.run(controller, record=path)
    except ControllerFailed as error:
        print(error, len(error.table))
    print(link.last.statistics["packets"], *link.last.statistics["problems"])
    print(link.run(controller, seconds=0.3).reason)
for file in files:
    file.write("theirs")
    file.close()
"""


@shows
def test_the_bridge_outlives_its_descriptors(cell: Cell, tmp_path: Path) -> None:
    """The controller's own files, which reuse the descriptors of the socket and the log, are left alone."""
    port, path, own = free_port(), tmp_path / "run.mcap", tmp_path / "own"
    robot = SimulatedRobot(tmp_path, port)
    words = ("-c", CLOSES, str(port), str(path), cell.state, str(own))
    with robot.running(), program(*words) as bridge:
        told, errors = bridge.communicate(timeout=LONGEST)
        assert bridge.returncode == 0, errors
    first, counted, again = told.splitlines()
    assert cell.is_told(first)
    assert again == "the time is up"
    assert "Traceback" not in errors
    assert log.inspect(path).finished
    table = log.read(path)
    is_whole(table)
    assert counted == str(len(table)), "every packet has a row, and the log has no problem"
    sent = table["qd_sent"][np.isfinite(table["qd_sent"]).all(axis=1)]
    assert sent.any() == (cell.state == "running")
    rests = np.asarray(table.t) > table.t[-1] - 0.3
    assert not np.nan_to_num(table["qd_sent"][rests]).any(), "the arm came to rest and stayed at rest"
    assert table["t"][-1] > 0.7
    assert [Path(f"{own}{k}").read_text() for k in range(8)] == ["theirs"] * 8
    robot.judge()


@shows
def test_the_run_goes_on(bench: Bench, cell: Cell) -> None:
    wrong, good, at = WRONG[cell.fault], Motion(), BEGINS[cell.state]
    done, over = [0], [0.0]

    def script(t: float, state: State) -> Any:
        if t < at or done[0] >= wrong.times:
            return good(t, state)
        done[0] += 1
        over[0] = t
        made = wrong.does(bench, state)
        if made is None:
            good.begin_anew()  # else its first position would be too far away
        return made

    outcome = bench.run(script, seconds=at + 300 * PERIOD * (wrong.times > 100) + AFTER + 0.3)
    assert outcome.failure is None
    assert outcome.run.reason == "the time is up"
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    gaps = np.diff([sent.t for sent in bench.sent])
    assert gaps.max() < 2.0 * PERIOD, "no packet had to wait for the controller"
    moved = [reply.q for reply, sent in zip(bench.heard(), bench.sent, strict=True) if sent.t > over[0]]
    assert np.ptp(moved, axis=0).min() > 0.01, "it moves again"


@shows
def test_a_codec_raises(bench: Bench, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """One packet gets no reply; the next reply is one step from the last one sent."""
    raised = [False]
    encode = EgmCodec.encode

    def broken(codec: EgmCodec, reference: Any) -> bytes:
        if bench.now >= 0.3 and not raised[0]:
            raised[0] = True
            raise ZeroDivisionError("division by zero")
        return encode(codec, reference)

    monkeypatch.setattr(EgmCodec, "encode", broken)
    motion = Motion.that_stops(0.3) if cell.state == "stopping" else Motion()
    motion.holds = (0.0, 1.0 if cell.state == "holding" else 0.0)
    outcome = bench.run(motion, seconds=0.6)
    assert type(outcome.failure) is LinkError
    assert cell.is_told(str(outcome.failure))
    judge(bench, outcome)
    assert not bench.heard()[-1].qd.any(), "it came to rest"
    bench.move_again()


@shows
def test_it_is_not_called(bench: Bench, cell: Cell) -> None:
    robot, calls = bench.stations[0], [0]
    robot.alive = cell.state == "stopping"
    bench.at[0.3] = lambda: setattr(robot, "alive", True)

    def script(t: float, state: State) -> Command:
        calls[0] += 1
        assert t >= 0.3 or cell.state == "stopping"
        return Command.stop()

    outcome = bench.run(script)
    judge(bench, outcome)
    assert calls[0] == 1
    assert len(bench.sent) > 100
    assert ROBOT.n == len(bench.heard()[-1].q)

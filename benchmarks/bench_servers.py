"""Loop of a complete cell with all servers enabled, and with clients that stop reading."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from blocks import Contender, Figure, Table, alternate, figures
from path_ends import ROBOT
from path_runs import PATIENCE, SETTLED, Reader, Received
from ros_paths import ONE_EACH, WAYS, Way

from armlab import bridge, robots
from armlab.bridge.cell import parse_cell, run_cell
from armlab.errors import ArmlabError, LinkError

ARMS = (ROBOT, "yumi_right")
MORE = 1.5  # factor on the reply time without servers, median and 99th percentile
SHARE = 0.001  # allowed share of missing messages of other clients
RATE = 248  # packets of an arm per second
SLOWED = (
    f"In real time, an arm sends {RATE} packets per second. If fewer than 95 % of them arrived, the simulator lacked "
    "processor time, and the targets are not checked."
)
TOGETHER = 4  # servers with a stalled client at a time; more would overload two cores
TRIES = 3  # attempts to start all servers at once
ENOUGH = 10**9  # messages of a client that reads until terminated


class Window(NamedTuple):
    """Loop while clients read: times from arrival to reply [s]; ticks, and missed or late ticks; duration [s]."""

    answer: np.ndarray
    ticks: int
    missed: int
    seconds: float


class Slow(NamedTuple):
    """One run with stalled clients: the loop, and per path the messages of the other client and the run statistics."""

    loop: Window
    others: Mapping[str, Received]
    reported: Mapping[str, Mapping[str, Any]]


def run(quick: bool) -> list[Table]:
    """Measure runs without and with all servers alternately, then a few servers at a time with stalled clients."""
    rounds, seconds, long = (1, 3.0, 3.0) if quick else (5, 6.0, 40.0)
    with ExitStack() as opened:
        ways = {name: way for name in ONE_EACH if (way := WAYS[name](opened)) is not None}
        loops: list[list[Window]] = [[], []]

        def block(k: int) -> np.ndarray:
            loops[k].append(_all_on(list(ways.values()), seconds) if k == 0 else _alone(seconds))
            return loops[k][-1].answer

        contenders = [Contender("", lambda: block(0)), Contender("", lambda: block(1))]
        samples = alternate(contenders, rounds, warm=False)
        names = list(ways)
        groups = [names[k : k + TOGETHER] for k in range(0, len(names), TOGETHER)]
        slow = [_slow({name: ways[name] for name in group}, long) for group in groups]
    text = (
        f"Two arms simulated in real time over EGM by another process, {seconds:g} s per run after all clients have "
        f"read for {SETTLED:g} s; the arms hold. *With* means one server for each of "
        f"{', '.join(way.server for way in ways.values())}, each with one client that reads joint states and wrenches, "
        "or rows (the simulated arms have no force sensor, so no wrenches arrive). *Without* means only the loop. The "
        f"simulator, loop, servers and clients ({2 + 2 * len(ways)} processes, more with ROS 1) share the machine's "
        f"{os.cpu_count()} cores. The loop therefore also waits for the clients and the simulator, which would run on "
        f"other computers with a real robot. All runs record a log. Runs with and without servers alternate. {SLOWED}"
    )
    return [*_loops(text, loops, samples, rounds), *_slows(slow, loops[1], long)]


def _loops(text: str, loops: list[list[Window]], samples: list[list[np.ndarray]], rounds: int) -> list[Table]:
    def table(
        title: str,
        unit: str,
        blocks: list[list[np.ndarray]],
        reduce: Callable[..., Any],
        ratio: float | None = None,
        more: float | None = None,
    ) -> Table:
        judged = all(map(_kept_up, loops))
        allowed = float(np.median([reduce(one) for one in blocks[1]])) + more if judged and more is not None else None
        notes = [_counted(one) for one in loops]
        both = [
            Contender("all servers, a client each", lambda: np.zeros(0), "armlab", allowed, notes[0]),
            Contender("no servers", lambda: np.zeros(0), bar=ratio if judged else None, note=notes[1]),
        ]
        return Table(f"Loop with all servers on: {title}", text, unit, figures(both, blocks, reduce), rounds)

    shares = [[np.array([w.missed / w.ticks]) for w in one] for one in loops]
    return [
        table("answer, median", "µs", samples, np.median, MORE),
        table("answer, 99th percentile", "µs", samples, lambda one: np.percentile(one, 99.0), MORE),
        table("ticks missed, overtaken or late", "%", shares, np.median, more=0.0),
    ]


def _slows(slow: Sequence[Slow], alone: Sequence[Window], seconds: float) -> list[Table]:
    text = (
        f"Two simulated arms and up to {TOGETHER} servers. One client of each server begins to read and is then "
        f"stopped by a signal for the rest of the run. Another client reads for {seconds:g} s, counted from "
        f"{SETTLED:g} s after its first message. *Reported* gives the run statistics: rows not accepted by the server "
        f"and messages dropped for clients. The DDS, Zenoh and ROS 1 libraries do not report dropped messages to the "
        "server. Datagrams for PlotJuggler go to only one program, so there is no other client. "
        f"{SLOWED}"
    )
    allowed = float(np.median([one.missed / one.ticks for one in alone]))
    others: list[Figure] = []
    loops: list[Figure] = []
    for one in slow:
        judged = _kept_up([one.loop])
        for name, other in one.others.items():
            note = f"{other.received} of {other.due} messages, in order; {_reported(one.reported[name])}"
            others += _row(name, other.missing, SHARE if judged else None, note)
        share, note = one.loop.missed / one.loop.ticks, _counted([one.loop])
        loops += _row("; ".join(one.reported), share, allowed if judged else None, note)
    return [
        Table("A client stands still: messages that another misses", text, "%", tuple(others), 1),
        Table("A client stands still: ticks missed, overtaken or late", text, "%", tuple(loops), 1),
    ]


def _row(name: str, value: float, bar: float | None, note: str) -> tuple[Figure, ...]:
    return figures([Contender(name, lambda: np.zeros(0), "armlab", bar, note)], [[np.array([value])]])


def _kept_up(loops: Sequence[Window]) -> bool:
    """Return whether the simulator kept up with real time."""
    return min(one.ticks / one.seconds / len(ARMS) for one in loops) > 0.95 * RATE


def _counted(loops: Sequence[Window]) -> str:
    ticks, seconds = sum(one.ticks for one in loops), sum(one.seconds for one in loops)
    rate = ticks / seconds / len(ARMS)
    return f"{sum(one.missed for one in loops)} of {ticks} ticks missed or late; {rate:.0f} per second and arm"


def _reported(said: Mapping[str, Any]) -> str:
    clients = said["clients"]
    dropped = "unknown" if clients is None else sum(dropped for _, dropped in clients.values())
    return f"reported: {said['lost']} rows lost, {dropped} messages dropped"


def _all_on(ways: Sequence[Way], seconds: float) -> Window:
    def script(opened: ExitStack) -> tuple[int, int]:
        readers = [opened.enter_context(Reader(way.reader(ENOUGH), way.environment)) for way in ways]
        for reader in readers:
            reader.begun()
        return _passed(seconds)

    found, (begin, end) = _played(ways, script)
    return _window(found, begin, end)


def _alone(seconds: float) -> Window:
    started = threading.Event()

    def script(opened: ExitStack) -> tuple[int, int]:
        started.wait(PATIENCE)
        return _passed(seconds)

    def hold(state: Any) -> None:
        started.set()

    arms = [robots.load(name) for name in ARMS]
    with bridge.connect([f"sim://{name}" for name in ARMS], arms, patience=PATIENCE) as link, _Script(script) as told:
        told.start()
        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(KeyboardInterrupt):
            link.run(hold, record=Path(folder) / "run.mcap")
        return _window(link.last, *told.result())


def _slow(ways: Mapping[str, Way], seconds: float) -> Slow:
    kept: dict[str, Reader] = {}

    def script(opened: ExitStack) -> tuple[int, int]:
        for way in ways.values():
            still = opened.enter_context(Reader(way.reader(ENOUGH), way.environment))
            still.begun()
            os.kill(still.process.pid, signal.SIGSTOP)
        for name, way in ways.items():
            if way.server != "plotjuggler":
                kept[name] = Reader(way.reader(ENOUGH), way.environment)
        for reader in kept.values():
            reader.begun()
        begin, end = _passed(seconds)
        for reader in kept.values():
            reader.process.terminate()  # on termination, it prints the received messages
            reader.wait(PATIENCE)
        return begin, end

    try:
        found, (begin, end) = _played(list(ways.values()), script)
        sent = np.asarray(found.arms[0].table["receive_ns"])
        told = found.arms[0].statistics["servers"]
        return Slow(
            _window(found, begin, end),
            {name: reader.received(sent, "J") for name, reader in kept.items()},
            {name: told[way.server] for name, way in ways.items()},
        )
    finally:
        for reader in kept.values():
            reader.__exit__(None, None, None)


def _passed(seconds: float) -> tuple[int, int]:
    """Return the beginning and end of the measured interval [ns, wall clock]."""
    time.sleep(SETTLED)
    begin = time.time_ns()
    time.sleep(seconds)
    return begin, time.time_ns()


def _played(ways: Sequence[Way], script: Callable[[ExitStack], tuple[int, int]]) -> tuple[Any, tuple[int, int]]:
    """Run a cell while a script acts as its clients; the run ends when the script ends."""
    robot_tables = "".join(f'[[robots]]\nname = "{name}"\nlink = "sim://{name}"\n' for name in ARMS)
    found: list[Any] = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        text = f'record = "{folder}/run.mcap"\n{robot_tables}'
        for way in ways:
            if way.server == "local":  # every cell has this server at the path that its client expects
                os.environ["XDG_RUNTIME_DIR"] = way.environment["XDG_RUNTIME_DIR"]
            else:
                table = way.table.replace(f"{ROBOT} = 0", ", ".join(f"{name} = 0" for name in ARMS))
                text += f"[servers.{way.server}]\n{table}\n"
        told, cell = _Script(script), parse_cell(text)
        for left in reversed(range(TRIES)):
            try:
                with told, contextlib.suppress(KeyboardInterrupt):
                    run_cell(cell, patience=PATIENCE, ready=lambda line: told.start(), ended=found.append)
                break
            except LinkError:  # some servers did not start in time on a loaded machine
                if found or not left:
                    raise
    return found[0], told.result()


class _Script:
    """Runs the clients in a thread, and then ends the run like Ctrl-C."""

    def __init__(self, body: Callable[[ExitStack], tuple[int, int]]) -> None:
        self._body = body
        self._found: list[tuple[int, int] | BaseException] = []
        self._thread = threading.Thread(target=self._play, daemon=True)

    def __enter__(self) -> _Script:
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread.ident is not None:
            self._thread.join(PATIENCE)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def result(self) -> tuple[int, int]:
        """Return the result of the script, or raise its exception."""
        if not self._found:
            raise ArmlabError("Expected the clients of a run to finish, but the run ended earlier.")
        if isinstance(self._found[0], BaseException):
            raise self._found[0]
        return self._found[0]

    def _play(self) -> None:
        with ExitStack() as opened:
            try:
                self._found.append(self._body(opened))
            except BaseException as error:
                self._found.append(error)
            os.kill(os.getpid(), signal.SIGINT)


def _window(run: Any, begin: int, end: int) -> Window:
    """Return the loop statistics of both arms in an interval."""
    answers, ticks, missed = [], 0, 0
    for arm in run.arms:
        table = arm.table
        came = table["receive_ns"]
        inside = (came >= begin) & (came < end)
        answered = inside & (table["send_ns"] > 0)
        answers.append(1e-9 * (table["send_ns"] - came)[answered])
        lost = int(np.sum(table["missed"][inside]))
        ticks += int(np.sum(inside)) + lost
        missed += lost + int(np.sum(inside & ~answered)) + int(np.sum(table["late"][answered]))
    return Window(np.concatenate(answers), ticks, missed, 1e-9 * (end - begin))

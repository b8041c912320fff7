"""Real-time soak test: `armlab bridge` with two arms, all servers, and ten clients, one of which sends commands.

The simulated arms have no masses, and the commanding client sleeps until a row arrives, because two cores must run
all programs. With a real robot, neither the arms nor that client would use the bridge computer's cores.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from soak.processes import Watch, family, label
from soak.programs import Program

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent / "benchmarks"))

from ros_paths import ONE_EACH, WAYS, Way  # noqa: E402

__all__ = ["ARMS", "COMMANDER", "run"]

ARMS = ("yumi_left", "yumi_right")
COMMANDER = "commander"
_LOOKS = 300  # samples per process and run
_SERVED = "ros2", "rmw_zenoh", "zenoh", "rosbridge", "plotjuggler", "labcomm", "local"  # and ros1 if installed


def run(folder: Path, seconds: float) -> dict[str, Any]:
    """Run the test and return its description; see `series.description`.

    Parameters
    ----------
    folder : output folder. seconds : measured duration [s].
    """
    with ExitStack() as opened:
        ways = [way for name in ONE_EACH if (way := WAYS[name](opened)) is not None]
        served = [way.server for way in ways]
        socket = next(way for way in ways if way.server == "local")
        (folder / "cell.toml").write_text(_cell(ways, folder / "run-.mcap"))
        words = [sys.executable, "-m", "armlab", "bridge", "--config", str(folder / "cell.toml")]
        bridge = opened.enter_context(Program("bridge", words, folder, socket.environment))
        bridge.await_word("Listening:")
        readers = [opened.enter_context(one) for one in _readers(ways, folder)]
        for reader in readers:
            reader.await_word("reading")
        commander = opened.enter_context(Program(COMMANDER, _commands(ways, folder), folder))
        commander.await_word("ready")
        begin, end, cut_off = _watched(folder, bridge, commander, seconds)
        statuses = {COMMANDER: commander.end(signal.SIGINT)}
        statuses["bridge"] = bridge.end(signal.SIGINT)
        for reader in readers:
            reader.end()
    return {
        "part": "real time",
        "seconds": seconds,
        "begin": begin,
        "end": end,
        "cut_off": cut_off,
        "servers": served,
        "without": [name for name in ("ros1", *_SERVED) if name not in served],
        "clients": [one.name for one in readers],
        "statuses": statuses,
    }


def _watched(folder: Path, bridge: Program, commander: Program, seconds: float) -> tuple[int, int, str]:
    """Monitor the processes; return the beginning and end [ns, wall clock], and the reason for an early end."""

    def processes() -> Iterator[tuple[int, str]]:
        yield commander.process.pid, COMMANDER
        for pid in family(bridge.process.pid):
            with contextlib.suppress(OSError):
                yield pid, label(pid, bridge.process.pid)

    begin, until, reported, cut_off = time.time_ns(), time.monotonic() + seconds, 0.0, ""
    with Watch(folder / "held.csv", max(seconds / _LOOKS, 0.5), processes) as watch:
        try:
            while (left := until - time.monotonic()) > 0.0 and bridge.process.poll() is None:
                if seconds - left >= reported:
                    print(f"  {seconds - left:.0f} of {seconds:.0f} s", flush=True)
                    reported += seconds / 10.0
                watch.pause(min(left, 1.0))
        except KeyboardInterrupt:
            cut_off = "a signal"
        return begin, time.time_ns(), cut_off


def _cell(ways: Sequence[Way], record: Path) -> str:
    text = f'commands = ["zenoh"]\nrecord = "{record}"\n'
    text += "".join(f'[[robots]]\nname = "{name}"\nlink = "sim://{name}?lagging=true"\n' for name in ARMS)
    for way in ways:
        if way.server != "local":  # present in every cell
            table = way.table.replace(f"{ARMS[0]} = 0", ", ".join(f"{name} = 0" for name in ARMS))
            text += f"[servers.{way.server}]\n{table}\n"
    return text


def _readers(ways: Sequence[Way], folder: Path) -> Iterator[Program]:
    """Yield a reader for each server, and a `ZenohFeed` as a second reader over Zenoh."""
    for way in ways:
        yield Program(f"reader of {way.server}", way.reader(0), folder, way.environment)
    words = [sys.executable, str(HERE.parent / "benchmarks" / "path_feed.py"), "zenoh", _zenoh(ways), "0"]
    yield Program("feed of zenoh", words, folder)


def _commands(ways: Sequence[Way], folder: Path) -> list[str]:
    """Return the command that starts the program moving both arms."""
    words = [sys.executable, "-m", "armlab", "run", "+".join(ARMS), str(HERE / "sway.py")]
    words += ["--link", ",".join(len(ARMS) * [f"{_zenoh(ways)}/lab"]), "--wait", "block"]
    return [*words, "--log", str(folder / COMMANDER)]


def _zenoh(ways: Sequence[Way]) -> str:
    port = next(way.table for way in ways if way.server == "zenoh").split("port = ")[1].split()[0]
    return f"zenoh://127.0.0.1:{port}"

"""The soak test: resources are counted, the verdict finds each fault and nothing else, clients leave nothing behind."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.labcomm import LabCommClient
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.errors import ArmlabError
from soak import verdict
from soak.judged import judged
from soak.processes import HEAD, Watch, family, held, label
from soak.programs import Program
from soak.series import Held, Recorded
from tests.processes import free_port, until

MIB = 2**20
T = np.linspace(0.0, 1800.0, 300)  # s: half an hour at 250 Hz, as the soak in real time
TICKS = 250.0 * T
SEEDS = range(4)


def scattered(seed: int) -> np.ndarray:
    """Memory that fills at first, then comes and goes in arenas, and has bursts."""
    rng = np.random.default_rng(seed)
    arenas = rng.integers(0, 2, len(T)) * verdict.ARENA
    bursts = (rng.uniform(size=len(T)) < 0.1) * rng.uniform(0.0, 30.0 * MIB, len(T))
    return 40.0 * MIB + np.minimum(T, 400.0) / 400.0 * 20.0 * MIB + arenas + bursts


def late(seed: int) -> np.ndarray:
    """Delays [s] on a machine that is busy for minutes at a time."""
    rng = np.random.default_rng(seed)
    busy = np.repeat(rng.uniform(1.0, 5.0, 20), 15)
    return 4e-4 * (1.0 + busy * rng.exponential(0.5, len(T)))


@pytest.mark.parametrize("seed", SEEDS)
def test_memory_that_leaks_16_bytes_per_tick_is_found_and_what_scatters_is_not(seed: int) -> None:
    """The bound is 2 MiB in the second half: 9 bytes per tick in half an hour. The test fails if the slope is
    taken over the whole run."""
    held = scattered(seed)
    assert verdict.memory("", T, held).is_met
    assert not verdict.memory("", T, held + 16.0 * TICKS).is_met
    assert verdict.growth(T, held + 16.0 * TICKS) == pytest.approx(16.0 * 225e3, rel=0.4)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_descriptor_that_is_lost_is_found_and_those_that_come_and_go_are_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    held = 20 + 5 * (rng.uniform(size=len(T)) < 0.2)
    held[-1] = 3  # sampled while the process ended
    assert verdict.count("", held).is_met
    assert not verdict.count("", held + (0.6 * T[-1] < T)).is_met


@pytest.mark.parametrize("seed", SEEDS)
def test_delays_that_double_from_quarter_to_quarter_are_found_and_a_busy_machine_is_not(seed: int) -> None:
    seconds = late(seed)
    assert verdict.delay("", seconds).is_met
    assert not verdict.delay("", seconds * (1.0 + 4.0 * T / T[-1])).is_met, "five times as long in the end"
    assert not verdict.delay("", seconds + 1e-6 * T).is_met, "a queue that grows by 1 us a second"


def test_too_little_is_no_proof() -> None:
    some = np.arange(3.0)
    for finding in (verdict.memory("", some, some), verdict.count("", some), verdict.delay("", some)):
        assert not finding.is_met
    assert not verdict.memory("", np.zeros(0), np.zeros(0)).is_met


PROCESSES = ("loop and recorder", "simulator", "server zenoh", "commander")


def well() -> dict[str, Any]:
    """Results of a run in which nothing grows."""
    rng = np.random.default_rng(0)
    fast, late = (s * (1.0 + rng.exponential(0.3, len(T))) for s in (3e-4, 9e-4))
    counted = {"packets": 446429, "dropped": 0, "seconds": 1800.0}
    one = Recorded(T, fast, late, np.zeros(len(T)), 446429, counted, True, ("recording yumi_left",), 1800.0)
    still = {"descriptors": np.full(len(T), 9.0), "threads": np.full(len(T), 3.0), "cpu": 0.01 * T}
    held = {name: Held(T, {"memory": 4e7 + 2e5 * rng.normal(size=len(T)), **still}) for name in PROCESSES}
    reader = np.column_stack([T, np.full(len(T), 1500.0), 2e-3 * np.ones(len(T)), 5e-3 * np.ones(len(T))])
    about = {
        "part": "real time", "seconds": 1800.0, "servers": ["zenoh"], "begin": 0, "end": int(1800e9), "cut_off": "",
        "statuses": {"bridge": 0, "commander": 130},
    }  # fmt: skip
    return {"about": about, "held": held, "recorded": {"run-left": one}, "clients": {"reader of zenoh": reader}}


Fault = Callable[[dict[str, Any]], Any]


def about(**values: Any) -> Fault:
    return lambda run: run["about"].update(values)


def recorded(**values: Any) -> Fault:
    return lambda run: run["recorded"].update({"run-left": run["recorded"]["run-left"]._replace(**values)})


def of(process: str, key: str, change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def fault(run: dict[str, Any]) -> None:
        values = run["held"][process].values
        values[key] = change(values[key])

    return fault


def together(*faults: Fault) -> Fault:
    return lambda run: [fault(run) for fault in faults]


def cut(run: dict[str, Any]) -> None:
    t, values = run["held"]["simulator"]
    run["held"]["simulator"] = Held(t[:293], {key: one[:293] for key, one in values.items()})


def delayed(run: dict[str, Any]) -> None:
    run["clients"]["reader of zenoh"][:, 2] += 2e-6 * T


LATE, SHORT = T[200] < T, "duration, shorter than requested by"
FAULTS: dict[str, tuple[Fault, str]] = {
    "ends early": (about(end=int(1760e9)), SHORT),
    "ends early in lockstep": (together(about(part="lockstep"), recorded(seconds=1760.0)), SHORT),
    "says not how long it was to be": (lambda run: run["about"].pop("seconds"), SHORT),
    "is cut off": (about(cut_off="--most"), "cut off by --most"),
    "is no more looked at": (cut, "simulator: last sample, before the end"),
    "leaks": (of("server zenoh", "memory", lambda one: one + 4e3 * T), "server zenoh: memory, growth"),
    "loses a descriptor": (of("simulator", "descriptors", lambda one: one + LATE), "simulator: descriptors"),
    "gains a thread": (of("commander", "threads", lambda one: one + LATE), "commander: threads"),
    "starts anew": (of("simulator", "cpu", lambda one: one - 5.0 * (T[150] < T)), "simulator: restarts"),
    "is not there": (lambda run: run["held"].pop("server zenoh"), "server zenoh: processes"),
    "gets later": (delayed, "reader of zenoh: stamp to receipt"),
    "falls silent": (
        lambda run: run["clients"].update({"reader of zenoh": run["clients"]["reader of zenoh"][:290]}),
        "reader of zenoh: without messages at the end",
    ),
    "ends with an error": (about(statuses={"bridge": 1, "commander": 130}), "bridge: status"),
    "slow": (recorded(p50=3e-4 * (1.0 + T / 300.0)), "run-left: arrival to reply, median"),
    "slow at times": (recorded(p99=9e-4 * (1.0 + T / 300.0)), "run-left: arrival to reply, 99 %"),
    "row lost": (recorded(rows=446428), "run-left: readable rows"),
    "unfinished": (recorded(is_whole=False, summary={}), "run-left: recordings finished"),
    "dropped": (recorded(summary={"packets": 446429, "dropped": 1, "seconds": 1800.0}), "run-left: rows dropped"),
    "too slow": (recorded(summary={"packets": 400000, "dropped": 0, "seconds": 1800.0}), "run-left: packets skipped"),
    "server ended": (
        recorded(events=("The server zenoh ended. The server restarts in 1 s.",)),
        "run-left: servers that",
    ),
}


def test_nothing_is_found_where_all_was_well() -> None:
    found = judged(**well())
    assert [str(one) for one in found if not one.is_met] == []
    assert len(found) == 2 + 5 * len(PROCESSES) + 7 + 2 + 2


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found(fault: str) -> None:
    run = well()
    happens, words = FAULTS[fault]
    happens(run)
    failed = [one.what for one in judged(**run) if not one.is_met]
    assert any(what.startswith(words) for what in failed)
    assert len(failed) == 1 or fault in ("unfinished", "row lost", "too slow"), failed


def test_memory_and_descriptors_of_a_process_are_counted(tmp_path: Path) -> None:
    """Fails if file pages count, or if only memory resident at the start does."""
    memory, descriptors, threads, cpu = held(os.getpid())
    files = [(tmp_path / f"{k}").open("w") for k in range(5)]
    try:
        more = bytearray(os.urandom(1)) * 2**25
        after = held(os.getpid())
    finally:
        for file in files:
            file.close()
    assert abs(after[0] - memory - len(more)) < 2**21
    assert after[1] == descriptors + 5
    assert after[2] == threads >= 1
    assert after[3] >= cpu > 0.0
    assert next(family(os.getpid())) == os.getpid()
    assert label(os.getpid(), os.getpid()) == "loop and recorder"


def test_what_a_process_started_belongs_to_it_until_it_ends() -> None:
    words = [sys.executable, "-c", "print(flush=True); input()", "-m", "armlab.bridge.servers.serve", "zenoh"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            child.stdout.readline()  # before that, the kernel may not have its arguments yet
            assert child.pid in family(os.getpid())
            assert label(child.pid, os.getpid()) == "server zenoh"
        finally:
            child.communicate(b"\n")
    assert child.pid not in family(os.getpid())
    with pytest.raises(OSError, match=r"No such"):
        held(child.pid)


def test_the_last_look_is_at_the_end(tmp_path: Path) -> None:
    with Watch(tmp_path / "held.csv", 1e3, lambda: iter([(os.getpid(), "me")])) as watch:
        while not (tmp_path / "held.csv").exists() or "me" not in (tmp_path / "held.csv").read_text():
            watch.pause(0.01)
    head, *looks = (tmp_path / "held.csv").read_text().splitlines()
    assert head == HEAD
    assert [look.split(",")[1] for look in looks] == ["me", "me"], "at the begin, and when it was over"


def test_who_waits_is_told_that_nobody_looks_any_more(tmp_path: Path) -> None:
    """Fails if the thread merely ends: the run would continue without it and be judged on incomplete data."""

    def processes() -> Iterator[tuple[int, str]]:
        yield os.getpid(), "me"
        raise OSError(28, "No space left on device")

    for seconds in (10.0, 0.0):  # a waiting caller, and one that reaches the end of the run
        watch = Watch(tmp_path / "held.csv", 1e-3, processes)
        with pytest.raises(ArmlabError, match=r"until the end, got OSError\(28, 'No space"), watch:
            watch.pause(seconds)


ROOT = Path(__file__).parents[2]


def soaked(part: str, seconds: float, folder: Path) -> dict[str, dict[str, object]]:
    """Run a part of the soak test and return its findings by subject."""
    words = [sys.executable, str(ROOT / "soak" / "run.py"), part, "--seconds", str(seconds), "--folder", str(folder)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=500.0, check=False)
    assert (folder / "result.json").exists(), ended.stdout + ended.stderr
    result = json.loads((folder / "result.json").read_text())
    assert (folder / "soak.png").stat().st_size > 10_000
    judged = {one["what"]: one for one in result["judged"]}
    assert all(one["what"] in ended.stdout for one in result["judged"])
    assert ended.returncode == (not all(one["is_met"] for one in result["judged"])), ended.stderr
    return judged


def failed(judged: dict[str, dict[str, object]]) -> list[str]:
    """Return the findings beyond their bounds, except those that a short run cannot judge."""
    short = ("memory, growth", "arrival to reply", "stamp to receipt", "packets skipped", "last sample")
    return [what for what, one in judged.items() if not one["is_met"] and not any(word in what for word in short)]


@pytest.mark.slow
def test_all_servers_and_ten_clients_in_real_time(tmp_path: Path) -> None:
    """Takes 30 s, more where the machine is busy."""
    for extra in ("zenoh", "cyclonedds", "websockets", "xxhash"):
        pytest.importorskip(extra)
    judged = soaked("real_time", 4.0, tmp_path)
    assert failed(judged) == []
    servers = ("ros2", "rmw_zenoh", "rosbridge", "zenoh", "plotjuggler", "labcomm", "local")
    assert all(f"server {name}: restarts (0 of 0), difference" in judged for name in servers)
    assert any(what.startswith("run-right: readable rows") for what in judged)
    assert any(what.startswith("commander left: readable rows") for what in judged)


@pytest.mark.slow
def test_lockstep(tmp_path: Path) -> None:
    """Takes 10 s."""
    judged = soaked("lockstep", 20.0, tmp_path)
    assert failed(judged) == []
    assert any(what.startswith("run: readable rows, of packets (50") for what in judged)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["--most", "a signal"])
def test_a_run_that_is_cut_off_is_judged_and_says_so(way: str, tmp_path: Path) -> None:
    """Takes 5 s each."""
    words = [sys.executable, str(ROOT / "soak" / "run.py"), "lockstep", "--folder", str(tmp_path)]
    words += ["--most", "1"] if way == "--most" else []
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        too_late = Timer(60.0, child.kill)
        too_late.start()
        said = ""
        while "Running" not in said:
            line = child.stdout.readline()
            assert line, said
            said += line
        if way != "--most":
            child.send_signal(signal.SIGTERM)
        said += child.stdout.read()
        too_late.cancel()
    assert child.returncode == 1
    assert f"FAIL cut off by {way}" in said
    assert "FAIL duration, shorter than requested by" in said
    assert "ok   run: recordings finished" in said


TOPIC = {"op": "subscribe", "topic": "/yumi_left/joint_states", "type": "sensor_msgs/msg/JointState"}


@pytest.fixture(scope="module")
def ports() -> dict[str, int]:
    return {name: free_port() for name in ("rosbridge", "labcomm", "zenoh")}


@pytest.fixture(scope="module")
def bridge(ports: dict[str, int], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    """A bridge with a simulated arm and a server of each tested kind; only these tests use its local socket."""
    folder = tmp_path_factory.mktemp("clients")
    text = '[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left?lagging=true"\n'
    text += f"[servers.labcomm]\nports = {{ yumi_left = 0 }}\nparameters = 0\nrows = {ports['labcomm']}\n"
    text += "".join(f"[servers.{name}]\nport = {ports[name]}\n" for name in ("rosbridge", "zenoh"))
    (folder / "cell.toml").write_text(text)
    words = [sys.executable, "-m", "armlab", "bridge", "--config", str(folder / "cell.toml")]
    with (
        pytest.MonkeyPatch.context() as patch,
        Program("bridge", words, folder, {"XDG_RUNTIME_DIR": str(folder)}) as it,
    ):
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        it.await_word("Listening:")
        yield it
        assert it.end(signal.SIGINT) in (0, 130)


def local(_: int) -> None:
    with LocalFeed() as feed:
        feed.ask(Subscribe(rate=None))
        for _ in range(5):
            feed.receive()


def labcomm(port: int) -> None:
    with LabCommClient(port=port) as client:
        for _ in range(2):
            list(client.events(1.0))


def rosbridge(port: int) -> None:
    client = pytest.importorskip("websockets.asyncio.client")

    async def visit() -> None:
        async with client.connect(f"ws://127.0.0.1:{port}", compression=None) as socket:
            await socket.send(json.dumps(TOPIC))
            for _ in range(3):
                await socket.recv()

    asyncio.run(visit())


def zenoh(port: int) -> None:
    feed = pytest.importorskip("armlab.bridge.servers.zenoh.feed").ZenohFeed(f"zenoh://127.0.0.1:{port}", patience=30.0)
    try:
        feed.ask(Subscribe(rate=None))
        feed.wait(5.0)
        feed.receive()
    finally:
        feed.close()


@pytest.mark.slow
@pytest.mark.parametrize(("visit", "count"), [(local, 30), (labcomm, 20), (rosbridge, 30), (zenoh, 3)])
def test_clients_that_come_and_go_leave_nothing_behind(
    bridge: Program, ports: dict[str, int], visit: Callable[[int], None], count: int
) -> None:
    """Three batches of clients: the second and third together cost the server at most 1 MiB.

    Takes 2 to 20 s each.
    """
    name = visit.__name__
    looks = []
    for _ in range(3):
        for _ in range(count):
            visit(ports.get(name, 0))
        looks.append(settled(bridge.process.pid, f"server {name}", looks))
    memory, descriptors, threads = zip(*looks, strict=True)
    assert memory[2] - memory[0] <= MIB
    assert max(descriptors) <= descriptors[0]
    assert max(threads) <= threads[0]


def settled(root: int, name: str, before: list[tuple[int, int, int]]) -> tuple[int, int, int]:
    """Return the resources that a server holds, once the last client's connection has been closed on its side too."""
    (pid,) = [one for one in family(root) if label(one, root) == name]

    def look() -> tuple[int, int, int]:
        return held(pid)[:3]

    looks = [look()]

    def is_still() -> bool:
        """Return whether twenty checks show no change; later batches also wait until they cost what the first did."""
        looks.append(look())
        return len({one[1:] for one in looks[-20:]}) == 1 and len(looks) >= 20

    until(is_still)
    if before:
        until(lambda: look()[1] <= before[0][1] and look()[2] <= before[0][2])
    return look()

"""Recorder: cost to the loop and the machine, data loss after a kill, and effect of a stalled disk."""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
from blocks import Contender, Disagreement, Figure, Table, alternate, figures
from mcap.writer import Writer
from recorder_kill import killed
from recorder_loop import in_the_loop
from recorder_rows import PERIOD, fresh, full_rows, signals
from recorder_stall import AFTER, BEFORE, stalled
from rosbags.typesys import Stores, get_typestore

from armlab import robots
from armlab.log import Recorder, Tick
from armlab.state import Command, State

ROBOT = "yumi_right"
BAR = 1.0  # relative to mcap.Writer and rosbags, which write two of the twelve topics
LOSS = 1.0  # s
TOGETHER = 4  # recording processes in parallel
PRIORITY = 50  # real-time priority, as in the bridge
Rows = list[tuple[State, Command, Tick]]


def run(quick: bool) -> list[Table]:
    """Measure rows in a paced loop, processor time, data loss after a kill, and a stalled disk."""
    with tempfile.TemporaryDirectory() as folder:
        return [
            *_row(Path(folder), 2.0 if quick else 3.0, 2 if quick else 3),
            _cpu(Path(folder), 3.0, 2 if quick else 3),
            _kill(Path(folder), 4 if quick else 20),
            _stall(Path(folder), 4.0 if quick else 15.0),
        ]


def _row(folder: Path, seconds: float, rounds: int) -> list[Table]:
    """Measure one call in the loop of the bridge, and in a bare loop that sleeps between calls."""
    robot, rows = robots.load(ROBOT), full_rows(500)

    def bare() -> np.ndarray:
        with Recorder(folder / "row.mcap", robot, extra=signals()) as recorder:
            taken = _paced(rows, seconds, lambda row: recorder.row(*row))
        recorder.path.unlink()
        return taken

    def theirs() -> np.ndarray:
        with (folder / "peer.mcap").open("wb") as file:
            return _paced(rows, seconds, _in_the_loop(file, robot.joint_names))

    samples = alternate(
        [
            Contender("in the loop", lambda: in_the_loop(folder, ROBOT, seconds)),
            Contender("in a bare loop", bare),
            Contender("peer", theirs),
        ],
        rounds,
    )
    tables = []
    for percent in (50, 99):
        note = "two of the twelve topics"
        contenders = [
            Contender(f"armlab Recorder.row in link.run, p{percent}", theirs, "armlab"),
            Contender(f"armlab Recorder.row in a bare loop, p{percent}", theirs, "armlab"),
            Contender(f"mcap.Writer and rosbags in a bare loop, p{percent}", theirs, bar=BAR, note=note),
        ]
        text = (
            f"First line: every call in a real-time run over `sim://{ROBOT}` whose controller returns references, a "
            f"wrench with its covariance and three numbers, so most of the recorded data have just been created. Other "
            f"lines: the full layout with noise in every number, as fresh arrays, in an otherwise empty loop, "
            f"so less of the recorder stays in the caches. {1 / PERIOD:g} Hz with sleep between calls, and real-time "
            f"priority if permitted. Percentile {percent} of a block of {seconds:g} s, wall-clock time."
        )
        told = figures(contenders, samples, lambda block, q=percent: np.percentile(block, q))
        tables.append(Table(f"Recorder: a row in the loop, p{percent}", text, "µs", told, rounds))
    return tables


def _paced(rows: Rows, seconds: float, work: Callable[[tuple[State, Command, Tick]], object]) -> np.ndarray:
    """Return the time of each call, with one call per period."""
    count = int(seconds / PERIOD)
    taken, due = np.empty(count), time.perf_counter()
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    try:
        for k in range(count):
            due += PERIOD
            time.sleep(max(0.0, due - time.perf_counter()))
            row = fresh(rows[k % len(rows)], k)
            start = time.perf_counter()
            work(row)
            taken[k] = time.perf_counter() - start
    finally:
        os.sched_setscheduler(0, *before)
    return taken


def _in_the_loop(file: object, names: tuple[str, ...]) -> Callable[[tuple[State, Command, Tick]], None]:
    """Return a writer without the recorder: JointState and WrenchStamped through the usual packages."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    writer = Writer(file)  # type: ignore[arg-type]
    writer.start("ros2", "bench")
    channels = {}
    topics = {"/joint_states": "sensor_msgs/msg/JointState", "/wrench": "geometry_msgs/msg/WrenchStamped"}
    for topic, name in topics.items():
        schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode())
        channels[name] = writer.register_channel(topic, "cdr", schema)
    vector = types["geometry_msgs/msg/Vector3"]

    def work(row: tuple[State, Command, Tick]) -> None:
        state, _, tick = row
        stamp = types["builtin_interfaces/msg/Time"](*divmod(tick.stamp_ns, 10**9))
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
        joints = types["sensor_msgs/msg/JointState"](header, list(names), state.q, state.qd, state.tau)
        wrench = types["geometry_msgs/msg/Wrench"](vector(*state.wrench_raw[:3]), vector(*state.wrench_raw[3:]))
        both = (joints, types["geometry_msgs/msg/WrenchStamped"](header, wrench))
        for (name, channel), message in zip(channels.items(), both, strict=True):
            data = bytes(store.serialize_cdr(message, name))
            writer.add_message(channel, tick.stamp_ns, data, tick.stamp_ns, tick.number)

    return work


def _cpu(folder: Path, seconds: float, rounds: int) -> Table:
    """Measure the processor time of the process with 30 signals, and of the same loop without a recorder."""
    robot, rows = robots.load(ROBOT), full_rows(500, only_signals=True)

    def share(work: Callable[[tuple[State, Command, Tick]], object]) -> float:
        start, wall = time.process_time(), time.perf_counter()
        _paced(rows, seconds, work)
        return (time.process_time() - start) / (time.perf_counter() - wall)

    def with_it() -> float:
        with Recorder(folder / "cpu.mcap", robot, extra=signals()) as recorder:
            taken = share(lambda row: recorder.row(*row))
        recorder.path.unlink()
        return taken

    def theirs() -> float:
        with (folder / "peer.mcap").open("wb") as file:
            return share(_in_the_loop(file, robot.joint_names))

    def more(work: Callable[[], float]) -> Callable[[], np.ndarray]:
        return lambda: np.array([work() - share(lambda _: None)])

    contenders = [
        Contender("armlab Recorder, minus the loop", more(with_it), "armlab"),
        Contender("mcap.Writer and rosbags, minus the loop", more(theirs), bar=BAR, note="two of the twelve topics"),
        Contender("the loop alone", lambda: np.array([share(lambda _: None)]), "limit"),
    ]
    text = (
        f"Processor time of all threads per second at {1 / PERIOD:g} Hz for q, qd, tau of 7 joints, a wrench, 3 user "
        f"columns and the tick data. Blocks of {seconds:g} s with and without the recorder alternate."
    )
    samples = alternate(contenders, rounds, warm=False)
    return Table("Recorder: processor time of a second", text, "s", figures(contenders, samples), rounds)


def _kill(folder: Path, trials: int) -> Table:
    """Kill processes with two recorders at random times; report how many seconds of rows each recorder lost."""
    with warnings.catch_warnings(), ThreadPoolExecutor(TOGETHER) as pool:
        warnings.simplefilter("ignore")  # about unfinished recordings
        losses = PERIOD * np.array(list(pool.map(killed, [folder / f"{k}" for k in range(trials)], range(trials))))
    text = (
        f"{trials} processes, {TOGETHER} at a time, each with two recorders and the full layout at {1 / PERIOD:g} Hz "
        "in real time, killed with signal 9 after 1 s to 4 s. Values are the seconds of recorded rows that cannot be "
        f"read. Metadata, attachments and events of all {2 * trials} files are complete; "
        f"{int((losses == 0).sum())} of the recorders lost no row. The first column is the worst loss, to which the "
        "target applies."
    )
    worst = _figure("armlab Recorder, the worst of two", losses.max(axis=1), LOSS)
    return Table("Recorder: lost when killed", text, "s of rows", (worst,), trials)


def _stall(folder: Path, seconds: float) -> Table:
    """Run a simulated arm with a responsive disk, and with a disk that stalls in mid-run."""
    free, held = (stalled(folder / name, ROBOT, seconds, still) for name, still in (("free", False), ("held", True)))
    for one in (free, held):
        if one.written + one.dropped != one.packets or one.told != one.dropped:
            raise Disagreement(
                f"Expected {one.packets} packets to be written or reported as dropped, got {one.written} rows and "
                f"{one.dropped} dropped, of which {one.told} are reported by events."
            )
    text = (
        f"`sim://{ROBOT}` at 250 Hz for {BEFORE + seconds + AFTER:g} s while the arm holds. In the second run, no "
        f"write or sync returns for {seconds:g} s. Times from arrival to reply are kernel time stamps of the ticks in "
        f"those {seconds:g} s. Without a stall: {free.missed} of {free.packets} packets missed, {free.late} late; "
        f"with a stall: {held.missed} of {held.packets} missed, {held.late} late, and {held.dropped} rows dropped, as "
        "reported in the summary and events."
    )
    told = (
        _figure("armlab bridge, disk stalled", held.latencies, None),
        _figure("armlab bridge, disk answers", free.latencies, None, "limit"),
    )
    return Table(f"Recorder: disk stalled for {seconds:g} s", text, "µs", told, 1)


def _figure(name: str, values: np.ndarray, bar: float | None, role: str = "armlab") -> Figure:
    lower, median, upper = np.percentile(values, (25, 50, 75))
    judged = float(values.max()) if bar is not None else float(median)
    return Figure(name, role, "", bar, judged, float(values.min()), float(lower), float(upper), 1.0, 1.0, 1.0)

"""Recording rows of many robots: gaps, restarts, damage, full disks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.bridge.servers.row import LARGEST, RowSchema, RowWriter
from armlab.bridge.servers.zenoh.messages import EVERY, checksum
from armlab.bridge.servers.zenoh.session import LabAddress, close_session, open_session
from armlab.errors import LinkError
from armlab.fleet import FleetRecorder, Router, recorder
from armlab.fleet.recorder import RobotRecord, RowColumns, stamp_of, tick_of
from armlab.log import Tick
from armlab.log.recording.rows import RowLayout
from armlab.robots import Robot, to_toml
from armlab.state import Command, State

from ..processes import Started, free_port, until

NAMES = ("yumi_left", "yumi_right", "ur5e")
PAST = 60  # rows that make a good start
AGAIN_NS = 5e9  # of the specification; of ten restarts beside a load of 20 on two cores the longest took 0.4 s
ROW = b"ALR1" + bytes(60)


def rows_of(recorder: FleetRecorder, name: str) -> int:
    return recorder.robots[name].rows if name in recorder.robots else 0


def check_ticks(path: Path, holes: int = 0) -> np.ndarray:
    """Every tick between the first and the last is in the file."""
    table = log.read(path)
    ticks = np.asarray(table["tick"], dtype=int)
    assert int(np.sum(np.diff(ticks) - 1)) == holes
    return ticks


Put = Callable[[str, bytes], None]


@pytest.fixture
def lab(tmp_path: Path, told: list[str]) -> Iterator[tuple[FleetRecorder, Put]]:
    """A recorder behind a router, and a function that sends it a robot's row; a test may close the recorder."""
    with (
        Router(port=(port := free_port())),
        FleetRecorder(LabAddress(port=port, lab=EVERY), tmp_path, told.append) as fleet,
    ):
        session = open_session("client", connect=[f"127.0.0.1:{port}"])
        yield fleet, lambda name, data: session.put(f"armlab/lab1/{name}/state", data, attachment=checksum(data))
        close_session(session)


def refused(fleet: FleetRecorder, name: str) -> int:
    return fleet.robots[f"lab1/{name}"].refused if f"lab1/{name}" in fleet.robots else 0


def test_messages_of_no_robot_are_counted_and_leave_no_file(
    lab: tuple[FleetRecorder, Put], told: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_UNANSWERED", 0.3)
    fleet, put = lab

    def sent() -> bool:
        for name, data in (("nobody", ROW), ("other", b"hello"), (".hidden", ROW), ("\u8a9e" * 80, ROW)):
            put(name, data)
        return fleet.strangers > 3 and refused(fleet, "other") > 3

    until(sent)
    until(lambda: refused(fleet, "nobody") > 0)
    assert set(fleet.robots) == {"lab1/nobody", "lab1/other"}
    fleet.close()
    assert list(tmp_path.iterdir()) == []
    for words in ("rows without a description", "lab1/other: invalid messages"):
        assert any(words in text for text in told)


def test_what_goes_wrong_with_one_robot_ends_its_recording_alone(
    lab: tuple[FleetRecorder, Put], told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = RobotRecord.write

    def wrong(self: RobotRecord) -> None:
        if self.name == "lab1/bad":
            raise RuntimeError("not thought of")
        whole(self)

    monkeypatch.setattr(RobotRecord, "write", wrong)
    fleet, put = lab

    def sent() -> bool:
        put("bad", b"hello")
        if any("lab1/bad" in text for text in told):
            put("good", b"hello")
        return refused(fleet, "good") > 3

    until(sent)
    fleet.close()
    assert fleet.robots["lab1/bad"].failed == "RuntimeError: not thought of"
    assert sum("recording ended: RuntimeError: not thought of" in text for text in told) == 1


def test_what_waits_takes_bounded_memory(lab: tuple[FleetRecorder, Put], monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, put = lab
    monkeypatch.setattr(recorder, "_ROOM", 100)
    fleet._room = 100

    def sent() -> bool:
        for name, data in (("first", ROW), ("second", ROW), ("second", b"ALR1" + bytes(LARGEST)), ("other", b"hello")):
            put(name, data)
        return refused(fleet, "other") > 5

    until(sent)
    assert sum(robot.waiting for robot in fleet.robots.values()) <= 100
    assert fleet.robots["lab1/second"].damaged > 3


@pytest.mark.slow
def test_every_row_is_in_the_files(processes: Callable[..., Started], tmp_path: Path) -> None:
    port = free_port()
    processes("router", port)
    with FleetRecorder(LabAddress(port=port, lab="lab1"), tmp_path) as fleet:
        publishers = [processes("publisher", port, name) for name in NAMES]
        until(lambda: all(rows_of(fleet, f"lab1/{name}") > 3 * PAST for name in NAMES))
        published = [one.end() for one in publishers]
        until(lambda: all(rows_of(fleet, f"lab1/{name}") > 3 * PAST for name in NAMES))
    for name, count in zip(NAMES, published, strict=True):
        assert fleet.robots[f"lab1/{name}"].lost == 0
        ticks = check_ticks(tmp_path / f"lab1-{name}.mcap")
        assert ticks[-1] == count - 1  # up to the very last row
        assert ticks[0] < 2 * PAST  # from about when the recorder found the robot
        q = log.read(tmp_path / f"lab1-{name}.mcap")["q"]
        np.testing.assert_allclose(q[-1] - q[0], 1e-6 * (ticks[-1] - ticks[0]), rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_a_router_that_dies_leaves_a_hole_that_is_counted(processes: Callable[..., Started], tmp_path: Path) -> None:
    port, name = free_port(), "lab1/yumi_left"
    router = processes("router", port)
    with FleetRecorder(LabAddress(port=port, lab="lab1"), tmp_path) as fleet:
        publisher = processes("publisher", port, "yumi_left")
        until(lambda: rows_of(fleet, name) > PAST)
        router.kill()
        seen = rows_of(fleet, name)
        router = processes("router", port)
        until(lambda: rows_of(fleet, name) > seen + PAST)
        lost = fleet.robots[name].lost
        publisher.end()
    assert lost > 0
    (path,) = tmp_path.iterdir()
    check_ticks(path, holes=lost)
    stamps = np.asarray(log.read(path)["receive_ns"])
    assert stamps[np.searchsorted(stamps, router.ready_ns)] - router.ready_ns <= AGAIN_NS
    assert any("rows were dropped while recording" in note for note in log.read(path).notes)


@pytest.mark.slow
def test_a_robot_that_dies_and_comes_again_with_other_rows(processes: Callable[..., Started], tmp_path: Path) -> None:
    port, name = free_port(), "lab1/arm"
    processes("router", port)
    with FleetRecorder(LabAddress(port=port, lab="lab1"), tmp_path) as fleet:
        other = processes("publisher", port, "yumi_left")
        first = processes("publisher", port, "yumi_right", "arm")
        until(lambda: rows_of(fleet, name) > PAST)
        first.kill()
        for again, kind in enumerate(("yumi_right", "ur5e"), 2):
            publisher = processes("publisher", port, kind, "arm")
            until(lambda again=again: len(fleet.robots[name].paths) == again)
            seen = rows_of(fleet, name)
            until(lambda seen=seen: rows_of(fleet, name) > seen + PAST)
            publisher.kill()
        other.end()
    assert fleet.robots["lab1/yumi_left"].lost == 0
    widths = [log.read(path)["q"].shape[1] for path in fleet.robots[name].paths]
    assert widths == [7, 7, 6]
    for path in fleet.robots[name].paths:
        check_ticks(path)


class Bridge:
    """Makes rows and describes their layout."""

    def __init__(self, robot: Robot, run: str = "first") -> None:
        self.schema, self.robot, self.run = RowSchema.of([robot]), robot, run
        self.writer = RowWriter(self.schema)

    def row(self, tick: int, stamp: int) -> bytes:
        q = np.array(self.robot.q_home)
        state = State(t=0.004 * tick, dt=0.004, q=q, qd=0 * q, tau=0 * q, q_start=q, robot=self.robot.name, seq=tick)
        now = 10**18 + 4_000_000 * stamp
        return self.writer.row(state, None, Tick(tick, -1, now, now, -1, 0), now)

    @property
    def about(self) -> bytes:
        said = {"run": self.run, "schema": self.schema.text.decode(), "robots": {self.robot.name: to_toml(self.robot)}}
        return json.dumps([said]).encode()


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def record(robot: Robot, tmp_path: Path, told: list[str]) -> RobotRecord:
    return RobotRecord(f"lab1/{robot.name}", tmp_path / "arm.mcap", told.append)


def fed(record: RobotRecord, bridge: Bridge, ticks: list[tuple[int, int]]) -> None:
    """Pass rows as the recorder does: write, describe on request, write again."""
    for tick, stamp in ticks:
        record.take(bridge.row(tick, stamp))
    for _ in range(4):
        record.write()
        if record.wants:
            record.describe(bridge.about)


def test_holes_are_named_and_counted(record: RobotRecord, robot: Robot, told: list[str]) -> None:
    fed(record, Bridge(robot), [(k, k) for k in (5, 6, 9, 10, 10, 9, 20)])
    record.close()
    assert (record.rows, record.lost, record.late) == (5, 2 + 9, 2)
    table = log.read(record.paths[0])
    np.testing.assert_array_equal(table["tick"], [5, 6, 9, 10, 20])
    assert "11 rows were dropped while recording: ticks 7 to 8, 11 to 19" in table.notes
    missing = ["2 rows missing, ticks 7 to 8", "9 rows missing, ticks 11 to 19"]
    assert [text for text in told if "rows missing" in text] == [f"lab1/{robot.name}: {words}" for words in missing]


@pytest.mark.parametrize(
    ("run", "first", "is_doubted", "counts"),
    [
        ("first", 0, False, (13, 0, [10, 3])),  # ticks go back: a restart
        ("first", 20, True, (13, 10, [13])),  # the same run returns after a gap
        *(("second", first, True, (13, 0, [10, 3])) for first in (0, 10, 1_000_000)),  # restarted unseen
    ],
)
def test_a_bridge_that_starts_again_gets_a_file_of_its_own(
    record: RobotRecord, robot: Robot, told: list[str], run: str, first: int, is_doubted: bool, counts: tuple
) -> None:
    fed(record, Bridge(robot), [(k, k) for k in range(9)])
    record.take(Bridge(robot).row(9, 9))
    if is_doubted:
        record.doubt()
    fed(record, Bridge(robot, run), [(first + k, 100 + k) for k in range(3)])
    record.close()
    assert (record.rows, record.lost, [len(log.read(path)) for path in record.paths]) == counts
    assert sum("has restarted" in text for text in told) == len(record.paths) - 1


def test_rows_of_a_bridge_that_does_not_answer_are_taken_for_the_same_run(
    record: RobotRecord, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed(record, Bridge(robot), [(0, 0)])
    record.doubt()
    monkeypatch.setattr(recorder, "_UNANSWERED", -1.0)
    record.take(Bridge(robot).row(3, 3))
    record.write()
    record.write()
    assert (record.rows, record.lost, record.refused, record.wants) == (2, 2, 0, False)
    record.doubt()
    record.take(Bridge(robot).row(4, 4))
    monkeypatch.undo()
    record.close()
    assert record.rows == 3, "also at the end"
    nobody = RobotRecord("lab1/nobody", tmp_path / "nobody.mcap", print)
    monkeypatch.setattr(recorder, "_UNANSWERED", -1.0)
    nobody.take(Bridge(robot).row(0, 0))
    nobody.write()
    assert (nobody.refused, nobody.wants, nobody.paths) == (1, False, [])


def test_damaged_rows_are_counted_and_named_in_the_file(record: RobotRecord, robot: Robot, told: list[str]) -> None:
    bridge = Bridge(robot)
    record.take(None)
    fed(record, bridge, [(0, 0)])
    record.take(None)
    fed(record, bridge, [(2, 2)])
    record.close()
    assert (record.rows, record.lost, record.damaged, record.refused) == (2, 1, 2, 0)
    assert sum("damaged rows are dropped" in text for text in told) == 1
    events = [event.text for event in log.inspect(record.paths[0]).events]
    assert sum("a damaged row was dropped" in text for text in events) == 1


def test_wrong_rows_are_refused_and_the_right_ones_written(record: RobotRecord, robot: Robot, told: list[str]) -> None:
    bridge = Bridge(robot)
    good = bridge.row(0, 0)
    for wrong in (b"", b"hello", b"ALR1" + bytes(100), good[:-8], good[:4]):
        record.take(wrong)
    fed(record, bridge, [(k, k) for k in range(3)])
    record.close()
    assert (record.rows, record.refused, record.lost) == (3, 5, 0)
    assert sum("invalid messages" in text for text in told) == 1


@pytest.mark.parametrize(
    "about", [b"", b"[]", b"[1]", b'[{"schema": "{}"}]', b'[{"schema": 1}]', b"\xff", b"[" * 200_000]
)
def test_a_description_that_is_none_leaves_no_file(record: RobotRecord, robot: Robot, about: bytes) -> None:
    record.take(Bridge(robot).row(0, 0))
    record.write()
    assert record.wants
    record.describe(about)
    record.close()
    assert (record.paths, record.rows, record.refused) == ([], 0, 1)


def test_a_recording_that_is_given_up_leaves_what_was_written(
    record: RobotRecord, robot: Robot, told: list[str]
) -> None:
    fed(record, Bridge(robot), [(k, k) for k in range(3)])
    record.flush()
    record.end("ValueError: wrong")
    assert told[-1] == f"lab1/{robot.name}: recording ended: ValueError: wrong"
    assert (record.failed, record.wants) == ("ValueError: wrong", False)
    with pytest.warns(UserWarning, match="arm.mcap"):
        assert len(log.read(record.paths[0])) == 3


def test_a_full_disk_is_told_and_a_new_file_tried(
    record: RobotRecord, robot: Robot, told: list[str], monkeypatch: pytest.MonkeyPatch, full_disk: Callable[[], object]
) -> None:
    bridge = Bridge(robot)
    fed(record, bridge, [(k, k) for k in range(3)])
    with full_disk():  # type: ignore[attr-defined]
        fed(record, bridge, [(k, k) for k in range(3, 6)])
    assert record.failed is not None
    assert "stopped after 3 rows" in record.failed
    assert any(record.failed in text for text in told)
    fed(record, bridge, [(6, 6)])  # not yet tried again
    assert (record.rows, record.lost) == (3, 4)
    monkeypatch.setattr(record, "_retry", 0.0)
    fed(record, bridge, [(k, k) for k in range(7, 10)])
    record.close()
    assert (record.rows, record.lost, len(record.paths)) == (6, 4, 2)
    np.testing.assert_array_equal(log.read(record.paths[1])["tick"], [7, 8, 9])


def test_a_silent_robot_s_file_is_finished(record: RobotRecord, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Bridge(robot)
    fed(record, bridge, [(0, 0)])
    monkeypatch.setattr(recorder, "_SILENT", -1.0)
    record.write()
    assert log.read(record.paths[0]).notes == ()
    monkeypatch.undo()
    fed(record, bridge, [(3, 3)])
    record.close()
    assert "2 rows were dropped while recording: ticks 1 to 2" in log.read(record.paths[1]).notes


NOT_SENT = {"wake_ns", "qd_source", "tau_source"}  # columns that the bridge's rows lack


def made_up(robot: Robot, rng: np.random.Generator) -> tuple[State, Command, Tick]:
    """Return a row of random numbers, so that a misplaced column shows; the flags vary."""
    n = robot.n
    q, qd, tau, planned, sent = rng.normal(size=(5, n))
    state = State(
        t=1.5, dt=0.004, q=q, qd=qd, tau=tau, q_start=q, robot=robot.name, seq=11, session=2, missed=1,
        q_planned=planned, robot_ns=77, motors=2, mci=3, rapid=1, converged=bool(rng.integers(2)),
        T_frame_tool=rng.normal(size=(4, 4)), wrench_raw=rng.normal(size=6), wrench=rng.normal(size=6),
        q_ext=rng.normal(size=2), utilization=4.5,
    )  # fmt: skip
    command = Command(q=q + 1.0, record={"wrench_hat": rng.normal(size=6)})
    clamped = rng.integers(0, 16, n).astype("u1")
    return state, command, Tick(8, 9, 10**18, 10**18 + 1, -1, 55, True, 4, q_sent=sent, clamped=clamped)


def test_a_recording_of_rows_is_that_of_the_bridge() -> None:
    rng = np.random.default_rng(3)
    arms = [robots.load("yumi_left"), robots.load("ur5e")]
    schema = RowSchema.of(arms)
    writer = RowWriter(schema)
    for robot in arms * 6:
        layout = RowLayout(robot)
        state, command, tick = made_up(robot, rng)
        there = layout.unpack([layout.pack(state, command, tick)])
        packed = RowColumns(schema, robot.name, layout).packed(writer.row(state, command, tick, 5))
        here = layout.unpack([packed])
        for name in here.keys() - NOT_SENT:
            np.testing.assert_array_equal(here[name], there[name], err_msg=name)
        assert all(np.isnan(here[name]).all() for name in NOT_SENT)
        assert (stamp_of(packed), tick_of(packed)) == (10**18, 8)


def test_rows_of_others_are_refused() -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    schema = RowSchema.of([left])
    with pytest.raises(LinkError, match="rows with the ticks of yumi_right, got ticks of yumi_left"):
        RowColumns(schema, right.name, RowLayout(right))
    with pytest.raises(LinkError, match=r"yumi_left.q of shape \(6,\) in the rows, got \(7,\)"):
        RowColumns(schema, left.name, RowLayout(robots.load("ur5e")))

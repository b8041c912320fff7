"""`FleetRecorder`: many robots through a router, into files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.bridge.servers.row import LARGEST
from armlab.bridge.servers.zenoh import EVERY, Place, checksum, close_session, open_session
from armlab.fleet import FleetRecorder, Router, record, robot_record
from armlab.fleet.robot_record import RobotRecord
from armlab.robots import Robot

from ..processes import Started, free_port, until

NAMES = ("yumi_left", "yumi_right", "ur5e")
PAST = 250  # rows that make a good start
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


def test_messages_of_no_robot_are_counted_and_leave_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_record, "_UNANSWERED", 0.3)
    told: list[str] = []
    with Router(port=(port := free_port())), FleetRecorder(Place(port=port, lab=EVERY), tmp_path, told.append) as fleet:
        session = open_session("client", connect=[f"127.0.0.1:{port}"])

        def sent() -> bool:
            for name, data in (("nobody", ROW), ("other", b"hello"), (".hidden", ROW), ("\u8a9e" * 80, ROW)):
                session.put(f"armlab/lab1/{name}/state", data, attachment=checksum(data))
            session.put("armlab/lab1/damaged/state", ROW, attachment=checksum(ROW[:-1] + b"x"))
            session.put("armlab/lab1/damaged/state", ROW)
            known = fleet.robots
            return fleet.strangers > 3 and "lab1/other" in known and known["lab1/other"].refused > 3

        until(sent)
        until(lambda: fleet.robots["lab1/nobody"].refused > 0)
        assert set(fleet.robots) == {"lab1/nobody", "lab1/other", "lab1/damaged"}
        damaged = fleet.robots["lab1/damaged"]
        assert damaged.damaged > 6
        assert (damaged.rows, damaged.refused) == (0, 0)
        close_session(session)
    assert list(tmp_path.iterdir()) == []
    assert any("nobody says what is in its rows" in text for text in told)
    assert any("lab1/other: messages are refused" in text for text in told)
    assert sum("lab1/damaged: rows come damaged" in text for text in told) == 1


def test_what_goes_wrong_with_one_robot_ends_its_recording_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, told = RobotRecord.write, []

    def wrong(self: RobotRecord) -> None:
        if self.name == "lab1/bad":
            raise RuntimeError("not thought of")
        whole(self)

    monkeypatch.setattr(RobotRecord, "write", wrong)
    with Router(port=(port := free_port())), FleetRecorder(Place(port=port, lab=EVERY), tmp_path, told.append) as fleet:
        session = open_session("client", connect=[f"127.0.0.1:{port}"])

        def sent(name: str) -> int:
            session.put(f"armlab/lab1/{name}/state", b"hello", attachment=checksum(b"hello"))
            return fleet.robots[f"lab1/{name}"].refused if f"lab1/{name}" in fleet.robots else 0

        until(lambda: sent("bad") or any("lab1/bad" in text for text in told))
        seen = sent("good")
        until(lambda: sent("bad") + sent("good") > seen + 3)
        close_session(session)
    assert fleet.robots["lab1/bad"].failed == "RuntimeError: not thought of"
    assert sum("its recording has ended: RuntimeError: not thought of" in text for text in told) == 1


def test_what_waits_takes_bounded_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of robots that nobody describes, and what is larger than rows are."""
    monkeypatch.setattr(record, "_ROOM", 100)
    large = b"ALR1" + bytes(LARGEST)
    with Router(port=(port := free_port())), FleetRecorder(Place(port=port, lab=EVERY), tmp_path) as fleet:
        session = open_session("client", connect=[f"127.0.0.1:{port}"])

        def refused() -> int:
            for name, data in (("first", ROW), ("second", ROW), ("second", large), ("other", b"hello")):
                session.put(f"armlab/lab1/{name}/state", data, attachment=checksum(data))
            return fleet.robots["lab1/other"].refused if "lab1/other" in fleet.robots else 0

        until(lambda: refused() > 5)
        assert sum(robot.waiting for robot in fleet.robots.values()) <= 100
        assert fleet.robots["lab1/second"].damaged > 3
        close_session(session)


@pytest.mark.slow
def test_every_row_is_in_the_files(processes: Callable[..., Started], tmp_path: Path) -> None:
    port = free_port()
    processes("router", port)
    with FleetRecorder(Place(port=port, lab="lab1"), tmp_path) as fleet:
        publishers = [processes("publisher", port, name) for name in NAMES]
        until(lambda: all(rows_of(fleet, f"lab1/{name}") > 4 * PAST for name in NAMES))
        published = [one.end() for one in publishers]
        until(lambda: all(rows_of(fleet, f"lab1/{name}") > 4 * PAST for name in NAMES))
    for name, count in zip(NAMES, published, strict=True):
        assert fleet.robots[f"lab1/{name}"].lost == 0
        ticks = check_ticks(tmp_path / f"lab1-{name}.mcap")
        assert ticks[-1] == count - 1  # to the very last
        assert ticks[0] < PAST  # from about when the recorder heard of it
        q = log.read(tmp_path / f"lab1-{name}.mcap")["q"]
        np.testing.assert_allclose(q[-1] - q[0], 1e-6 * (ticks[-1] - ticks[0]), rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_a_router_that_dies_leaves_a_hole_that_is_counted(processes: Callable[..., Started], tmp_path: Path) -> None:
    """By the stamps of the rows it ends within 5 s after the next router."""
    port, name = free_port(), "lab1/yumi_left"
    router = processes("router", port)
    with FleetRecorder(Place(port=port, lab="lab1"), tmp_path) as fleet:
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
def test_a_bridge_that_restarts_while_the_router_is_down_is_no_hole(
    processes: Callable[..., Started], tmp_path: Path
) -> None:
    """Also when its ticks are past those of the old one."""
    port, name, told = free_port(), "lab1/yumi_left", []
    router = processes("router", port)
    with FleetRecorder(Place(port=port, lab="lab1"), tmp_path, told.append) as fleet:
        first = processes("publisher", port, "yumi_left")
        until(lambda: rows_of(fleet, name) > PAST)
        router.kill()
        first.kill()
        seen = rows_of(fleet, name)
        again = processes("publisher", port, "yumi_left", "yumi_left", "0.004", "1000000")
        processes("router", port)
        until(lambda: rows_of(fleet, name) > seen + PAST)
        again.end()
    assert any("its bridge has restarted" in text for text in told)
    assert fleet.robots[name].lost == 0
    old, new = (check_ticks(path) for path in fleet.robots[name].paths)
    assert old[-1] < 1_000_000 <= new[0]


@pytest.mark.slow
def test_a_robot_that_dies_and_comes_again_with_other_rows(processes: Callable[..., Started], tmp_path: Path) -> None:
    port, name = free_port(), "lab1/arm"
    processes("router", port)
    with FleetRecorder(Place(port=port, lab="lab1"), tmp_path) as fleet:
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


@pytest.mark.slow
def test_a_file_that_cannot_be_written_costs_its_robot_alone(
    processes: Callable[..., Started], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: Robot
) -> None:
    from armlab.log.recording_file import RecordingFile

    whole, told = RecordingFile.write, []

    def full(self: RecordingFile, rows: list[bytes], first: int | None = None) -> None:
        if "yumi_left" in self.path.name and self.rows > PAST:
            raise OSError(28, "No space left on device")
        whole(self, rows, first)

    monkeypatch.setattr(RecordingFile, "write", full)
    port = free_port()
    processes("router", port)
    with FleetRecorder(Place(port=port, lab="lab1"), tmp_path, told.append) as fleet:
        publishers = [processes("publisher", port, name) for name in ("yumi_left", robot.name)]
        until(lambda: any("No space left on device" in text for text in told))
        seen = rows_of(fleet, f"lab1/{robot.name}")
        until(lambda: rows_of(fleet, f"lab1/{robot.name}") > seen + PAST)
        for one in publishers:
            one.end()
    assert fleet.robots["lab1/yumi_left"].lost > 0
    assert fleet.robots[f"lab1/{robot.name}"].lost == 0
    check_ticks(tmp_path / f"lab1-{robot.name}.mcap")

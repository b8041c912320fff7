"""`RobotRecord`: the ticks of one robot, their holes, and the runs of its bridge."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.fleet import robot_record
from armlab.fleet.robot_record import RobotRecord
from armlab.log import Tick
from armlab.robots import Robot, to_toml
from armlab.state import State


class Bridge:
    """Makes rows and says what is in them."""

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
    """Give rows as the recorder does: written, described when that is wanted, written again."""
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
    assert [text for text in told if "did not come" in text] == [
        f"lab1/{robot.name}: 2 rows did not come, ticks 7 to 8",
        f"lab1/{robot.name}: 9 rows did not come, ticks 11 to 19",
    ]


def test_a_bridge_that_starts_again_gets_a_file_of_its_own(record: RobotRecord, robot: Robot) -> None:
    fed(record, Bridge(robot), [(k, k) for k in range(10)])
    fed(record, Bridge(robot), [(k, 100 + k) for k in range(3)])
    record.close()
    assert [path.name for path in record.paths] == ["arm.mcap", "arm-2.mcap"]
    assert [len(log.read(path)) for path in record.paths] == [10, 3]
    assert record.lost == 0


def test_a_bridge_that_comes_again_in_the_same_run_has_a_hole(record: RobotRecord, robot: Robot) -> None:
    fed(record, Bridge(robot), [(k, k) for k in range(10)])
    record.doubt()
    fed(record, Bridge(robot), [(k, k) for k in range(20, 25)])
    record.close()
    assert (record.rows, record.lost, len(record.paths)) == (15, 10, 1)


@pytest.mark.parametrize("first", [0, 10, 20, 1_000_000])
def test_a_bridge_that_restarted_unseen_has_no_hole(
    record: RobotRecord, robot: Robot, told: list[str], first: int
) -> None:
    """Whatever its ticks are; what came before it had gone belongs to the old run."""
    fed(record, Bridge(robot), [(k, k) for k in range(9)])
    record.take(Bridge(robot).row(9, 9))
    record.doubt()
    fed(record, Bridge(robot, "second"), [(first + k, 100 + k) for k in range(3)])
    record.close()
    assert (record.rows, record.lost) == (13, 0)
    assert [len(log.read(path)) for path in record.paths] == [10, 3]
    assert sum("has restarted" in text for text in told) == 1


def test_rows_of_a_bridge_that_does_not_answer_are_taken_for_the_same_run(
    record: RobotRecord, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed(record, Bridge(robot), [(0, 0)])
    record.doubt()
    monkeypatch.setattr(robot_record, "_UNANSWERED", -1.0)
    record.take(Bridge(robot).row(3, 3))
    record.write()
    record.write()
    assert (record.rows, record.lost, record.refused, record.wants) == (2, 2, 0, False)
    record.doubt()
    record.take(Bridge(robot).row(4, 4))
    monkeypatch.undo()
    record.close()
    assert record.rows == 3, "also at the end"


def test_damaged_rows_are_counted_and_named_in_the_file(record: RobotRecord, robot: Robot, told: list[str]) -> None:
    bridge = Bridge(robot)
    record.take(None)
    fed(record, bridge, [(0, 0)])
    record.take(None)
    fed(record, bridge, [(2, 2)])
    record.close()
    assert (record.rows, record.lost, record.damaged, record.refused) == (2, 1, 2, 0)
    assert sum("rows come damaged" in text for text in told) == 1
    events = [event.text for event in log.inspect(record.paths[0]).events]
    assert sum("a row came damaged and was dropped" in text for text in events) == 1


def test_wrong_rows_are_refused_and_the_right_ones_written(record: RobotRecord, robot: Robot, told: list[str]) -> None:
    bridge = Bridge(robot)
    good = bridge.row(0, 0)
    for wrong in (b"", b"hello", b"ALR1" + bytes(100), good[:-8], good[:4]):
        record.take(wrong)
    fed(record, bridge, [(k, k) for k in range(3)])
    record.close()
    assert (record.rows, record.refused, record.lost) == (3, 5, 0)
    assert sum("messages are refused" in text for text in told) == 1


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
    assert told[-1] == f"lab1/{robot.name}: its recording has ended: ValueError: wrong"
    assert (record.failed, record.wants) == ("ValueError: wrong", False)
    with pytest.warns(UserWarning, match="arm.mcap"):
        assert len(log.read(record.paths[0])) == 3


def test_rows_that_nobody_describes_are_given_up(
    record: RobotRecord, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_record, "_UNANSWERED", -1.0)
    record.take(Bridge(robot).row(0, 0))
    record.write()
    assert (record.refused, record.wants) == (1, False)


def test_a_full_disk_is_told_and_a_new_file_tried(
    record: RobotRecord,
    robot: Robot,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    full_disk: Callable[[], object],
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
    monkeypatch.setattr(robot_record, "_SILENT", -1.0)
    record.write()
    assert log.read(record.paths[0]).notes == ()
    monkeypatch.undo()
    fed(record, bridge, [(3, 3)])
    record.close()
    assert "2 rows were dropped while recording: ticks 1 to 2" in log.read(record.paths[1]).notes

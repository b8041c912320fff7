"""What LabComm's rows take from rows of the loop, beside `read_row`."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.labcomm.process import ArmPlaces, Held, SourcePlaces
from armlab.bridge.servers.row import RowField, RowSchema, RowWriter, read_row
from armlab.log import Column, Tick
from armlab.state import State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
SCHEMA = RowSchema.of([LEFT, RIGHT], {"force": {"f": Column((3,), "N"), "n": Column((), "1")}})
TICK = Tick(3, -1, 5_000_000_000, 4_999_000_000, -1, 0)


@pytest.mark.parametrize("robot_ns", [0, 9_000_000])
def test_an_arm_is_taken_as_it_stands_in_the_row(robot_ns: int) -> None:
    q = np.arange(7.0) / 8
    state = State(t=1.5, dt=0.004, q=q, qd=-q, tau=np.full(7, np.nan), robot=LEFT.name, robot_ns=robot_ns)
    data = RowWriter(SCHEMA).row(state, None, TICK, 1)
    held = ArmPlaces(SCHEMA, LEFT.name).held(data)
    assert isinstance(held, Held)
    assert held.is_fresh
    assert (held.arm.name, held.arm.t_us) == (LEFT.name, 4_999_000)
    values = read_row(SCHEMA, data).values
    assert held.arm.row.tm == (9 if robot_ns else 1500)
    assert held.arm.row.q == tuple(values["yumi_left.q"])
    assert held.arm.row.qd == tuple(values["yumi_left.qd"])
    assert np.isnan(held.arm.row.tau).all()
    assert ArmPlaces(SCHEMA, RIGHT.name).held(data) is None, "it was never heard"


def test_the_newest_of_an_arm_whose_row_it_is_not() -> None:
    writer, q = RowWriter(SCHEMA), np.arange(7.0)
    for robot in (RIGHT, LEFT):
        data = writer.row(State(t=1.5, dt=0.004, q=q, qd=q, tau=q, robot=robot.name), None, TICK, 1)
    held = ArmPlaces(SCHEMA, RIGHT.name).held(data)
    assert held is not None
    assert not held.is_fresh
    assert held.arm.row.q == tuple(q)


def _written(*numbers: float) -> bytes:
    """A row whose source has these numbers and an age."""
    q = np.zeros(7)
    data = bytearray(RowWriter(SCHEMA).row(State(t=0.0, dt=0.0, q=q, qd=q, tau=q, robot=LEFT.name), None, TICK, 1))
    place = SCHEMA.fields["force.f"].offset
    data[place : place + 8 * len(numbers)] = np.array(numbers, "<f8").tobytes()
    return bytes(data)


def test_times_beyond_all_clocks_are_none() -> None:
    q = np.zeros(7)
    data = RowWriter(SCHEMA).row(State(t=1.7e308, dt=0.0, q=q, qd=q, tau=q, robot=LEFT.name), None, TICK, 1)
    assert ArmPlaces(SCHEMA, LEFT.name).held(data) is None
    assert SourcePlaces(SCHEMA, "force").held(_written(1.0, 2.0, 3.0, 4.0, 1e300), 5_000_000_000) is None


def test_a_source_has_its_numbers_in_order_and_its_age() -> None:
    places = SourcePlaces(SCHEMA, "force")
    found = places.held(_written(1.0, 2.0, 3.0, 4.0, 0.002), 5_000_000_000)
    assert found == ("force", 4_998_000, [1.0, 2.0, 3.0, 4.0])
    assert places.held(_written(1.0, 2.0, 3.0, 4.0, np.inf), 5_000_000_000) is None


def test_an_arm_of_one_joint_has_rows_of_one_number() -> None:
    numbers = {"fresh": (), "age": (), "receive_ns": (), "robot_ns": (), "session_t": (), "q": 1, "qd": 1, "tau": 1}
    fields, at = [], RowSchema([], []).size
    for name, size in numbers.items():
        kind = "int64" if name.endswith(("_ns", "fresh")) else "float64"
        fields.append(RowField(f"arm.{name}", kind, (size,) if size else (), "1", "", (), "arm", at))
        at += 8
    held = ArmPlaces(RowSchema(["arm"], fields), "arm").held(bytes(at))
    assert held is not None
    assert held.arm.row == (0, (0.0,), (0.0,), (0.0,))

"""What of a row is in which message: every form by its message, and what is absent."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from armlab.bridge.servers.ros.message_template import Encode, cdr, plan

from armlab import robots
from armlab.bridge.servers.ros.topics import FORMS, Arm, Columns, Form, Kind, diagnostics, store
from armlab.bridge.servers.row import RowSchema, RowWriter, places
from armlab.log import Tick
from armlab.state import Command, State

ROBOT = robots.load("irb120")
SCHEMA = RowSchema.of([ROBOT])
NOTHING = np.full(6, np.nan)


def arm(q: np.ndarray, command: Command | None = None) -> Arm:
    state = State(1.0, 0.004, q, NOTHING, NOTHING, robot=ROBOT.name)
    data = RowWriter(SCHEMA).row(state, command, Tick(7, 7, 3, 1_000, 2_000, 3), 2)
    return Arm(ROBOT, places(SCHEMA, ROBOT.name), data, 3)


@pytest.mark.parametrize("name", FORMS)
def test_nothing_else_of_a_row_is_in_a_message(name: str) -> None:
    form: Form = FORMS[name]
    record = {"wrench_hat": np.arange(6.0), "wrench_hat_cov": np.eye(6)}
    full = Command(np.arange(6.0), np.arange(6.0), record=record)
    columns: Columns | None = form.columns(arm(np.linspace(0.1, 0.6, 6), full))
    if name in ("wrench", "joint_states_sent"):
        assert columns is None  # this row has none
        return
    assert columns is not None
    message = form.message(ROBOT, 1_000_000_002, columns)
    assert message.__msgtype__ == form.type
    if hasattr(message, "header"):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 2)
    assert all(field in places(SCHEMA, ROBOT.name) for field in form.fields)
    assert (form.kind is Kind.OTHER) == (form.other is not None)


def test_what_is_absent_has_no_numbers() -> None:
    q, command = np.linspace(0.1, 0.6, 6), Command(qd=np.arange(6.0))
    assert FORMS["joint_states"].columns(arm(q)) == (tuple(q), (), ())
    assert FORMS["joint_states_ref"].columns(arm(q, command)) == ((), tuple(np.arange(6.0)), ())
    for name in ("joint_states", "tcp_pose", "joint_states_ref", "wrench_hat", "wrench_hat_covariance"):
        assert FORMS[name].columns(arm(NOTHING)) is None


COUNTS = {"rate": 250.04, "p50": 80.0, "p99": 120.0, "longest": 400.0, "missed": 0, "late": 0, "drops": 0}
COUNTS |= {"session": 2, "clamps": {"position": [0, 3], "velocity": [1, 0]}}


def test_all_is_well() -> None:
    (status,) = diagnostics("irb120", 5, COUNTS, "").status
    values = {one.key: one.value for one in status.values}
    assert (status.level, status.hardware_id) == (0, "irb120")
    assert values["rate [1/s]"] == "250.0"
    assert values["clamped samples"] == "4"
    assert values["commander"] == "nobody"


def test_an_arm_that_is_silent_is_an_error() -> None:
    for silent, level, words in ((0.9, 0, "every packet answered"), (3.21, 2, "no packet for 3.2 s")):
        (status,) = diagnostics("irb120", 5, COUNTS, "", silent=silent).status
        assert (status.level, status.message) == (level, words)
    values = {one.key: one.value for one in status.values}
    assert (values["link"], values["rate [1/s]"]) == ("no packet for 3.2 s", "0.0")
    (status,) = diagnostics("irb120", 5, COUNTS, "", silent=math.inf).status
    assert (status.level, status.message) == (2, "no packet yet")


def test_faults_are_a_warning_and_unknowns_are_said() -> None:
    faulty = {**COUNTS, "missed": 3, "drops": 1, "rate": math.nan}
    (status,) = diagnostics("irb120", 5, faulty, "labcomm 127.0.0.1:4").status
    values = {one.key: one.value for one in status.values}
    assert status.level == 1
    assert status.message == "3 packets missed, 1 packets refused"
    assert values["rate [1/s]"] == "unknown"
    assert values["commander"] == "labcomm 127.0.0.1:4"


ARM = robots.load("yumi_left")
PLACES = places(RowSchema.of([ARM]), ARM.name)
MADE = [name for name, form in FORMS.items() if form.kind is not Kind.OTHER]


def test_joint_states_by_hand() -> None:
    fresh, columns, variants, kind, chain, joints = plan(FORMS["joint_states"], ARM, PLACES, cdr)
    at = [PLACES[name][1] for name in ("q", "qd", "tau")]
    assert (fresh, joints, kind, chain) == (PLACES["fresh"][1], at[0], 0, ARM.chain)
    assert columns == [(one, 7) for one in at]
    assert variants[0] is None
    message, stamp, copies = variants[0b101]
    assert stamp == 4
    assert [copy[1:] for copy in copies] == [(at[0], 7), (at[2], 7)]
    (_, _, _), (effort, _, _) = copies
    assert effort == len(message) - 56  # the last of the message
    assert copies[0][0] == effort - 8 - 56  # behind an empty velocity and two lengths
    assert (copies[0][0] - 4) % 8 == 0  # CDR aligns from behind its 4 bytes


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("dialect", ["cdr", "ros1"])
def test_what_is_written_into_a_template_is_in_the_message(name: str, dialect: str) -> None:
    def ros1(message: object, type_: str) -> bytes:
        return bytes(store().cdr_to_ros1(cdr(message, type_), type_))

    encode: Encode = cdr if dialect == "cdr" else ros1
    form = FORMS[name]
    for variant in plan(form, ARM, PLACES, encode)[2][1:]:
        message, stamp, copies = bytearray(variant[0]), *variant[1:]
        struct.pack_into("<iI", message, stamp, 5, 6)
        for k, (to, _, count) in enumerate(copies):
            struct.pack_into(f"<{count}d", message, to, *[10.0 * k + j for j in range(count)])
        raw = bytes(message) if dialect == "cdr" else bytes(store().ros1_to_cdr(bytes(message), form.type))
        found = store().deserialize_cdr(raw, form.type)
        assert (found.header.stamp.sec, found.header.stamp.nanosec) == (5, 6)
        assert encode(found, form.type) == bytes(message)
        if form.type.endswith("JointState"):
            there = [column.tolist() for column in (found.position, found.velocity, found.effort) if len(column)]
            assert there == [[10.0 * k + j for j in range(7)] for k in range(len(copies))]
        elif form.type.endswith("WrenchStamped"):
            assert (found.wrench.force.x, found.wrench.torque.z) == (0.0, 5.0)
        else:
            assert (found.pose.position.x, found.pose.orientation.x, found.pose.orientation.w) == (0.0, 3.0, 6.0)

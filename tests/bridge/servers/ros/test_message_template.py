"""Templates of messages: where stamp and numbers are, in both dialects."""

from __future__ import annotations

import struct

import pytest

from armlab import robots
from armlab.bridge.servers.ros import store
from armlab.bridge.servers.ros.mapping import FORMS, Kind
from armlab.bridge.servers.ros.message_template import Encode, cdr, plan
from armlab.bridge.servers.row import RowSchema, places

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

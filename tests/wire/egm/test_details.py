"""What a packet leaves out: fields of RobotWare 7 and of the research extension, read on demand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.wire.egm import Details, EgmCodec, RobotMessage, RobotSideCodec
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap
from armlab.wire.egm.details import read_details
from armlab.wire.egm.robot_side import EXTENSION_ARRAYS


def found(codec: EgmCodec, data: bytes) -> Details:
    details = codec.details(data)
    assert isinstance(details, Details)
    return details


def test_a_message_of_another_program(yumi: Any, vector: Any) -> None:
    """Robotware 7 as ABBRobotEGM writes it."""
    codec = EgmCodec(yumi)
    codec.decode(vector("robot_rw7"))
    details = found(codec, vector("robot_rw7"))
    assert details.stamp_ns == 1_700_000_000_250_000_000 + 1
    assert (details.move_index, details.collision, details.force_control) == (4, False, True)
    np.testing.assert_allclose(details.collision_quota, [0.1] * 6)
    assert (details.planned_ns, details.planned_stamp_ns, details.mode, details.used_seq) == (None,) * 4
    assert details.q_ext_planned.size == details.test_signals.size == 0
    assert np.isnan([details.tau_total, details.current, details.q_reference]).all()
    assert np.isnan(details.T_frame_planned).all()


@pytest.mark.parametrize("order", [0, 1])
def test_every_field_of_the_extension(yumi: Any, wire: Any, order: int) -> None:
    """In ABB's order axis 7 comes last, in ours third."""
    abb = np.array([1.0, 2, 4, 5, 6, 7, 3])
    kinematic = np.array([1.0, 2, 3, 4, 5, 6, 7])
    values = kinematic if order else abb
    arrays = [wire.packed(field, *(10.0 * field + values)) for field in range(1, 8)]
    counts = [wire.u(9, 5), wire.u(10, 2), wire.u(11, 3), wire.u(12, order), wire.u(13, 77)]
    planned = [
        wire.m(2, wire.m(1, wire.d(1, 1000.0), wire.d(2, 0.0), wire.d(3, 0.0)), wire.m(2, wire.d(1, 1.0))),
        wire.m(3, wire.d(1, 0.0, 90.0)),
        wire.m(4, wire.u(1, 7), wire.u(2, 250_000)),
        wire.m(5, wire.u(1, 7), wire.u(2, 3)),
    ]
    data = wire.robot(
        wire.joints(*range(6)), wire.m(3, *planned), wire.m(7, wire.d(1, 0.5)), wire.m(101, *arrays, *counts),
        external=wire.joints(0.0, 0.0),
    )  # fmt: skip
    details = found(EgmCodec(yumi), data)
    np.testing.assert_allclose(details.tau_total, 30.0 + kinematic)
    np.testing.assert_allclose(details.tau_gravity, 40.0 + kinematic)
    np.testing.assert_allclose(details.current, 50.0 + kinematic)
    np.testing.assert_allclose(details.q_reference, np.radians(60.0 + kinematic))
    np.testing.assert_allclose(details.qd_reference, np.radians(70.0 + kinematic))
    assert (details.overruns, details.arm_id, details.mode, details.used_seq) == (5, 2, 3, 77)
    np.testing.assert_allclose(details.q_ext_planned, [np.pi / 2])
    assert (details.planned_ns, details.planned_stamp_ns) == (7_250_000_000, 7_000_000_003)
    assert details.T_frame_planned[0, 3] == 1.0
    assert details.test_signals.tolist() == [0.5]
    assert not details.tau_total.flags.writeable


def test_every_field_of_the_schema_is_read_by_somebody() -> None:
    """A field that the schema has and neither a Packet nor Details reads would be lost in silence."""
    from pathlib import Path

    from armlab.wire.egm import details

    sources = Path(details.__file__).parent
    text = "".join((sources / f"{name}.py").read_text() for name in ("codec", "details", "robot_side", "pose_force"))
    for message in pb.DESCRIPTOR.message_types_by_name.values():
        for field in message.fields:
            assert f".{field.name}" in text or f'"{field.name}"' in text, f"{message.name}.{field.name}"


def test_what_the_simulated_controller_says(yumi: Any) -> None:
    q = np.arange(7.0)
    arrays: Any = dict.fromkeys(EXTENSION_ARRAYS, q)
    codec = RobotSideCodec(yumi, "6.10", EXTENSION_ARRAYS)
    data = codec.encode_robot(RobotMessage(1, 2, q, q, mode=2, used_seq=9, overruns=1, **arrays))
    details = found(EgmCodec(yumi, extension=True), data)
    for name in EXTENSION_ARRAYS[2:]:
        np.testing.assert_allclose(getattr(details, name), q)
    assert (details.mode, details.used_seq, details.overruns) == (2, 9, 1)


@given(st.binary(max_size=200))
def test_any_bytes(yumi: Any, data: bytes) -> None:
    assert read_details(AxisMap(yumi), data, "7") is None or data is not None
    assert EgmCodec(yumi).details(b"\xff") is None

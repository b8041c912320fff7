"""Order and units of the numbers of a packet."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.message_layout import INTEGERS, Numbers, Shape

RADIAN = np.pi / 180


def numbers(**more: Any) -> Numbers:
    found: dict[str, Any] = dict.fromkeys(Numbers._fields, ())
    return Numbers(**(found | more))


def shape(axes: AxisMap, of: Numbers, robotware: str = "7", has_research: bool = False) -> Shape:
    return Shape(
        axes, of, False, has_tm=True, has_research=has_research, states=(1, 3, 2), converged=False,
        robotware=robotware, rapid_digital=False,
    )  # fmt: skip


def test_order_and_units_by_hand(yumi: Any) -> None:
    of = numbers(
        joints=(10.0, 20.0, 30.0, 40.0, 50.0, 60.0),
        external=(70.0, 100.0),
        torque_reference=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        utilization=(12.5,),
        pose=(100.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    )
    form = shape(AxisMap(yumi, ("deg",) * 7 + ("mm",)), of)
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (5, 6, 1, 250000, 0, 0))
    np.testing.assert_allclose(packet.q, np.radians([10, 20, 70, 30, 40, 50, 60]))
    np.testing.assert_array_equal(packet.tau, [1, 2, np.nan, 3, 4, 5, 6])
    np.testing.assert_allclose(packet.q_ext, [0.1])
    assert (packet.utilization, packet.robot_ns, packet.T_frame_tool[0, 3]) == (12.5, 1_250_000_000, 0.1)
    assert (packet.qd, packet.queue_depth) == (None, -1)


def test_old_versions_are_in_radians(six: Any) -> None:
    of = numbers(joints=(1.0,) * 6, external=(2.0,))
    form = shape(AxisMap(six), of, "6.06")
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (0,) * len(INTEGERS))
    np.testing.assert_array_equal(packet.q, np.ones(6))
    np.testing.assert_array_equal(packet.q_ext, [2.0])


def test_offsets_are_arranged_as_values_are(yumi: Any) -> None:
    offsets = {"feedBack.joints.joints": list(range(6)), "feedBack.externalJoints.joints": [6], "utilizationRate": [9]}
    of = Numbers.of_offsets(offsets)
    arranged = shape(AxisMap(yumi), of).arranged(of, -1)
    assert arranged[:7] == [0, 1, 6, 2, 3, 4, 5]
    assert arranged[-8:] == [9] + [-1] * 7


def test_what_is_not_finite_gives_no_packet(six: Any) -> None:
    of = numbers(joints=(1.0,) * 5 + (np.inf,))
    form = shape(AxisMap(six), of)
    assert form.reader.packet(form.arranged(of, 0.0), (0,) * 6) is None


def test_wrong_counts(six: Any) -> None:
    with pytest.raises(Refused):
        shape(AxisMap(six), numbers(joints=(1.0,) * 5))


def test_a_signalling_nan_does_not_warn(six: Any) -> None:
    """NumPy warns of one in a product; in a loop whose warnings are errors that would be an exception."""
    signalling = struct.unpack("<d", bytes.fromhex("010000000000f07f"))[0]
    of = numbers(joints=(1.0,) * 6, planned=(signalling,) * 6)
    form = shape(AxisMap(six), of)
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (0,) * 6)
    assert np.isnan(packet.q_planned).all()

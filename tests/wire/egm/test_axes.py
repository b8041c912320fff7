"""The map between ABB's axes and joints, also for robots whose motors move two joints."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ConfigError, RobotError
from armlab.wire.egm import Drop, EgmCodec, Packet, Reference
from armlab.wire.egm.axes import Linkage
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

from .conftest import YUMI, arm


def heard(codec: EgmCodec, wire: Any, joints: list[float], external: list[float]) -> Packet | Drop:
    time = wire.m(4, wire.u(1, 7), wire.u(2, 0))  # RobotWare 6.06, which has none, sends radians
    motion = wire.m(1, wire.joints(*joints)), wire.m(3, wire.d(1, *external)), time
    return codec.decode(wire.header(3, 4) + wire.m(2, *motion))


SCARA = arm(np.eye(4), linear=(2,))
DEGREES = ("deg",) * 4


@pytest.mark.parametrize(
    ("robot", "units", "joints", "external", "q", "q_ext"),
    [
        # the start targets of ABB's templates: [0, -130, 30, 0, 40, 0], eax_a = 135 left, -135 right
        (arm(np.eye(7), YUMI), (), [0, -130, 30, 0, 40, 0], [135], [0, -130, 135, 30, 0, 40, 0], []),
        (arm(np.eye(7), YUMI), (), [0, -130, 30, 0, 40, 0], [-135, 9], [0, -130, -135, 30, 0, 40, 0], [9]),
        # -90 mm arrived as -5.155 (abb_libegm, pull request 142): metres with the rotary factor
        (SCARA, (), [10, 20, -5.156620156177409, 30], [], [10, 20, -0.09 * 180 / pi, 30], []),
        (SCARA, (*DEGREES, "mm"), [1, 2, 3, 4], [500, 90], [1, 2, 3, 4], [0.5 * 180 / pi, 90]),
        (SCARA, ("deg", "deg", "mm", "deg"), [10, 20, -90, 30], [], [10, 20, -0.09 * 180 / pi, 30], []),
        (arm(np.eye(7), linear=(6,)), (), [0] * 6, [250], [0] * 6 + [0.25 * 180 / pi], []),  # beyond the sixth: mm
        (arm(np.eye(1)), (), [5], [], [5], []),
    ],
)
def test_axes_of_the_wire_are_joints(wire, robot, units, joints, external, q, q_ext) -> None:
    codec = EgmCodec(robot, units=units)
    packet = heard(codec, wire, joints, external)
    assert isinstance(packet, Packet)
    np.testing.assert_allclose(packet.q, np.radians(q), rtol=1e-14)
    np.testing.assert_allclose(packet.q_ext, np.radians(q_ext), rtol=1e-14)
    if not units:
        message: Any = RobotSideCodec(robot).decode_sensor(codec.encode(Reference(packet.q, None, None, 1, 2)))
        np.testing.assert_allclose(message.q, packet.q, rtol=1e-14)


@pytest.mark.parametrize(
    ("joints", "external", "reason"),
    [
        ([], [], "no joints"),
        ([], [7], "no joints"),
        ([1, 2, 3, 4, 5], [7], "joint count"),
        ([1, 2, 3, 4, 5, 6, 7], [], "joint count"),
        ([1, 2, 3, 4, 5, 6], [], "joint count"),
    ],
)
def test_wrong_counts_are_dropped_by_name(wire: Any, joints: list[float], external: list[float], reason: str) -> None:
    found: Any = heard(EgmCodec(arm(np.eye(7), YUMI)), wire, joints, external)
    assert found.reason == reason


def test_axes_and_units_that_fit_no_robot() -> None:
    with pytest.raises(RobotError, match="a permutation of 1 to 2"):
        EgmCodec(arm(np.eye(2), (1, 3)))
    for units in (("deg",) * 3, ("deg",) * 3 + ("inch",)):
        with pytest.raises(ConfigError, match=r'"deg" or "mm" for at least 4 joints'):
            EgmCodec(SCARA, units=units)


IRB2400 = robots.load("irb2400")


ROD: Any = Linkage.of(IRB2400)


def test_gears_alone_are_no_linkage() -> None:
    assert Linkage.of(robots.load("yumi_left")) is None
    assert Linkage.of(arm(np.diag([0.01, -0.01, 1.0]))) is None
    geared: Any = Linkage.of(arm([[0.01, 0.0], [-0.01, 0.02]]))
    np.testing.assert_allclose(geared.axes(np.array([0.3, 0.4])), [0.3, 0.7], atol=1e-15)


def test_axis_3_is_counted_from_the_foot() -> None:
    q = np.array([0.1, 0.5, -0.8, 0.2, 0.3, 0.4])
    axes = ROD.axes(q)
    np.testing.assert_allclose(axes, [0.1, 0.5, -0.3, 0.2, 0.3, 0.4], atol=1e-15)
    np.testing.assert_allclose(ROD.joints(axes), q, atol=1e-15)
    lost = ROD.joints(np.array([np.nan, 0.5, -0.3, 0.2, 0.3, np.inf]))
    np.testing.assert_allclose(lost[1:5], q[1:5], atol=1e-15)


def test_power_is_the_same_on_both_sides() -> None:
    rng = np.random.default_rng(1)
    qd, tau = rng.normal(size=(2, 6))
    said = ROD.to_axes(RobotMessage(0, 0, qd, qd=qd, tau=tau))
    assert said.tau @ said.qd == pytest.approx(tau @ qd)
    back = ROD.from_axes(said)
    np.testing.assert_allclose(back.tau, tau)
    np.testing.assert_allclose(back.qd, qd)
    assert back.q_planned is None


def test_on_the_wire_are_axes(wire: Any) -> None:
    q = np.radians([0, 60, -80, 10, 20, 30])
    packet = heard(EgmCodec(IRB2400), wire, [0, 60, -20, 10, 20, 30], [])
    assert isinstance(packet, Packet)
    np.testing.assert_allclose(packet.q, q)
    codec = EgmCodec(IRB2400, extension=True)
    reply = codec.encode(Reference(q, 0 * q, np.arange(6.0), 1, 2))
    assert wire.m(1, wire.d(1, *np.degrees(ROD.axes(q)))) in reply
    found: Any = RobotSideCodec(IRB2400).decode_sensor(reply)
    np.testing.assert_allclose(found.q, q)
    np.testing.assert_allclose(found.tau, np.arange(6.0))
    message = RobotMessage(1, 2, q, q, qd=q, tau=q, tau_gravity=2 * q)
    data = RobotSideCodec(IRB2400, extension=True).encode_robot(message)
    packet = codec.decode(data)
    assert isinstance(packet, Packet)
    for values in (packet.q, packet.qd, packet.tau, packet.q_planned):
        np.testing.assert_allclose(values, q)
    details: Any = codec.details(data)
    np.testing.assert_allclose(details.tau_gravity, 2 * q)


@pytest.mark.parametrize("coupling", [[[0.0, 1.0], [1.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]])
def test_couplings_from_which_axes_cannot_be_told(coupling: Any) -> None:
    with pytest.raises(RobotError, match="an invertible coupling"):
        Linkage.of(arm(coupling))

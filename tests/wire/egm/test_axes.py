"""The map between ABB's axes and joints, also of robots whose motors move two joints."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ConfigError, RobotError
from armlab.wire.egm import EgmCodec, Packet, Reference
from armlab.wire.egm.axes import RADIAN, AxisMap, Linkage, Refused
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec, SensorMessage


@pytest.mark.parametrize("elbow", [135.0, -135.0])
def test_both_signs_of_the_yumi_elbow(yumi: Any, elbow: float) -> None:
    """The start targets of ABB's templates: [0, -130, 30, 0, 40, 0], eax_a = 135 left, -135 right."""
    axes = AxisMap(yumi)
    q = np.array(axes.joints([0, -130, 30, 0, 40, 0], [elbow])) * axes.scale
    expected = [0.0, -2.268928027592628, np.copysign(2.356194490192345, elbow), 0.5235987755982988, 0.0]
    np.testing.assert_allclose(q[:5], expected, rtol=1e-15)
    assert axes.wire(q, axes.scale) == pytest.approx((0, -130, 30, 0, 40, 0, elbow))


def test_scara_linear_joint_is_metres_with_the_rotary_factor(scara: Any) -> None:
    """-90 mm arrived as -5.155 (abb_libegm, pull request 142)."""
    axes = AxisMap(scara)
    q = np.array(axes.joints([10, 20, -5.156620156177409, 30], [])) * axes.scale
    np.testing.assert_allclose(q, [10 * RADIAN, 20 * RADIAN, -0.09, 30 * RADIAN], rtol=1e-12)
    assert not axes.can_move


def test_linear_axis_beyond_the_sixth_is_in_millimetres() -> None:
    arm = SimpleNamespace(
        n=7, prismatic=np.array([False] * 6 + [True]), abb_axes=(1, 2, 3, 4, 5, 6, 7), coupling=np.eye(7)
    )
    axes = AxisMap(arm)
    assert axes.scale[6] == 1e-3
    assert axes.can_move


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
def test_wrong_counts_are_refused_by_name(yumi: Any, joints: list[float], external: list[float], reason: str) -> None:
    with pytest.raises(Refused) as refused:
        AxisMap(yumi).joints(joints, external)
    assert refused.value.drop.reason == reason


def test_extension_arrays_in_both_orders(yumi: Any) -> None:
    axes = AxisMap(yumi)
    assert axes.array([1.0, 2, 3, 4, 5, 6, 7], is_kinematic=False) == (1, 2, 7, 3, 4, 5, 6)
    assert axes.array([1.0, 2, 7, 3, 4, 5, 6], is_kinematic=True) == (1, 2, 7, 3, 4, 5, 6)
    assert axes.array([], is_kinematic=True) is None
    with pytest.raises(Refused):
        axes.array([1.0] * 6, is_kinematic=True)


def test_one_joint() -> None:
    axes = AxisMap(SimpleNamespace(n=1, prismatic=np.array([False]), abb_axes=(1,), coupling=np.eye(1)))
    assert axes.joints([5.0], []) == (5.0,)
    assert axes.wire(np.array([5.0]), np.ones(1)) == (5.0,)


def test_axes_that_are_no_permutation() -> None:
    with pytest.raises(RobotError, match="each of 1 to 2 once"):
        AxisMap(SimpleNamespace(n=2, prismatic=np.zeros(2, bool), abb_axes=(1, 3), coupling=np.eye(2)))


def test_units_of_each_axis(scara: Any) -> None:
    """Where the user knows the units; external axes follow the joints, and the rest of them is in degrees."""
    axes = AxisMap(scara, ("deg", "deg", "mm", "deg", "mm"))
    assert axes.can_move
    np.testing.assert_array_equal(axes.scale, [RADIAN, RADIAN, 1e-3, RADIAN])
    np.testing.assert_array_equal(axes.external_scale(2), [1e-3, RADIAN])
    assert axes.external_scale(0).shape == (0,)
    for units in (("deg",) * 3, ("deg",) * 3 + ("inch",)):
        with pytest.raises(ConfigError, match=r'"deg" or "mm" for 4 joints'):
            AxisMap(scara, units)


IRB2400 = robots.load("irb2400")


def arm(coupling: Any) -> Any:
    n = len(coupling)
    return SimpleNamespace(
        n=n, prismatic=np.zeros(n, bool), abb_axes=tuple(range(1, n + 1)), coupling=np.array(coupling)
    )


def rod() -> Linkage:
    found = Linkage.of(IRB2400)
    assert found is not None
    return found


def test_gears_alone_are_no_linkage() -> None:
    """They are ABB's own business: EGM is behind the gears."""
    assert Linkage.of(robots.load("yumi_left")) is None
    assert Linkage.of(arm(np.diag([0.01, -0.01, 1.0]))) is None
    geared = Linkage.of(arm([[0.01, 0.0], [-0.01, 0.02]]))
    assert geared is not None
    np.testing.assert_allclose(geared.axes(np.array([0.3, 0.4])), [0.3, 0.7], atol=1e-15)


def test_axis_3_is_counted_from_the_foot() -> None:
    q = np.array([0.1, 0.5, -0.8, 0.2, 0.3, 0.4])
    axes = rod().axes(q)
    np.testing.assert_allclose(axes, [0.1, 0.5, -0.3, 0.2, 0.3, 0.4], atol=1e-15)
    np.testing.assert_allclose(rod().joints(axes), q, atol=1e-15)
    lost = rod().joints(np.array([np.nan, 0.5, -0.3, 0.2, 0.3, np.inf]))
    np.testing.assert_allclose(lost[1:5], q[1:5], atol=1e-15)


def test_power_is_the_same_on_both_sides() -> None:
    rng = np.random.default_rng(1)
    qd, tau = rng.normal(size=(2, 6))
    said = rod().said(RobotMessage(0, 0, qd, qd=qd, tau=tau))
    assert said.tau @ said.qd == pytest.approx(tau @ qd)
    back = rod().heard(said)
    np.testing.assert_allclose(back.tau, tau)
    np.testing.assert_allclose(back.qd, qd)
    assert back.q_planned is None


def test_on_the_wire_are_axes(wire: Any) -> None:
    """Joints at 0, 60 and -80 degrees are ABB's axes at 0, 60 and -20."""
    q = np.radians([0, 60, -80, 10, 20, 30])
    motion = wire.m(1, wire.joints(0.0, 60, -20, 10, 20, 30)), wire.m(4, wire.u(1, 7), wire.u(2, 0))
    data, plain = wire.header(3, 4) + wire.m(2, *motion), EgmCodec(IRB2400)
    for _ in range(2):  # parsed, and read where the numbers lay
        packet = plain.decode(data)
        assert isinstance(packet, Packet)
        np.testing.assert_allclose(packet.q, q)
    codec = EgmCodec(IRB2400, extension=True)
    reply = codec.encode(Reference(q, 0 * q, np.arange(6.0), 1, 2))
    assert wire.m(1, wire.d(1, *np.degrees(rod().axes(q)))) in reply
    found = RobotSideCodec(IRB2400).decode_sensor(reply)
    assert isinstance(found, SensorMessage)
    np.testing.assert_allclose(found.q, q)
    np.testing.assert_allclose(found.tau, np.arange(6.0))
    message = RobotMessage(1, 2, q, q, qd=q, tau=q, tau_gravity=2 * q)
    data = RobotSideCodec(IRB2400, extension=True).encode_robot(message)
    packet = codec.decode(data)
    assert isinstance(packet, Packet)
    for values in (packet.q, packet.qd, packet.tau, packet.q_planned):
        np.testing.assert_allclose(values, q)
    details = codec.details(data)
    assert details is not None
    np.testing.assert_allclose(details.tau_gravity, 2 * q)


@pytest.mark.parametrize("coupling", [[[0.0, 1.0], [1.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]])
def test_couplings_from_which_axes_cannot_be_told(coupling: Any) -> None:
    with pytest.raises(RobotError, match="coupling that can be inverted"):
        Linkage.of(arm(coupling))

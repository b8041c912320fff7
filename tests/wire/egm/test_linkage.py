"""An IRB 2400, whose axis 3 is q_2 + q_3: numbers by hand, and power that stays the same."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError
from armlab.wire.egm import EgmCodec, Packet, Reference, RobotMessage, RobotSideCodec, SensorMessage
from armlab.wire.egm.axes import Linkage

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

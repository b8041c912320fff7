"""Order and units of joints, against numbers typed by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError, RobotError
from armlab.wire.egm.axes import RADIAN, AxisMap, Refused


def test_yumi_order(yumi: Any) -> None:
    """ABB's axis 7 is the third joint: q = (1, 2, 7, 3, 4, 5, 6)."""
    axes = AxisMap(yumi)
    assert axes.joints([1, 2, 3, 4, 5, 6], [7]) == (1, 2, 7, 3, 4, 5, 6)
    assert axes.wire(np.array([1.0, 2, 7, 3, 4, 5, 6]), np.ones(7)) == (1, 2, 3, 4, 5, 6, 7)
    assert (axes.head, axes.tail) == (6, 1)
    np.testing.assert_array_equal(axes.scale, np.full(7, np.pi / 180))


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


def test_external_axes_may_follow(six: Any, yumi: Any) -> None:
    assert AxisMap(six).joints([1, 2, 3, 4, 5, 6], [100, 200]) == (1, 2, 3, 4, 5, 6)
    assert AxisMap(yumi).joints([1, 2, 3, 4, 5, 6], [7, 100])[2] == 7


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

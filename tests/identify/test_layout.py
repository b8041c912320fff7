"""Names, units, bounds and places of the parameters."""

from __future__ import annotations

import numpy as np

from armlab.identify import base_parameters
from armlab.identify.regression import Layout


def test_every_parameter_has_one_name_unit_bound_and_place(short_arm) -> None:
    robot = short_arm.robot
    base = base_parameters(robot)
    p, motors = len(base.names), np.array([[1.0, 1.0]])
    terms = (("viscous", "coulomb", "offset", "delta"), ("viscous", "coulomb+", "coulomb-", "offset", "root"))
    layout = Layout(robot, base, np.arange(2), motors, np.array([1]), terms)
    assert len(layout.names) == len(layout.units) == len(layout.lower) == len(layout.slopes) == p + 4 + 5 + 3
    assert len(set(layout.names)) == len(layout.names)
    np.testing.assert_array_equal(np.flatnonzero(layout.slopes), [p + 3])
    assert layout.names[p + 3] == f"delta {robot.joint_names[0]}"
    assert layout.units[p + 3] == "rad"
    assert layout.units[p + 8] == "N m sqrt(s/rad)"
    np.testing.assert_array_equal(layout.lower[p : p + 4], [0.0, 0.0, -np.inf, -np.inf])
    for i, (columns, own) in enumerate(zip(layout.columns, ([*range(p, p + 4)], [*range(p + 4, p + 9)]))):
        motor = [p + 9, p + 10, p + 11]
        np.testing.assert_array_equal(columns, [*np.flatnonzero(base.seen[i]), *own, *motor])

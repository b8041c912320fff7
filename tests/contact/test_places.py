"""Places of contact: in metres, and no further off than the arm is long."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.contact import Estimator, hypotheses
from armlab.contact.estimator import check_distance, contact_point
from armlab.errors import ShapeError
from armlab.robots.outline import arm_length


def test_a_point_is_three_finite_numbers_of_its_own() -> None:
    robot, given = robots.load("ur5e"), np.array([0.0, 0.0, 0.12])
    point = contact_point(given, robot)
    np.testing.assert_array_equal(point, given)
    assert not np.shares_memory(point, given)
    for wrong in ((0.0, 0.0), (0.0, np.inf, 0.0)):
        with pytest.raises(ShapeError, match="three finite numbers"):
            contact_point(wrong, robot)


def test_millimetres_are_refused_and_a_tool_as_long_as_the_arm_is_not() -> None:
    robot = robots.load("ur5e")
    check_distance(np.array([[0.0, 0.0, 0.999 * arm_length(robot)], [0.1, 0.0, 0.0]]), robot)
    check_distance(np.zeros((0, 3)), robot)
    with pytest.raises(ShapeError, match=r"within \S+ m of the tool.*'ur5e', got one 120 m away.*millimetres by 1000"):
        check_distance(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 120.0]]), robot)


def test_estimators_and_hypotheses_ask_for_it(truth, model, excited) -> None:
    table = Estimator(model, truth.robot, point=(0.0, 0.0, 0.12)).run(excited.between(3.0, 6.0))
    with pytest.raises(ShapeError, match="120 m away"):
        Estimator(model, truth.robot, point=(0.0, 0.0, 120.0))
    with pytest.raises(ShapeError, match="120 m away"):
        hypotheses(table, truth.robot, point=(0.0, 0.0, 120.0))
    with pytest.raises(ShapeError, match="100 m away"):
        hypotheses(table, truth.robot, segment=[(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)])

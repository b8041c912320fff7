"""The two poses of a camera and a marker: names by setup, file, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import FrameError
from armlab.lie import se3
from armlab.models import HandEye
from armlab.models.hand_eye import FRAMES

X = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
Y = se3.exp(np.array([1.0, -2.0, 0.5, -1.0, 2.0, 0.1]))


def test_poses_have_the_names_of_their_setup() -> None:
    assert tuple(FRAMES) == ("eye_to_hand", "eye_in_hand")
    still, held = HandEye("eye_to_hand", X, Y), HandEye("eye_in_hand", X, Y)
    np.testing.assert_array_equal(still.T_tool_marker, X)
    np.testing.assert_array_equal(still.T_base_cam, Y)
    np.testing.assert_array_equal(held.T_base_marker, X)
    np.testing.assert_array_equal(held.T_tool_cam, Y)
    with pytest.raises(FrameError, match="T_tool_marker or T_base_cam, got T_tool_cam"):
        still.T_tool_cam
    with pytest.raises(FrameError, match="T_base_marker or T_tool_cam, got T_base_cam"):
        held.T_base_cam
    with pytest.raises(ValueError, match="read-only"):
        still.X[0, 0] = 1.0


def test_a_marker_of_unknown_shape_has_points_and_no_pose() -> None:
    seen = HandEye("eye_to_hand", None, Y, np.ones((2, 3)))
    assert seen.points is not None
    np.testing.assert_array_equal(seen.T_base_cam, Y)
    with pytest.raises(FrameError, match="has points and no pose"):
        seen.T_tool_marker

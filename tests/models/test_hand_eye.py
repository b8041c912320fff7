"""The two poses of a camera and a marker: names by setup, file, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import FrameError, ShapeError, UnknownName
from armlab.lie import se3
from armlab.models import HandEye, load, save
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


@pytest.mark.parametrize("value", [HandEye("eye_in_hand", X, Y), HandEye("eye_to_hand", None, Y, np.full((2, 3), 0.1))])
def test_file_is_bit_equal(tmp_path, value: HandEye) -> None:
    again = load(save(value, tmp_path / "camera.toml"), kind="hand_eye")
    assert again.setup == value.setup
    for name in ("X", "Y", "points"):
        one, other = getattr(value, name), getattr(again, name)
        assert (one is None) == (other is None)
        assert one is None or one.tobytes() == other.tobytes()


def test_what_is_no_calibration_is_refused() -> None:
    with pytest.raises(UnknownName, match="eye_in_hand, eye_to_hand"):
        HandEye("eye", X, Y)
    with pytest.raises(ShapeError, match="pose Y"):
        HandEye("eye_to_hand", X, Y[:3])
    with pytest.raises(ShapeError, match="rotation"):
        HandEye("eye_to_hand", 2.0 * X, Y)
    with pytest.raises(ShapeError, match=r"points \(K, 3\)"):
        HandEye("eye_to_hand", None, Y, np.full((2, 3), np.nan))

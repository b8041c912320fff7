"""`plots.manipulability`: the ellipsoid is the image of the unit ball of joint speeds."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.plots.arm import manipulability


@pytest.mark.parametrize("part", ["position", "rotation"])
@pytest.mark.parametrize("name", ["yumi_right", "irb2400"])
def test_the_surface_is_the_image_of_unit_speeds(name: str, part: str) -> None:
    arm = robots.load(name)
    q = np.array([arm.q_home, arm.q_home + 0.3])
    ax = manipulability(arm, q, part)
    balls = [c for c in ax.collections if c.get_gid() == "ellipsoid"]
    assert len(balls) == 2
    scale = float(ax.get_title().split(" is drawn ")[1].split()[0])
    for ball, configuration in zip(balls, q, strict=True):
        J = (
            kinematics.jacobian(arm, configuration)[:3]
            if part == "position"
            else kinematics.jacobian(arm, configuration)[3:]
        )
        centre = kinematics.forward(arm, configuration)[:3, 3]
        from_centre = (np.asarray(ball._faces).reshape(-1, 3) - centre) / scale
        assert np.einsum("ki,ij,kj->k", from_centre, np.linalg.inv(J @ J.T), from_centre) == pytest.approx(1, rel=0.05)
    s = np.linalg.svd(J, compute_uv=False)
    assert f"half axes {', '.join(f'{x:.3g}' for x in s)} {'m/s' if part == 'position' else 'rad/s'}" in ax.get_title()
    assert f"manipulability {kinematics.manipulability(arm, q[-1], part):.3g};" in ax.get_title()
    assert len([line for line in ax.lines if line.get_gid() == "axis"]) == 6


def test_a_flat_ellipsoid_of_a_planar_arm() -> None:
    arm = robots.from_dh("planar", [0, 0], [0.5, 0.3], [0, 0])
    title = manipulability(arm, [0.3, 1.0]).get_title()
    J = kinematics.jacobian(arm, [0.3, 1.0])[:3]
    s = np.linalg.svd(J, compute_uv=False)
    assert f"half axes {s[0]:.3g}, {s[1]:.3g}, 0 m/s" in title
    assert f"manipulability {s[0] * s[1]:.3g};" in title


def test_at_most_eight_are_drawn() -> None:
    arm = robots.load("irb2400")
    ax = manipulability(arm, np.linspace(arm.q_home, arm.q_home + 1, 40))
    assert sum(c.get_gid() == "ellipsoid" for c in ax.collections) == 8
    assert manipulability(arm, ax=ax) is ax


def test_bad_input() -> None:
    arm = robots.load("irb2400")
    with pytest.raises(UnknownName, match="'force'"):
        manipulability(arm, part="force")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="Expected q"):
        manipulability(arm, np.zeros(7))
    with pytest.raises(RobotError, match="Load it first"):
        manipulability("irb2400")  # type: ignore[arg-type]

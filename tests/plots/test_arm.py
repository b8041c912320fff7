"""`plots.robot`: the drawing agrees with the kinematics."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ConfigError, RobotError, ShapeError, UnknownName
from armlab.lie import se3
from armlab.plots.arm import manipulability, robot, stick, workspace
from armlab.plots.style import JOINT_STYLES
from armlab.robots import Robot

TOOL = se3.from_rp(se3.exp([0, 0, 0, 0.3, 0.2, -0.4])[:3, :3], [0.01, -0.02, 0.15])


def sliding() -> Robot:
    limits = {"q_min": [-2, -2, 0, -3], "q_max": [2, 2, 0.3, 3]}
    return robots.from_dh(
        "scara", [0, np.pi, 0, 0], [0.4, 0.3, 0, 0], [0.5, 0, 0, 0.05], prismatic=[0, 0, 1, 0], **limits
    )


@pytest.fixture(params=["yumi_left", "dh_test", "with a tool", "sliding"])
def arm(request: pytest.FixtureRequest) -> Robot:
    special = {"with a tool": lambda: robots.load("irb2400").with_tool(TOOL), "sliding": sliding}
    return special.get(request.param, lambda: robots.load(request.param))()


def drawn(ax: plt.Axes, gid: str) -> list[np.ndarray]:
    return [np.stack(line.get_data_3d(), axis=-1) for line in ax.lines if line.get_gid() == gid]


def contains(points: np.ndarray, p: np.ndarray) -> bool:
    return bool((np.linalg.norm(points - p, axis=1) < 1e-12).any())


def test_the_stick_passes_through_every_frame(arm: Robot) -> None:
    rng = np.random.default_rng(1)
    low, high = np.where(np.isinf(arm.q_min), -3, arm.q_min), np.where(np.isinf(arm.q_max), 3, arm.q_max)
    for q in rng.uniform(low, high, (5, arm.n)):
        points = stick(arm, q)
        T_base_tool = kinematics.forward(arm, q)
        assert np.array_equal(points[0], arm.T_base_mount[:3, 3])
        assert points[-1] == pytest.approx(T_base_tool[:3, 3], abs=1e-9)
        for T in kinematics.link_transforms(arm, q):
            assert contains(points, T[:3, 3])
        assert contains(points, (T_base_tool @ se3.inv(arm.T_flange_tool))[:3, 3])


def test_links_follow_joint_axes_and_common_normals() -> None:
    """IRB 2400 at zero: up the column, out to the shoulder, up, back along the forearm's axis."""
    points = stick(robots.load("irb2400"), np.zeros(6))
    assert points[:3] == pytest.approx(np.array([[0, 0, 0], [0, 0, 0.615], [0.1, 0, 0.615]]), abs=1e-12)
    steps = np.diff(points, axis=0)
    assert np.abs(np.sort(np.abs(steps), axis=1)[:, :2]).max() < 1e-12  # each segment is along one of the base axes
    almost_parallel = robots.from_dh("bent", [1e-4, 0, 0], [0.3, 0.2, 0.1], [0.0, 0.1, 0.0])
    assert np.abs(stick(almost_parallel, np.ones(3))).max() < 1.0  # no bend far away from the arm


def test_one_configuration_in_full(arm: Robot) -> None:
    q = arm.q_home + 0.01
    ax = robot(arm, q)
    (line,) = drawn(ax, "arm")
    assert np.array_equal(line, stick(arm, q))
    for i, T in enumerate(kinematics.link_transforms(arm, q)):
        (joint,) = [part for part in ax.collections if part.get_gid() == f"joint {i + 1}"]
        corners = np.asarray(joint._faces).reshape(-1, 3) - T[:3, 3]
        along, across = corners @ T[:3, 2], np.linalg.norm(np.cross(corners, T[:3, 2]), axis=1)
        start = -q[i] if arm.prismatic[i] else 0.0  # the box of a prismatic joint stays at its start
        assert (along.min() + along.max()) / 2 == pytest.approx(start, abs=1e-9)
        assert across.max() < np.ptp(along)
    assert len(np.asarray(joint._faces)) > 12 or arm.prismatic[-1]
    labels = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    assert labels == list(arm.joint_names)
    colors = [handle.get_color() for handle in ax.figure.legends[0].legend_handles]
    assert colors == [JOINT_STYLES[i][0] for i in range(arm.n)]


def test_frames_of_base_flange_and_tool() -> None:
    arm = robots.load("irb2400").with_tool(TOOL)
    T_base_tool = kinematics.forward(arm, arm.q_home)
    poses = {"base": np.eye(4), "flange": T_base_tool @ se3.inv(TOOL), "tool": T_base_tool}
    ax = robot(arm)
    for name, T in poses.items():
        for i in range(3):
            (axis,) = [patch for patch in ax.patches if patch.get_gid() == f"{name}.{'xyz'[i]}"]
            along = np.diff(axis.ends, axis=0)[0]
            assert axis.ends[0] == pytest.approx(T[:3, 3])
            assert along / np.linalg.norm(along) == pytest.approx(T[:3, i])
    words = [text.get_text() for text in robot(robots.load("irb2400")).texts]
    assert "tool" in words  # without a tool it is the flange
    assert "flange" not in words
    assert not robot(arm, frames=False).texts


def test_several_configurations_and_the_path_of_the_tool() -> None:
    arm = robots.load("yumi_left")
    q = np.linspace(arm.q_home, arm.q_home + 0.5, 30)
    ax = robot(arm, q, path=True)
    (path,) = drawn(ax, "path")
    assert np.array_equal(path, kinematics.forward(arm, q)[:, :3, 3])
    assert np.array_equal(drawn(ax, "arm")[0], stick(arm, q[-1]))
    faint = drawn(ax, "faint")
    assert len(faint) == 8
    assert np.array_equal(faint[0], stick(arm, q[0]))
    assert len(drawn(robot(arm, q[:3]), "faint")) == 2
    assert not drawn(robot(arm, q[:3]), "path")
    (mount,) = drawn(ax, "mount")
    assert np.array_equal(mount, [np.zeros(3), arm.T_base_mount[:3, 3]])


@pytest.mark.parametrize("q", [np.zeros(5), np.zeros((2, 7)), np.zeros((1, 2, 6)), np.zeros((0, 6)), 0.0])
def test_wrong_shapes_are_refused(q: np.ndarray) -> None:
    for draw in (robot, manipulability):
        with pytest.raises(ShapeError, match=r"Expected q of shape \(6,\) or \(N, 6\) to draw irb2400"):
            draw(robots.load("irb2400"), q)


def test_what_cannot_be_drawn_is_refused() -> None:
    arm, flat = robots.load("irb2400"), plt.figure().add_subplot()
    slide = robots.from_dh("slide", [0, 0], [0, 0.2], [0, 0], prismatic=[True, False])
    for misuse, error, words in (
        (lambda: robot(arm, [[0] * 6, [0, 0, np.nan, 0, 0, 0]]), ShapeError, "finite q"),
        (lambda: robot(arm, ax=flat), ShapeError, "3d"),
        (lambda: robot(arm, "home"), ShapeError, "q to be real numbers, got 'home'"),
        (lambda: robot("irb2400"), RobotError, r"Load the robot first: robots.load\('irb2400'\)"),
        (lambda: workspace(slide), RobotError, "joint_1 of slide"),
        (lambda: workspace(arm, points=5, ax=[flat] * 3), ShapeError, "3d"),
        (lambda: workspace(arm, points=0), ShapeError, "points=0"),
        (lambda: workspace(arm, points=1.5), ShapeError, "points=1.5"),
        (lambda: workspace(arm, points=5, seed=-1), ConfigError, "seed to be an integer >= 0, got -1"),
        (lambda: manipulability(arm, part="force"), UnknownName, "'force'"),
    ):
        with pytest.raises(error, match=words):
            misuse()


def clouds(figure: plt.Figure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    side, top, solid = figure.axes
    flat = [next(line for line in ax.lines if line.get_gid() == "cloud").get_xydata() for ax in (side, top)]
    return flat[0], flat[1], np.stack(solid.collections[0]._offsets3d, axis=-1)


def test_a_planar_arm_reaches_its_ring() -> None:
    arm = robots.from_dh("planar", [0, 0], [0.5, 0.3], [0, 0], q_min=[-np.pi, -2.0], q_max=[np.pi, 2.0])
    figure = workspace(arm, points=4000)
    side, top, solid = clouds(figure)
    reach = np.linalg.norm(solid, axis=1)
    nearest = np.sqrt(0.5**2 + 0.3**2 + 2 * 0.5 * 0.3 * np.cos(2.0))
    assert nearest - 1e-12 <= reach.min() < nearest + 0.01
    assert 0.79 < reach.max() <= 0.8 + 1e-12
    assert np.array_equal(top, solid[:, :2])
    assert np.array_equal(side, solid[:, [0, 2]])
    assert np.abs(solid[:, 2]).max() < 1e-15
    title = figure.axes[0].get_title(loc="left")
    assert title == f"planar\ntool {reach.min():.2f} to {reach.max():.2f} m from the mount"
    assert figure.axes[1].get_title(loc="left") == "4000 random configurations"
    assert [ax.get_xlabel() + ax.get_ylabel() for ax in figure.axes] == ["x [m]z [m]", "x [m]y [m]", "x [m]y [m]"]
    assert np.array_equal(figure.axes[1].lines[1].get_xydata(), stick(arm, arm.q_home)[:, :2])


def test_nothing_is_cut_off() -> None:
    figure = workspace(robots.load("dh_test"), points=200)
    figure.canvas.draw()
    side, top, solid = figure.axes
    assert side.bbox.height == pytest.approx(top.bbox.height)
    labels = [axis.label for axis in (solid.xaxis, solid.yaxis, solid.zaxis)]
    for text in [*labels, side.title, side._left_title, top._left_title]:
        box = text.get_window_extent()
        assert figure.bbox.contains(box.x0, box.y0)
        assert figure.bbox.contains(box.x1, box.y1)
    assert side._left_title.get_window_extent().x1 < top._left_title.get_window_extent().x0


def test_a_seed_gives_one_cloud() -> None:
    arm = robots.load("yumi_left")
    first, again, other = (clouds(workspace(arm, points=50, seed=seed))[2] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(clouds(workspace(robots.load("dh_test"), points=10))[2]) == 10, "joints without limits turn once"


@pytest.mark.parametrize(("name", "part"), [("yumi_right", "position"), ("irb2400", "rotation")])
def test_the_surface_is_the_image_of_unit_speeds(name: str, part: str) -> None:
    arm = robots.load(name)
    q = np.array([arm.q_home, arm.q_home + 0.3])
    ax = manipulability(arm, q, part)
    balls = [c for c in ax.collections if c.get_gid() == "ellipsoid"]
    assert len(balls) == 2
    scale = float(ax.get_title().split(" = ")[-1].split()[0])
    for ball, configuration in zip(balls, q, strict=True):
        J = kinematics.jacobian(arm, configuration)[slice(3) if part == "position" else slice(3, 6)]
        centre = kinematics.forward(arm, configuration)[:3, 3]
        from_centre = (np.asarray(ball._faces).reshape(-1, 3) - centre) / scale
        assert np.einsum("ki,ij,kj->k", from_centre, np.linalg.inv(J @ J.T), from_centre) == pytest.approx(1, rel=0.05)
    s = np.linalg.svd(J, compute_uv=False)
    assert f"half-axes {', '.join(f'{x:.3g}' for x in s)} {'m/s' if part == 'position' else 'rad/s'}" in ax.get_title()
    assert f"manipulability {kinematics.manipulability(arm, q[-1], part):.3g};" in ax.get_title()
    assert len([line for line in ax.lines if line.get_gid() == "axis"]) == 6


def test_a_flat_ellipsoid_of_a_planar_arm_and_at_most_eight_of_many() -> None:
    arm = robots.from_dh("planar", [0, 0], [0.5, 0.3], [0, 0])
    title = manipulability(arm, [0.3, 1.0]).get_title()
    s = np.linalg.svd(kinematics.jacobian(arm, [0.3, 1.0])[:3], compute_uv=False)
    assert f"half-axes {s[0]:.3g}, {s[1]:.3g}, 0 m/s" in title
    assert f"manipulability {s[0] * s[1]:.3g};" in title
    ax = manipulability(arm, np.linspace([0.3, 0.1], [0.3, 1.0], 40))
    assert sum(c.get_gid() == "ellipsoid" for c in ax.collections) == 8

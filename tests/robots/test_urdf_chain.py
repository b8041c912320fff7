"""Chains of URDF trees against Pinocchio: random trees and a dual arm, downwards, upwards and across."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from armlab import kinematics, robots
from armlab.errors import RobotError, UnknownName
from armlab.robots import Robot, inertia, urdf

KINDS = ("revolute", "continuous", "prismatic", "fixed")


@dataclass
class Body:
    """The generator's data of a link: its parent, and its mass properties in its own frame."""

    parent: int
    kind: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray


def words(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def random_tree(rng: np.random.Generator) -> tuple[str, list[Body]]:
    """Return a URDF of 3 to 14 links and its bodies. Link k is l<k>, the joint above it j<k>."""
    bodies, lines = [], ['<robot name="random">']
    for k in range(int(rng.integers(3, 15))):
        body = Body(int(rng.integers(max(0, k - 3), k)) if k else -1, str(rng.choice(KINDS)), *random_body(rng))
        bodies.append(body)
        lines += link(f"l{k}", body, rng)
        if k:
            lines += joint(f"j{k}", f"l{body.parent}", f"l{k}", body.kind, rng)
    order = rng.permutation(len(lines) - 1) + 1  # the order of the file must not matter
    return "\n".join([lines[0], *(lines[i] for i in order), "</robot>"]), bodies


def random_body(rng: np.random.Generator) -> tuple[float, np.ndarray, np.ndarray]:
    if rng.random() < 0.2:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    square = rng.standard_normal((3, 3))
    moments = square @ square.T
    return float(rng.uniform(0.1, 5)), rng.standard_normal(3), np.trace(moments) * np.eye(3) - moments


def link(name: str, body: Body, rng: np.random.Generator) -> list[str]:
    if body.mass == 0:
        return [f'<link name="{name}"/>']
    rpy = rng.uniform(-3, 3, 3)
    R = pin.rpy.rpyToMatrix(*rpy)
    xx, xy, xz, _, yy, yz, _, _, zz = np.ravel(R.T @ body.inertia @ R)
    moments = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (xx, xy, xz, yy, yz, zz))
    values = " ".join(f'{key}="{float(value)!r}"' for key, value in moments)
    return [
        f'<link name="{name}"><inertial><origin xyz="{words(body.centre)}" rpy="{words(rpy)}"/>'
        f'<mass value="{body.mass!r}"/><inertia {values}/></inertial></link>'
    ]


def joint(name: str, parent: str, child: str, kind: str, rng: np.random.Generator) -> list[str]:
    axis = rng.standard_normal(3) if rng.random() < 0.5 else np.roll([0, 0, rng.choice([-1, 1])], rng.integers(3))
    origin = f'<origin xyz="{words(rng.standard_normal(3))}" rpy="{words(rng.uniform(-3, 3, 3))}"/>'
    limit = '<limit lower="-3" upper="2" effort="7" velocity="4"/>' if kind in ("revolute", "prismatic") else ""
    axis_line = "" if kind == "fixed" else f'<axis xyz="{words(axis)}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return [
        f'<joint name="{name}" type="{kind}">{ends}{origin if rng.random() < 0.9 else ""}{axis_line}{limit}</joint>'
    ]


class Peer:
    """The same text in Pinocchio: poses, Jacobians, torques by names of joints and links."""

    def __init__(self, text: str) -> None:
        self.model = pin.buildModelFromXML(text)
        self.data = self.model.createData()

    def configuration(self, positions: dict[str, float]) -> np.ndarray:
        q = pin.neutral(self.model)
        for name, value in positions.items():
            joint = self.model.joints[self.model.getJointId(name)]
            turns_without_end = joint.nq == 2
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if turns_without_end else value
        return q

    def columns(self, names: tuple[str, ...]) -> list[int]:
        return [self.model.joints[self.model.getJointId(name)].idx_v for name in names]

    def pose(self, link: str) -> np.ndarray:
        return self.data.oMf[self.model.getFrameId(link)].homogeneous

    def move(self, positions: dict[str, float]) -> None:
        q = self.configuration(positions)
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)

    def jacobian(self, base: str, tip: str, names: tuple[str, ...]) -> np.ndarray:
        """Velocity [v; w] of the tip relative to the base, in base axes: that of the tip less that of the base
        there."""
        at_tip, at_base = (
            pin.getFrameJacobian(self.model, self.data, self.model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED).reshape(
                6, -1
            )
            for name in (tip, base)
        )
        R, arm = self.pose(base)[:3, :3], self.pose(tip)[:3, 3] - self.pose(base)[:3, 3]
        w = at_tip[3:] - at_base[3:]
        v = at_tip[:3] - at_base[:3] - np.cross(at_base[3:].T, arm).T
        return np.vstack([R.T @ v, R.T @ w])[:, self.columns(names)]


def assert_same_kinematics(robot: Robot, base: str, tip: str, peer: Peer, rng: np.random.Generator) -> None:
    q = rng.uniform(-2, 2, robot.n)
    peer.move(dict(zip(robot.joint_names, q)))
    T_base_tip = np.linalg.solve(peer.pose(base), peer.pose(tip))
    size = 1 + np.abs(T_base_tip[:3, 3]).max()
    np.testing.assert_allclose(robot.chain.forward(q), T_base_tip, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(
        kinematics.jacobian(robot, q), peer.jacobian(base, tip, robot.joint_names), rtol=0, atol=1e-12 * size
    )


def rigidly_joined(bodies: list[Body], k: int) -> set[int]:
    """Return the links that fixed joints connect to link k, in any direction."""
    group = {k}
    while True:
        more = {
            i for i, body in enumerate(bodies) if body.kind == "fixed" and i and (i in group) != (body.parent in group)
        }
        if not more:
            return group
        group |= more | {bodies[i].parent for i in more}


def moving_groups(robot: Robot, bodies: list[Body], base: int) -> list[set[int]]:
    """Return the links that move with each link of the arm."""
    groups, before = [], rigidly_joined(bodies, base)
    for name in robot.joint_names:
        child = int(name[1:])
        below, above = rigidly_joined(bodies, child), rigidly_joined(bodies, bodies[child].parent)
        assert before in (below, above)
        before = above if before == below else below
        groups.append(before)
    return groups


@pytest.mark.filterwarnings("ignore:The arm of .* omits")
@pytest.mark.parametrize("seed", range(20))  # about 180 chains
def test_every_chain_of_a_random_tree(seed: int) -> None:
    """From the root to every link, and between some others: up, down and across."""
    rng = np.random.default_rng(seed)
    text, bodies = random_tree(rng)
    tree, peer = urdf.parse(text), Peer(text)
    n = len(bodies)
    assert (tree.root, len(tree.links), len(tree.joints)) == ("l0", n, n - 1)
    pairs = [(0, k) for k in range(1, n)] + [tuple(rng.permutation(n)[:2]) for _ in range(3)]
    for base, tip in pairs:
        if tip in rigidly_joined(bodies, base):
            continue
        robot = tree.chain(f"l{base}", f"l{tip}")
        assert_same_kinematics(robot, f"l{base}", f"l{tip}", peer, rng)
        groups = moving_groups(robot, bodies, base)
        masses = [sum(bodies[k].mass for k in group) for group in groups]
        if robot.inertias is None:
            assert not any(masses)
            continue
        np.testing.assert_allclose(robot.inertias[:, 0], masses)
        # Mass properties of the arm's links, expressed in the base: the poses are Pinocchio's, the masses the
        # generator's.
        q = rng.uniform(-2, 2, robot.n)
        peer.move(dict(zip(robot.joint_names, q)))
        expected = np.zeros((robot.n, 10))
        for pi, group in zip(expected, groups):
            for k in group:
                T_base_body = np.linalg.solve(peer.pose(f"l{base}"), peer.pose(f"l{k}"))
                own = inertia.from_body(bodies[k].mass, bodies[k].centre, bodies[k].inertia)
                pi += inertia.transform(T_base_body, own)
        gathered = inertia.transform(robot.chain.link_transforms(q), robot.inertias)
        np.testing.assert_allclose(gathered, expected, rtol=0, atol=1e-12 * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("seed", range(8))
def test_dropped_branches_are_warned_of_with_their_mass_and_kept_when_locked(seed: int) -> None:
    """All masses that the arm's moving links carry are in the arm or in the warning."""
    rng = np.random.default_rng(seed)
    text, bodies = random_tree(rng)
    tree, q = urdf.parse(text), float(rng.uniform(-1, 1))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        robot = tree.chain(
            tip=next(f"l{k}" for k in reversed(range(len(bodies))) if k not in rigidly_joined(bodies, 0))
        )
    left = [float(x) for x in re.findall(r"([\d.e+-]+) kg behind", " ".join(str(one.message) for one in told))]
    groups = moving_groups(robot, bodies, 0)
    hanging = {k for k in range(len(bodies)) if any(follows(bodies, k, group) for group in groups)}
    expected = sum(bodies[k].mass for k in hanging) - (0.0 if robot.inertias is None else robot.inertias[:, 0].sum())
    assert sum(left) == pytest.approx(expected, rel=0.02, abs=1e-9)
    beside = [f"j{k}" for k in hanging if bodies[k].kind != "fixed" and f"j{k}" not in robot.joint_names]
    tip = re.search(r"to '(\w+)'", robot.source)
    locked = tree.chain(tip=tip and tip[1], lock=dict.fromkeys(beside, q))
    assert locked.joint_names == robot.joint_names
    total = sum(bodies[k].mass for k in hanging)
    assert (0.0 if locked.inertias is None else locked.inertias[:, 0].sum()) == pytest.approx(total, abs=1e-9)


def follows(bodies: list[Body], k: int, group: set[int]) -> bool:
    """Return whether a link is in a group or descends from it."""
    while k >= 0 and k not in group:
        k = bodies[k].parent
    return k in group


def test_a_locked_joint_is_where_it_was_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    text, bodies = random_tree(rng)
    tree, peer = urdf.parse(text), Peer(text)
    tip = next(k for k in reversed(range(len(bodies))) if bodies[k].kind != "fixed" and bodies[k].parent > 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = tree.chain(tip=f"l{tip}").joint_names
        robot = tree.chain(tip=f"l{tip}", lock={names[0]: 0.4})
    q = rng.uniform(-1, 1, robot.n)
    peer.move({names[0]: 0.4, **dict(zip(robot.joint_names, q))})
    np.testing.assert_allclose(kinematics.forward(robot, q), peer.pose(f"l{tip}"), rtol=0, atol=1e-12)
    with pytest.raises(UnknownName, match="joint of"):
        tree.chain(tip=f"l{tip}", lock={"elbow": 0.0})
    fixed = next(joint.name for joint in tree.joints if joint.kind == "fixed")
    with pytest.raises(RobotError, match="moving joint"):
        tree.chain(tip=f"l{tip}", lock={fixed: 0.0})


@pytest.mark.filterwarnings("ignore:The arm of .* omits")
@pytest.mark.parametrize("seed", range(5))
def test_homes_are_inside_their_ranges_and_do_not_depend_on_chance(seed: int) -> None:
    text, bodies = random_tree(np.random.default_rng(seed))
    tip = next(f"l{k}" for k in reversed(range(len(bodies))) if k not in rigidly_joined(bodies, 0))
    robot, again = (urdf.parse(text).chain(tip=tip) for _ in range(2))
    np.testing.assert_array_equal(robot.q_home, again.q_home)
    room = np.minimum(robot.q_home - robot.q_min, robot.q_max - robot.q_home)
    assert np.all(room >= 0.2 * np.minimum(robot.q_max - robot.q_min, 1.0))


def singular_value(robot: Robot) -> float:
    values = np.linalg.svd(robot.chain.jacobian(robot.q_home), compute_uv=False)
    return float(values[-1] / values[0])


def test_a_stretched_middle_is_left_for_a_dexterous_home(tmp_path: Path) -> None:
    """The iiwa and the UR5e are stretched in the middle of their ranges."""
    for name in ("iiwa14", "ur5e", "panda"):
        robots.save(robots.load(name), tmp_path / f"{name}.urdf")
        robot = robots.load(tmp_path / f"{name}.urdf")
        middle = replace(robot, q_home=0.5 * (robot.q_min + robot.q_max))
        assert singular_value(robot) > (0.03 if name != "panda" else 0.9 * singular_value(middle))


@pytest.mark.parametrize(("name", "tip", "n"), [("panda_description", "panda_hand", 7), ("ur5_robot", "tool0", 6)])
@pytest.mark.filterwarnings("ignore:The arm of .* omits")
def test_robots_of_description_packages_have_names(name: str, tip: str, n: int) -> None:
    if not robots.files._example_robot_data():
        pytest.skip("needs example-robot-data")
    robot = robots.load(name, tip=tip)
    assert robot.n == n
    assert robot.inertias is not None
    with pytest.raises(RobotError, match="Select the tip with --tip"):
        robots.load(name)
    with pytest.raises(UnknownName, match="ur5_robot"):
        robots.load("ur_description")


PUBLISHED = Path(__file__).parents[3] / "shared/data/ident/staubli_tx40/tx40_mdh_modified.urdf"


@pytest.mark.skipif(not PUBLISHED.exists(), reason="needs ../shared: a published URDF of the Staubli TX40")
def test_a_published_arm(tmp_path: Path) -> None:
    """Read, and written and read again: kinematics, torques, limits and meshes match those in Pinocchio."""
    robot, rng = robots.load(PUBLISHED), np.random.default_rng(0)
    robots.save(robot, tmp_path / "tx40.urdf")
    assert [mesh.file.rsplit("/", 1)[1] for group in robot.meshes for mesh in group if mesh.kind == "visual"] == [
        "base_link.stl",
        *(f"link_{i + 1}.stl" for i in range(6)),
    ]
    for path, tip in ((PUBLISHED, "tool0"), (tmp_path / "tx40.urdf", "tool")):
        peer = Peer(path.read_text(encoding="utf-8"))
        peer.model.gravity.linear = robot.gravity
        np.testing.assert_array_equal(peer.model.effortLimit, robot.tau_max)
        np.testing.assert_array_equal(peer.model.velocityLimit, robot.qd_max)
        np.testing.assert_array_equal(peer.model.upperPositionLimit, robot.q_max)
        assert_same_kinematics(robot, peer.model.frames[1].name, tip, peer, rng)
        q, qd, qdd = rng.uniform(-2, 2, (3, 6))
        tau = robot.chain.rnea(q, qd, qdd, robot.gravity, robot.inertias)
        np.testing.assert_allclose(tau, pin.rnea(peer.model, peer.data, q, qd, qdd), rtol=0, atol=1e-12)

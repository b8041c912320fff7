"""Laws of kinematics: every robot of the library and random ones, every batch shape, every region of joint space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.lie import se3
from armlab.robots import Robot

BATCHES = [(), (3,), (2, 3), (0,), (2, 0, 3)]
Sampler = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def uniform(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.uniform(-np.pi, np.pi, shape)


def near_zero(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """The zero posture of most robots is singular."""
    return 10.0 ** rng.uniform(-16, -1, shape) * rng.choice([-1, 1], shape)


def right_angles(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.integers(-4, 5, shape) * np.pi / 2


def random_robot(rng: np.random.Generator, n: int, **details: np.ndarray) -> Robot:
    """Random DH table with revolute and prismatic joints, mount and tool."""
    table = rng.uniform(-np.pi, np.pi, (4, n)) * [[1], [0.3], [0.3], [1]]
    mount, tool = se3.exp(rng.standard_normal((2, 6)))
    return robots.from_dh("random", *table, prismatic=rng.random(n) < 0.3, T_base_mount=mount, T_flange_tool=tool)


@pytest.fixture(params=[*robots.names(), *range(1, 10)])
def robot(request: pytest.FixtureRequest) -> Robot:
    if isinstance(request.param, str):
        tool = se3.exp(np.random.default_rng(0).uniform(-0.5, 0.5, 6))
        return robots.load(request.param).with_tool(tool)
    return random_robot(np.random.default_rng(request.param), request.param)


STRANGE = [near_zero, right_angles]
CASES = [(uniform, batch) for batch in BATCHES] + [(sampler, batch) for sampler in STRANGE for batch in [(), (2, 3)]]


def everywhere(law: Callable[[Robot, tuple[int, ...], Sampler], None]) -> Callable[[Robot], None]:
    """Make one test of a law for every batch shape, and every region of joint space."""

    def test(robot: Robot) -> None:
        for sampler, batch in CASES:
            try:
                law(robot, batch, sampler)
            except AssertionError as error:
                error.add_note(f"{sampler.__name__}, batch {batch}")
                raise

    return test


def distance(a: np.ndarray, b: np.ndarray) -> float:
    assert a.shape == b.shape
    return float(np.abs(a - b).max(initial=0.0))


def apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]


def test_dh_poe_and_local_poe_are_one() -> None:
    """80 random robots of 2 to 9 joints, revolute and prismatic, with mount and tool."""
    rng = np.random.default_rng(1)
    for _ in range(80):
        robot = random_robot(rng, int(rng.integers(2, 10)))
        q = rng.uniform(-3, 3, robot.n)
        T = kinematics.forward(robot, q)
        J = kinematics.jacobian(robot, q)
        for other in (
            robots.from_poe("poe", robot.screws, robot.T_home),
            robots.from_local_poe("local", *robots.to_local_poe(robot)),
        ):
            assert distance(kinematics.forward(other, q), T) <= 1e-12
            assert distance(kinematics.jacobian(other, q), J) <= 1e-12


@everywhere
def test_jacobian_derivative(robot: Robot, batch: tuple[int, ...], sampler: Sampler) -> None:
    """It is linear in qd, and the acceleration of a motion is J qdd + Jd qd."""
    rng, h = np.random.default_rng(4), 2e-4
    q = sampler(rng, (*batch, robot.n))
    a, b = rng.standard_normal((2, *batch, robot.n))
    for frame in ("base", "tool"):
        Jd = kinematics.jacobian_derivative(robot, q, a, frame)
        sum_of_both = Jd + kinematics.jacobian_derivative(robot, q, b, frame)
        assert distance(kinematics.jacobian_derivative(robot, q, a + b, frame), sum_of_both) <= 1e-12

        def twist(t: float, frame: str = frame) -> np.ndarray:  # along q(t) = q + a t + b t^2/2
            return apply(kinematics.jacobian(robot, q + t * a + t**2 / 2 * b, frame), a + t * b)

        change = 8 * (twist(h) - twist(-h)) - (twist(2 * h) - twist(-2 * h))  # error of fourth order
        acceleration = apply(kinematics.jacobian(robot, q, frame), b) + apply(Jd, a)
        assert distance(acceleration, change / (12 * h)) <= 1e-8


@everywhere
def test_a_batch_is_a_loop(robot: Robot, batch: tuple[int, ...], sampler: Sampler) -> None:
    rng = np.random.default_rng(6)
    q, qd = sampler(rng, (*batch, robot.n)), rng.standard_normal((*batch, robot.n))
    q.flags.writeable = qd.flags.writeable = False
    T, J = kinematics.forward(robot, q), kinematics.jacobian(robot, q)
    Jd, w = kinematics.jacobian_derivative(robot, q, qd), kinematics.manipulability(robot, q)
    assert (T.shape, J.shape) == ((*batch, 4, 4), (*batch, 6, robot.n))
    assert (Jd.shape, np.shape(w)) == (J.shape, batch)
    for i in np.ndindex(batch):
        assert distance(kinematics.forward(robot, q[i]), T[i]) <= 1e-14
        assert distance(kinematics.jacobian(robot, q[i]), J[i]) <= 1e-14
        assert distance(kinematics.jacobian_derivative(robot, q[i], qd[i]), Jd[i]) <= 1e-14
        assert kinematics.manipulability(robot, q[i]) == w[i]

"""Fixtures that several packages share."""

from __future__ import annotations

import gc
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from armlab import identify, robots
from armlab.estimation import Fit
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import Friction, TorqueModel
from armlab.robots import Robot

# The same examples each time, so that a change fails only for what it did; `--hypothesis-profile=default` looks for
# new ones, and twice as many. No deadline: the machines are shared.
settings.register_profile("armlab", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("armlab")

PERIOD = 0.004
SUBSTEPS = 4  # friction runs finer than the log, as in nature

HERE = Path(__file__).parent
LOOPS = {"bridge", "cli", "examples", "sim"}  # loops collect garbage before they begin


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Let a loop search what its test made, and not the half million objects that pytest holds for all other tests."""
    loops = item.path.relative_to(HERE).parts[0] in LOOPS
    if loops:
        gc.freeze()
    try:
        return (yield)
    finally:
        if loops:
            gc.unfreeze()


@dataclass(frozen=True)
class Truth:
    """A made-up arm with known parameters: what identification must find."""

    robot: Robot
    links: np.ndarray
    rotor: np.ndarray
    friction: Friction
    noise: np.ndarray

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, z: np.ndarray) -> np.ndarray:
        rigid = self.robot.chain.rnea(q, qd, qdd, self.robot.gravity, self.links)
        return rigid + self.rotor * qdd + self.friction.torque(qd, z)

    def log(
        self,
        trajectory: identify.Trajectory,
        seed: int = 0,
        noise: float = 1.0,
        wrench: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Table:
        """Log of the motion; `noise` scales torque noise, velocity noise and encoder steps together."""
        fine = np.arange(0, trajectory.seconds, PERIOD / SUBSTEPS)
        q, qd, qdd = trajectory.sample(fine)
        z = presliding(q, self.friction.delta, np.zeros(self.robot.n))
        t, q, qd, qdd, z = (x[::SUBSTEPS] for x in (fine, q, qd, qdd, z))
        tau = self.torque(q, qd, qdd, z)
        if wrench is not None:
            tau = tau - np.einsum("kij,ki->kj", self.robot.chain.jacobian(q), wrench(t))
        rng = np.random.default_rng(seed)
        tau = tau + noise * self.noise * rng.standard_normal(tau.shape)
        qd = qd + noise * 1e-3 * rng.standard_normal(qd.shape)
        if noise:
            q = np.round(q / (noise * 1e-5)) * noise * 1e-5
        return Table(t, {"q": q, "qd": qd, "tau": tau})


@pytest.fixture(scope="session", autouse=True)
def signals() -> Iterator[None]:
    """Heed what the shell had us ignore, SIGHUP after nohup, SIGINT after &: programs that tests start inherit it."""
    handlers = {signal.SIGHUP: lambda *_: None, signal.SIGINT: signal.default_int_handler}
    before = {number: signal.getsignal(number) for number in handlers}
    for number, handler in handlers.items():
        if before[number] is signal.SIG_IGN:
            signal.signal(number, handler)
    yield
    for number, previous in before.items():
        signal.signal(number, previous)


@pytest.fixture(scope="session")
def truth() -> Truth:
    """The left arm of a YuMi with random, physically possible links."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(7)
    links = np.zeros((robot.n, 10))
    for i, mass in enumerate([1.7, 1.6, 1.4, 1.1, 0.9, 0.5, 0.3]):
        c = rng.uniform(-0.06, 0.06, 3)
        A = rng.standard_normal((3, 3)) * 0.03
        inertia = mass * (A @ A.T + (c @ c) * np.eye(3) - np.outer(c, c))
        links[i] = [mass, *(mass * c), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]
    tau_max = np.array([40.0, 40, 25, 25, 10, 10, 5])
    coulomb = 0.05 * tau_max
    friction = Friction(
        viscous=coulomb / robot.qd_max,
        coulomb_pos=1.05 * coulomb,
        coulomb_neg=0.95 * coulomb,
        offset=0.01 * tau_max * (-1.0) ** np.arange(robot.n),
        stribeck=0.3 * coulomb,
        stribeck_speed=np.full(robot.n, 0.05),
        delta=np.full(robot.n, 10**-3.5),
        resolution=np.zeros(robot.n),
    )
    return Truth(robot, links, np.full(robot.n, 0.1), friction, 0.005 * tau_max)


@pytest.fixture(scope="session")
def excited(truth: Truth) -> Table:
    """A noisy 30 s excitation log of the made-up arm."""
    return truth.log(identify.excitation(truth.robot, seconds=30, seed=1), seed=1)


@pytest.fixture(scope="session")
def fitted(truth: Truth, excited: Table) -> Fit[TorqueModel]:
    """The torque model identified from that log, with its covariance."""
    return identify.fit_dynamics(excited, truth.robot)


@pytest.fixture(scope="session")
def model(fitted: Fit[TorqueModel]) -> TorqueModel:
    """The value of that fit."""
    return fitted.value


@pytest.fixture(scope="session")
def slow(truth: Truth) -> Table:
    """A minute at a tenth of the speed limits."""
    return truth.log(identify.excitation(truth.robot, seconds=60, f0=1 / 60, harmonics=3, speed=0.1, seed=3), seed=3)


@pytest.fixture(scope="session")
def gravity(truth: Truth, slow: Table) -> Fit[TorqueModel]:
    """The model of slow motion identified from it: gravity, friction and offsets."""
    return identify.fit_gravity(slow, truth.robot)


@contextmanager
def _full_disk() -> Iterator[None]:
    """Let no file grow beyond 100 bytes; also not the one that pytest may write to, so only around what is tried."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.fixture
def full_disk() -> Callable[[], AbstractContextManager[None]]:
    """Return a context in which the disk is full."""
    return _full_disk


@pytest.fixture
def ur5e_bag(tmp_path: Path) -> Path:
    """A bag of another program: a UR5e with joint i at i + k rad in row k, told in reverse order, and numbers."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, number, header, time = (store.types[kind] for kind in kinds)
    names = list(robots.load("ur5e").joint_names[::-1])
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        joints, clock = (bag.add_connection("/" + kind.rpartition("/")[2], kind, typestore=store) for kind in kinds[:2])
        for i in range(5):
            x, stamp = np.arange(6.0)[::-1] + i, header(stamp=time(sec=1 + i, nanosec=0), frame_id="")
            message = state(header=stamp, name=names, position=x, velocity=x[:0], effort=x)
            bag.write(joints, i * 10**9, store.serialize_cdr(message, kinds[0]))
            bag.write(clock, i * 10**8, store.serialize_cdr(number(data=1.0), kinds[1]))
    return tmp_path / "bag"

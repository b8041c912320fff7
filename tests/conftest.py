"""Fixtures that several packages share."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from _pytest.pathlib import import_path
from hypothesis import settings

from armlab import identify, robots
from armlab.dynamics import base_parameters
from armlab.estimation import Experiment, Fit
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import Friction
from armlab.robots import Robot

from .processes import processes  # noqa: F401  a fixture

# The same examples in every run, so that only a code change can cause a failure; `--hypothesis-profile=default` tries
# new ones, twice as many. No deadline: the machines are shared.
settings.register_profile("armlab", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("armlab")

PERIOD = 0.004
SUBSTEPS = 4  # friction is simulated in finer steps than the log

HERE = Path(__file__).parent
SLOW_FILES = pytest.StashKey[set[Path]]()
LOOPS = {"bridge", "cli", "examples", "faults", "sim"}  # their loops collect garbage before they start


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[object]:
    """Collect tests with the garbage collector off, and exclude their objects from later garbage collections.

    In a new clone, where tests are compiled on import, each of several processes starts with its own share.
    """
    gc.disable()
    if worker := os.environ.get("PYTEST_XDIST_WORKER"):
        given = [Path(one.partition("::")[0]).resolve() for one in session.config.args]
        files = sorted({path for one in given for path in (one.rglob("test_*.py") if one.is_dir() else [one])})
        for path in files[int(worker[2:]) :: int(os.environ["PYTEST_XDIST_WORKER_COUNT"])]:
            with suppress(Exception, pytest.skip.Exception):  # errors are reported when it is collected
                import_path(path, mode="importlib", root=session.config.rootpath, consider_namespace_packages=False)
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Record which files have slow tests, before those tests are deselected."""
    config.stash[SLOW_FILES] = {item.path for item in items if item.get_closest_marker("slow")}


@pytest.fixture(scope="session")
def slow_files(pytestconfig: pytest.Config) -> set[Path]:
    """The collected files that contain slow tests."""
    return pytestconfig.stash[SLOW_FILES]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Limit garbage collection by loops to the test's own objects, without the half million that pytest holds."""
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
    """A synthetic arm with known parameters, which identification must find."""

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


RATE = 100.0
NOISE = np.array([0.3, 0.2])
DELTA = np.full(2, 1e-3)
LINKS = np.array(
    [[3, 0.1, 0.02, 0.3, 0.5, 0.01, 0.4, 0.02, 0.01, 0.3], [1.5, 0.25, 0.05, 0.02, 0.05, 0.01, 0.2, 0, 0.01, 0.22]]
)
ROTOR = np.array([0.2, 0.1])


class ShortArm:
    """A vertical axis, then a horizontal one."""

    def __init__(self) -> None:
        turned, beside = np.eye(4), np.eye(4)
        turned[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        beside[0, 3] = 0.3
        self.robot = robots.from_links("short", [np.eye(4), turned, beside])

    def log(
        self,
        seed: int,
        n: int,
        *,
        rho: float = 0.0,
        slow: bool = False,
        bad: float = 0.0,
        stretch: int = 1,
        still: dict[int, float] | None = None,
    ) -> Table:
        """A log of n samples with AR(1) torque noise; a share of the segments is off by ten standard deviations.

        Joints in `still` rest at the given position.
        """
        t, draw = np.arange(n) / RATE, np.random.default_rng(99)
        f = np.array([0.11, 0.23, 0.37, 0.61, 0.83]) * (0.3 if slow else 1.0)
        a, phase = draw.uniform(0.015, 0.05, (2, 5, 1)) / f[:, None], draw.uniform(0, 6, (2, 5, 1))
        wave = 2 * np.pi * f[:, None] * t + phase
        w = 2 * np.pi * f[:, None]
        parts = a * np.sin(wave), a * w * np.cos(wave), -a * w**2 * np.sin(wave)
        q, qd, qdd = (part.sum(axis=1).T for part in parts)
        for joint, position in (still or {}).items():
            q[:, joint], qd[:, joint], qdd[:, joint] = position, 0.0, 0.0
        moves = 0.0 if slow else 1.0
        tau = self.robot.chain.rnea(q, moves * qd, moves * qdd, self.robot.gravity, LINKS) + moves * ROTOR * qdd
        tau = tau + np.array([1.0, 0.5]) * qd + np.array([2.0, 1.0]) * presliding(q, DELTA, np.zeros(2)) + [0.3, -0.2]
        rng = np.random.default_rng(seed)
        tau = tau + NOISE * _noise(rng, n, rho)
        count = -(-n // stretch), 2
        spoilt = np.where(rng.random(count) < bad, 10 * NOISE * rng.choice([-1, 1], count), 0.0)
        return Table(t, {"q": q, "qd": qd, "tau": tau + np.repeat(spoilt, stretch, axis=0)[:n]})

    def experiment(
        self, rho: float = 0.0, slow: bool = False, gain_sd: float = 0.0
    ) -> Callable[[int, int], Experiment]:
        """Return an experiment factory for `check_estimator`: logs with torque gains, and the true base parameters."""
        truth = base_parameters(self.robot, quasi_static=slow).B @ np.concatenate([LINKS.ravel(), ROTOR])

        def draw(seed: int, n: int) -> Experiment:
            table = self.log(seed, n, rho=rho, slow=slow)
            gains = 1.0 + gain_sd * np.random.default_rng([seed, 5]).standard_normal(2)
            table = table.with_column("tau", gains * table["tau"])
            return Experiment({"table": table, "robot": self.robot}, truth)

        return draw

    def of_base(self, fit: Fit) -> Fit:
        """Return the fit of the base parameters alone: friction terms may differ between logs."""
        p = len(fit.value.base_names)
        cov = fit.cov[:p, :p]
        return replace(fit, names=fit.names[:p], units=fit.units[:p], parameters=fit.parameters[:p], cov=cov)


def _noise(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    from scipy.signal import lfilter

    white = rng.standard_normal((n + 200, 2)) * np.sqrt(1 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))[200:]


@pytest.fixture(scope="session")
def short_arm() -> ShortArm:
    return ShortArm()


@pytest.fixture(scope="session", autouse=True)
def signals() -> Iterator[None]:
    """Handle SIGHUP (ignored under nohup) and SIGINT (ignored after &), as child programs inherit the setting."""
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
    """The left arm of a YuMi with random, physically consistent links."""
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
    """A noisy 30 s excitation log of the synthetic arm."""
    return truth.log(identify.design_excitation(truth.robot, seconds=30, seed=1), seed=1)


def _once(run: Path, name: str, fit: Callable[[], Fit[TorqueModel]]) -> Fit[TorqueModel]:
    """Return the fit made by the first process of a test run; the others wait for it and read it."""
    with (run / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        kept = run / f"{name}.pickle"
        if not kept.exists():
            kept.write_bytes(pickle.dumps(fit()))
        return pickle.loads(kept.read_bytes())


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of this test run, shared by all its processes."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def fitted(truth: Truth, excited: Table, run_folder: Path) -> Fit[TorqueModel]:
    """The torque model identified from the excitation log, with its covariance."""
    return _once(run_folder, "fitted", lambda: identify.fit_dynamics(excited, truth.robot))


@pytest.fixture(scope="session")
def model(fitted: Fit[TorqueModel]) -> TorqueModel:
    """The torque model of `fitted`."""
    return fitted.value


@pytest.fixture(scope="session")
def slow(truth: Truth) -> Table:
    """A one-minute log at a tenth of the speed limits."""
    return truth.log(
        identify.design_excitation(truth.robot, seconds=60, f0=1 / 60, harmonics=3, speed=0.1, seed=3), seed=3
    )


@pytest.fixture(scope="session")
def gravity(truth: Truth, slow: Table, run_folder: Path) -> Fit[TorqueModel]:
    """The slow-motion model identified from `slow`: gravity, friction and offsets."""
    return _once(run_folder, "gravity", lambda: identify.fit_gravity(slow, truth.robot))


@contextmanager
def _full_disk() -> Iterator[None]:
    """Limit files to 100 bytes. This includes the file pytest may write to, so use it only around the tested call."""
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
    """A bag from another program: a UR5e with joint i at i + k rad in row k, in reverse order, and a number topic."""
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

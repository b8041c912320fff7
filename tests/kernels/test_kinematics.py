"""Laws of the kinematic kernels, of whichever backend is in use."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterator
from threading import Thread

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlab.kernels import Chain, backend


def product_of_exponentials(chain: Chain, q: np.ndarray) -> np.ndarray:
    """T_base_tool by matrix products, independent of both backends."""
    T = chain.frames[0]
    for value, slides, frame in zip(q, chain.prismatic, chain.frames[1:]):
        Z = np.eye(4)
        if slides:
            Z[2, 3] = value
        else:
            Z[:3, :3] = Rotation.from_rotvec([0, 0, value]).as_matrix()
        T = T @ Z @ frame
    return T


def test_forward_is_the_product_of_exponentials(chain: Chain) -> None:
    q = np.random.default_rng(0).uniform(-6, 6, (20, chain.n))
    wanted = np.stack([product_of_exponentials(chain, row) for row in q])
    np.testing.assert_allclose(chain.forward(q), wanted, rtol=0, atol=2e-14)


def test_link_transforms_end_in_forward(chain: Chain) -> None:
    q = np.random.default_rng(1).uniform(-3, 3, (5, chain.n))
    links = chain.link_transforms(q)
    assert links.shape == (5, chain.n, 4, 4)
    np.testing.assert_allclose(links[:, -1] @ chain.frames[-1], chain.forward(q), rtol=0, atol=1e-13)
    for i in range(chain.n):  # link i does not feel the joints after it
        cut = Chain(chain.frames[: i + 2], chain.prismatic[: i + 1])
        np.testing.assert_allclose(links[:, i] @ chain.frames[i + 1], cut.forward(q[:, : i + 1]), rtol=0, atol=1e-13)


def test_jacobian_is_the_derivative_of_forward(chain: Chain) -> None:
    """Central differences: position, and the logarithm of the turn between both sides."""
    h, q = 2e-5, np.random.default_rng(2).uniform(-3, 3, chain.n)
    steps = h * np.eye(chain.n)
    plus, minus = chain.forward(q + steps), chain.forward(q - steps)
    v = (plus[:, :3, 3] - minus[:, :3, 3]) / (2 * h)
    turn = Rotation.from_matrix(plus[:, :3, :3]) * Rotation.from_matrix(minus[:, :3, :3]).inv()
    numerical = np.concatenate([v, turn.as_rotvec() / (2 * h)], axis=1).T
    np.testing.assert_allclose(chain.jacobian(q), numerical, rtol=0, atol=1e-8)


def test_tool_jacobian_is_the_base_jacobian_turned(chain: Chain) -> None:
    q = np.random.default_rng(3).uniform(-3, 3, (8, chain.n))
    T, J = chain.forward_jacobian(q)
    R = T[:, :3, :3]
    turned = np.concatenate([R @ half for half in np.split(chain.jacobian(q, tool=True), 2, axis=1)], axis=1)
    np.testing.assert_allclose(turned, J, rtol=0, atol=1e-14 * max(1.0, np.abs(J).max()))
    np.testing.assert_array_equal(J, chain.jacobian(q))
    np.testing.assert_array_equal(T, chain.forward(q))


def test_power(chain: Chain) -> None:
    """Twist . wrench = qd . tau with tau = J^T wrench, in base axes and in tool axes."""
    rng = np.random.default_rng(4)
    q, qd, wrench = rng.normal(size=chain.n), rng.normal(size=chain.n), rng.normal(size=6)
    R = chain.forward(q)[:3, :3]
    wrench_tool = np.concatenate([R.T @ wrench[:3], R.T @ wrench[3:]])
    J, J_tool = chain.jacobian(q), chain.jacobian(q, tool=True)
    power = (J @ qd) @ wrench
    assert qd @ (J.T @ wrench) == pytest.approx(power, abs=1e-12)
    assert qd @ (J_tool.T @ wrench_tool) == pytest.approx(power, abs=1e-12)


def test_nearly_parallel_axes(from_dh: Callable[..., Chain]) -> None:
    """Common normals far away or undefined do no harm."""
    for alpha in (0.0, 1e-15, 1e-9, 1e-5, np.pi - 1e-9, np.pi):
        frames = from_dh([alpha] * 4, [0.3] * 4, [0.1] * 4, [0.2, -2.0, 3.0, 1.0], np.eye(4)).frames
        frames[:, 1, 3] += 0.05  # not a DH frame any more
        chain = Chain(frames, [False] * 4)
        q = np.array([0.4, -1.0, 2.0, 3.0])
        np.testing.assert_allclose(chain.forward(q), product_of_exponentials(chain, q), rtol=0, atol=1e-14)


def test_chain_is_immutable_and_pickles(chain: Chain) -> None:
    frames = chain.frames
    frames[:] = 0.0
    assert chain.frames[0, 3, 3] == 1.0
    with pytest.raises(AttributeError):
        chain.n = 3  # type: ignore[misc]
    copy = pickle.loads(pickle.dumps(chain))
    q = np.ones(chain.n)
    np.testing.assert_array_equal(copy.forward(q), chain.forward(q))


@pytest.fixture
def patient_threads() -> Iterator[None]:
    """No thread asks another for the interpreter: it runs on until it lets go by itself."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100.0)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.skipif(backend == "reference", reason="NumPy decides for itself when it lets go")
@pytest.mark.usefixtures("patient_threads")
def test_batches_let_other_threads_run() -> None:
    chain = Chain(np.tile(np.eye(4), (8, 1, 1)), np.zeros(7))
    q, done = np.zeros((50_000, 7)), []

    def work() -> None:
        for _ in range(40):
            chain.jacobian(q)
        done.append(True)

    thread = Thread(target=work)
    thread.start()  # returns when the worker lets go of the interpreter
    assert not done
    thread.join()
    assert done

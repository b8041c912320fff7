"""`Chain`: against its oracle and the textbook; batches and arguments."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from threading import Thread
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import kernels
from armlab.errors import ShapeError
from armlab.kernels import Chain

from .. import oracles

METHODS = {  # name: arguments from the inputs below
    "forward": ("q",),
    "jacobian": ("q",),
    "forward_jacobian": ("q",),
    "link_transforms": ("q",),
    "jacobian_derivative": ("q", "qd"),
    "rnea": ("q", "qd", "qdd", "gravity", "pi"),
    "rigid_regressor": ("q", "qd", "qdd", "gravity"),
}
BATCHES = [(), (1,), (3,), (4,), (9,), (2, 3), (0,), (5, 0), (1, 2, 1)]

# Right angles, parallel axes and nearly parallel axes are where factorisations of rotations break.
angle = st.one_of(
    st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, -np.pi]),
    st.sampled_from([1e-3, 1e-9, 1e-12, 1e-16, -1e-9]),
    st.floats(-np.pi, np.pi),
)
length = st.one_of(st.just(0.0), st.floats(-2.0, 2.0))
frame = st.tuples(angle, angle, angle, length, length, length)


def pose(values: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    for axis, turn in enumerate(values[:3]):
        R, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
        R[i, i] = R[j, j] = np.cos(turn)
        R[i, j], R[j, i] = -np.sin(turn), np.sin(turn)
        T[:3, :3] = T[:3, :3] @ R
    T[:3, 3] = values[3:]
    return T


@st.composite
def cases(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    n = draw(st.integers(1, 9))
    frames = np.stack([pose(draw(frame)) for _ in range(n + 1)])
    prismatic = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    batch = draw(st.sampled_from(BATCHES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    inputs = {name: rng.normal(scale=3.0, size=(*batch, n)) for name in ("q", "qd", "qdd")}
    return frames, prismatic, inputs | {"gravity": rng.normal(scale=10.0, size=3), "pi": rng.normal(size=(n, 10))}


def flat(result: Any) -> list[np.ndarray]:
    return list(result) if isinstance(result, tuple) else [result]


def assert_same(native: Any, reference: Any) -> None:
    for ours, wanted in zip(flat(native), flat(reference), strict=True):
        assert ours.shape == wanted.shape
        assert ours.dtype == wanted.dtype == np.float64
        np.testing.assert_allclose(ours, wanted, rtol=0.0, atol=1e-12 * max(1.0, np.abs(wanted).max(initial=0.0)))


@given(cases())
@settings(max_examples=40)
def test_native_is_the_reference(case: tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]) -> None:
    frames, prismatic, inputs = case
    native, reference = (module.Chain(frames, prismatic) for module in (kernels, oracles))
    for name, arguments in METHODS.items():
        values = [inputs[a] for a in arguments]
        assert_same(getattr(native, name)(*values), getattr(reference, name)(*values))
    assert_same(native.jacobian(inputs["q"], tool=True), reference.jacobian(inputs["q"], tool=True))
    motion = inputs["q"], inputs["qd"]
    assert_same(native.jacobian_derivative(*motion, tool=True), reference.jacobian_derivative(*motion, tool=True))
    body = kernels.RigidBody(native, inputs["gravity"], inputs["pi"])
    assert_same(
        body.rnea(*motion, inputs["qdd"]), reference.rnea(*motion, inputs["qdd"], inputs["gravity"], inputs["pi"])
    )
    assert_same(body.mass_matrix(inputs["q"]), reference.mass_matrix(inputs["q"], inputs["pi"]))
    assert_same(body.momentum(*motion), reference.momentum(*motion, inputs["pi"]))
    assert_same(native.frames, reference.frames)
    assert native.n == reference.n == len(prismatic)
    assert (native.prismatic == reference.prismatic).all()


@pytest.fixture
def arm() -> Any:
    frames = np.stack([pose((0.3 * k, -0.2 * k, 0.1, 0.1, 0.2, 0.3)) for k in range(5)])
    return kernels.Chain(frames, np.array([False, True, False, False]))


@pytest.fixture
def inputs() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    batch = {name: rng.normal(size=(2, 35, 4)) for name in ("q", "qd", "qdd")}
    return batch | {"gravity": rng.normal(size=3), "pi": rng.normal(size=(4, 10))}


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("forward", {"q": np.zeros((2, 3))}, r"q of shape \(\.\.\., 4\), got \(2, 3\)"),
        ("forward", {"q": np.float64(1.0)}, r"q of shape \(\.\.\., 4\), got \(\)"),
        ("forward", {"q": "north"}, "array of real numbers, got str"),
        ("forward", {"q": [[1.0], [2.0, 3.0]]}, "array of real numbers, got list"),
        ("jacobian", {"q": np.zeros(4, dtype=complex)}, "array of real numbers"),
        ("rnea", {"qd": np.zeros((3, 4))}, r"broadcast, got q of shape \(2, 35, 4\), qd of shape \(3, 4\)"),
        ("rnea", {"gravity": np.zeros(4)}, r"gravity of shape \(3,\), got \(4,\)"),
        ("rnea", {"pi": np.zeros((4, 9))}, r"pi of shape \(4, 10\), got \(4, 9\)"),
        ("rigid_regressor", {"qdd": np.zeros((2, 3))}, r"qdd of shape \(\.\.\., 4\), got \(2, 3\)"),
        ("forward", {"out": np.zeros((2, 35, 4, 3))}, r"shape \(2, 35, 4, 4\), got shape \(2, 35, 4, 3\)"),
        ("forward", {"out": np.zeros((2, 35, 4, 4), dtype=np.float32)}, "writable C-contiguous float64"),
        ("forward", {"out": [1.0]}, "writable C-contiguous float64"),
        ("forward_jacobian", {"out": np.zeros(2)}, "tuple of 2 arrays"),
    ],
)
def test_wrong_arguments(
    arm: Any, inputs: dict[str, np.ndarray], name: str, change: dict[str, Any], sentence: str
) -> None:
    arguments = {a: inputs[a] for a in METHODS[name]} | change
    with pytest.raises(ShapeError, match=sentence):
        getattr(arm, name)(**arguments)


@pytest.mark.parametrize(
    ("name", "size"),
    [("rnea", (4,)), ("rigid_regressor", (4, 40))],
)
def test_out_apart_from_the_parameters(name: str, size: tuple[int, ...]) -> None:
    """Otherwise the next sample would use overwritten parameters."""
    chain, memory = kernels.Chain(np.tile(np.eye(4), (5, 1, 1)), np.zeros(4)), np.zeros(200)
    parameters = {"gravity": memory[:3], "pi": memory[:40].reshape(4, 10)}
    arguments = [parameters.get(argument, np.zeros(4)) for argument in METHODS[name]]
    with pytest.raises(ShapeError, match=r"Expected out not to share memory with (gravity|pi), got overlapping arrays"):
        getattr(chain, name)(*arguments, out=memory[2 : 2 + np.prod(size)].reshape(size))


def test_momentum_into_arrays_apart(arm: Any, inputs: dict[str, np.ndarray]) -> None:
    both = np.zeros((2, 35, 4))
    with pytest.raises(ShapeError, match=r"out\[1\] and out\[0\] not to share memory, got overlapping arrays"):
        kernels.RigidBody(arm, inputs["gravity"], inputs["pi"]).momentum(inputs["q"], inputs["qd"], out=(both, both))


@pytest.mark.parametrize("prismatic", [False, True])
@pytest.mark.parametrize("joint", [0, 1, 2])
@pytest.mark.parametrize("name", ["forward", "jacobian", "jacobian_derivative"])
def test_a_joint_that_is_missing_shows(name: str, joint: int, prismatic: bool) -> None:
    """Also where the result depends on no joint: all axes coincide, with the tool on them."""
    q = np.where(np.arange(3) == joint, np.nan, 0.5)
    chain = kernels.Chain(np.tile(np.eye(4), (4, 1, 1)), [prismatic] * 3)
    arguments = (q, np.ones(3)) if name == "jacobian_derivative" else (q,)
    assert np.isnan(getattr(chain, name)(*arguments)).any()
    batch = getattr(chain, name)(*(np.tile(argument, (9, 1)) for argument in arguments))
    assert np.isnan(batch).any(axis=(1, 2)).all()


@pytest.mark.parametrize("prismatic", [None, ["a", "b"], [[True], [False, True]]])
def test_kinds_of_joints_that_are_none(prismatic: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected prismatic to be an array of real numbers, got .*\.$"):
        kernels.Chain(np.tile(np.eye(4), (3, 1, 1)), prismatic)


@pytest.mark.parametrize(
    ("frames", "prismatic", "sentence"),
    [
        (np.zeros((3, 4, 4)), [False], r"frames of shape \(2, 4, 4\)"),
        (np.tile(np.eye(4), (34, 1, 1)), [False] * 33, "from 1 to 32 joints"),
        (np.eye(4)[None], [], "from 1 to 32 joints"),
        (np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (2, 1, 1)), [False], "rigid transformation"),
        (np.tile(np.diag([1.0, 1.0, 1.01, 1.0]), (2, 1, 1)), [True], "rigid transformation"),
        (np.full((2, 4, 4), np.nan), [False], "rigid transformation"),
        (np.tile(2.0 * np.eye(4), (2, 1, 1)), [False], "rigid transformation"),
    ],
)
def test_wrong_chains(frames: np.ndarray, prismatic: list[bool], sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        kernels.Chain(frames, prismatic)


def test_slightly_rough_rotations_are_projected() -> None:
    frames = np.tile(np.eye(4), (3, 1, 1))
    frames[:, :3, :3] += 3e-8 * np.random.default_rng(3).normal(size=(3, 3, 3))
    R = kernels.Chain(frames, [False, False]).frames[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (3, 1, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(R, frames[:, :3, :3], rtol=0, atol=3e-7)


def test_double_pendulum_of_the_textbook() -> None:
    """Planar two-link arm, point masses at the ends of the links (Craig, Introduction to Robotics, section 6.7)."""
    l1, l2, m1, m2, g = 0.5, 0.4, 1.5, 0.8, 9.81
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # plane x-z, angle from x
    shift = [np.eye(4), np.eye(4)]
    shift[0][0, 3], shift[1][0, 3] = l1, l2
    chain = Chain(np.stack([upright, *shift]), [False, False])
    pi = np.zeros((2, 10))
    for row, mass, length in zip(pi, (m1, m2), (l1, l2)):
        row[0], row[1], row[[6, 9]] = mass, mass * length, mass * length**2
    (q1, q2), (w1, w2), (a1, a2) = (0.3, -1.1), (0.9, 1.7), (-0.6, 2.0)
    c2, s2 = np.cos(q2), np.sin(q2)
    common = m2 * l2**2 * (a1 + a2) + m2 * l2 * g * np.cos(q1 + q2)
    tau1 = common + m2 * l1 * l2 * c2 * (2 * a1 + a2) + (m1 + m2) * l1**2 * a1
    tau1 += -m2 * l1 * l2 * s2 * (w2**2 + 2 * w1 * w2) + (m1 + m2) * l1 * g * np.cos(q1)
    tau2 = common + m2 * l1 * l2 * (c2 * a1 + s2 * w1**2)
    tau = chain.rnea([q1, q2], [w1, w2], [a1, a2], [0.0, 0.0, -g], pi)
    np.testing.assert_allclose(tau, [tau1, tau2], rtol=0, atol=1e-13)


def test_chain_is_immutable_and_pickles() -> None:
    chain = Chain(np.tile(np.eye(4), (4, 1, 1)), [False, True, False])
    frames = chain.frames
    frames[:] = 0.0
    assert chain.frames[0, 3, 3] == 1.0
    with pytest.raises(AttributeError):
        chain.n = 3  # type: ignore[misc]
    body = kernels.RigidBody(chain, [0, 0, -9.8], np.ones((3, 10)), np.eye(3))
    motion = np.ones((3, 3))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(body)).rnea(*motion), body.rnea(*motion))
    copy = pickle.loads(pickle.dumps(chain))
    q = np.ones(chain.n)
    np.testing.assert_array_equal(copy.forward(q), chain.forward(q))


@pytest.fixture
def patient_threads() -> Iterator[None]:
    """No thread asks for the interpreter: the thread that holds it runs until it releases it."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100.0)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("patient_threads")
def test_batches_let_other_threads_run() -> None:
    chain = Chain(np.tile(np.eye(4), (8, 1, 1)), np.zeros(7))
    q, done = np.zeros((50_000, 7)), []

    def work() -> None:
        for _ in range(40):
            chain.jacobian(q)
        done.append(True)

    thread = Thread(target=work)
    thread.start()  # returns when the worker releases the interpreter
    assert not done
    thread.join()
    assert done

"""The compiled kernels give what the NumPy reference gives, for every method, any chain and any batch."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

METHODS = {  # name: arguments out of the inputs below
    "forward": ("q",),
    "jacobian": ("q",),
    "forward_jacobian": ("q",),
    "link_transforms": ("q",),
    "jacobian_derivative": ("q", "qd"),
    "rnea": ("q", "qd", "qdd", "gravity", "pi"),
    "rigid_regressor": ("q", "qd", "qdd", "gravity"),
    "gravity_regressor": ("q", "gravity"),
    "mass_matrix": ("q", "pi"),
    "momentum": ("q", "qd", "pi"),
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
@settings(max_examples=60)
def test_native_is_the_reference(case: tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]) -> None:
    frames, prismatic, inputs = case
    native, reference = (module.Chain(frames, prismatic) for module in (_native, _reference))
    for name, arguments in METHODS.items():
        values = [inputs[a] for a in arguments]
        assert_same(getattr(native, name)(*values), getattr(reference, name)(*values))
    assert_same(native.jacobian(inputs["q"], tool=True), reference.jacobian(inputs["q"], tool=True))
    motion = inputs["q"], inputs["qd"]
    assert_same(native.jacobian_derivative(*motion, tool=True), reference.jacobian_derivative(*motion, tool=True))
    assert_same(native.frames, reference.frames)
    assert native.n == reference.n == len(prismatic)
    assert (native.prismatic == reference.prismatic).all()


@pytest.fixture(params=[_native, _reference], ids=["native", "reference"])
def chain(request: pytest.FixtureRequest) -> Any:
    frames = np.stack([pose((0.3 * k, -0.2 * k, 0.1, 0.1, 0.2, 0.3)) for k in range(5)])
    return request.param.Chain(frames, np.array([False, True, False, False]))


@pytest.fixture
def inputs() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    batch = {name: rng.normal(size=(2, 35, 4)) for name in ("q", "qd", "qdd")}
    return batch | {"gravity": rng.normal(size=3), "pi": rng.normal(size=(4, 10))}


@pytest.mark.parametrize("name", METHODS)
def test_every_kind_of_input_gives_the_same(chain: Any, inputs: dict[str, np.ndarray], name: str) -> None:
    """Read-only, non-contiguous, big-endian and lists; and no input is changed."""
    plain = [inputs[a] for a in METHODS[name]]
    before = [array.copy() for array in plain]
    wanted = getattr(chain, name)(*plain)
    for array in plain:
        array.flags.writeable = False
    strided = [np.repeat(array, 2, axis=-1)[..., ::2] for array in plain]
    transposed = [np.asfortranarray(array) for array in plain]
    swapped = [array.astype(">f8") for array in plain]
    lists = [array.tolist() for array in plain]
    for arguments in (plain, strided, transposed, swapped, lists):
        for ours, theirs in zip(flat(getattr(chain, name)(*arguments)), flat(wanted)):
            np.testing.assert_array_equal(ours, theirs)
    for array, saved in zip(plain, before):
        np.testing.assert_array_equal(array, saved)


@pytest.mark.parametrize("name", METHODS)
def test_out_is_filled_and_returned(chain: Any, inputs: dict[str, np.ndarray], name: str) -> None:
    arguments = [inputs[a] for a in METHODS[name]]
    wanted = getattr(chain, name)(*arguments)
    out = tuple(np.full(array.shape, np.nan) for array in flat(wanted))
    given_out: Any = out if isinstance(wanted, tuple) else out[0]
    result = getattr(chain, name)(*arguments, out=given_out)
    for ours, into, theirs in zip(flat(result), out, flat(wanted)):
        assert ours is into
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("name", METHODS)
def test_batch_is_a_loop(inputs: dict[str, np.ndarray], name: str) -> None:
    """Bit for bit, for whole groups of four samples and for the rest."""
    chain = _native.Chain(np.stack([pose((0.3, -0.2 * k, 0.1, 0.1, 0.2, 0.3)) for k in range(5)]), [0, 1, 0, 0])
    whole = flat(getattr(chain, name)(*[inputs[a] for a in METHODS[name]]))
    for index in np.ndindex(2, 35):
        sample = [inputs[a] if a in ("gravity", "pi") else inputs[a][index] for a in METHODS[name]]
        for one, many in zip(flat(getattr(chain, name)(*sample)), whole):
            np.testing.assert_array_equal(one, many[index])


@pytest.mark.parametrize("name", METHODS)
def test_nan_stays_in_its_sample(chain: Any, inputs: dict[str, np.ndarray], name: str) -> None:
    arguments = [inputs[a].copy() for a in METHODS[name]]
    clean = flat(getattr(chain, name)(*arguments))
    arguments[0][1, 2, 0] = np.nan
    for dirty, wanted in zip(flat(getattr(chain, name)(*arguments)), clean):
        assert np.isnan(dirty[1, 2]).any()
        dirty[1, 2] = wanted[1, 2]
        np.testing.assert_array_equal(dirty, wanted)


def test_angles_beyond_the_polynomial(chain: Any) -> None:
    """Far angles go to the C library; infinity has no sine."""
    q = np.array([[1e300, 0.0, -1e7, 3.0], [1e6, 0.0, -1e6, 2.0]])
    wanted = _reference.Chain(chain.frames, chain.prismatic).forward(q[1])
    np.testing.assert_allclose(chain.forward(q)[1], wanted, rtol=0, atol=1e-9)
    assert np.isfinite(chain.forward(q)).all()
    if isinstance(chain, _native.Chain):
        assert np.isnan(chain.forward([np.inf, 0.0, 0.0, 0.0])[0, 0])


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("forward", {"q": np.zeros((2, 3))}, r"q of shape \(\.\.\., 4\), got \(2, 3\)"),
        ("forward", {"q": np.float64(1.0)}, r"q of shape \(\.\.\., 4\), got \(\)"),
        ("forward", {"q": "north"}, "array of real numbers, got str"),
        ("forward", {"q": [[1.0], [2.0, 3.0]]}, "array of real numbers, got list"),
        ("jacobian", {"q": np.zeros(4, dtype=complex)}, "array of real numbers"),
        ("rnea", {"qd": np.zeros((1, 4))}, r"qd of the same shape as q, \(2, 35, 4\), got \(1, 4\)"),
        ("rnea", {"gravity": np.zeros(4)}, r"gravity of shape \(3,\), got \(4,\)"),
        ("rnea", {"pi": np.zeros((4, 9))}, r"pi of shape \(4, 10\), got \(4, 9\)"),
        ("rigid_regressor", {"qdd": np.zeros(4)}, "qdd of the same shape as q"),
        ("gravity_regressor", {"gravity": np.zeros((3, 1))}, r"gravity of shape \(3,\), got \(3, 1\)"),
        ("forward", {"out": np.zeros((2, 35, 4, 3))}, r"shape \(2, 35, 4, 4\), got shape \(2, 35, 4, 3\)"),
        ("forward", {"out": np.zeros((2, 35, 4, 4), dtype=np.float32)}, "writable C-contiguous float64"),
        ("forward", {"out": [1.0]}, "writable C-contiguous float64"),
        ("forward_jacobian", {"out": np.zeros(2)}, "pair of arrays"),
    ],
)
def test_wrong_arguments(
    chain: Any, inputs: dict[str, np.ndarray], name: str, change: dict[str, Any], sentence: str
) -> None:
    arguments = {a: inputs[a] for a in METHODS[name]} | change
    with pytest.raises(ShapeError, match=sentence):
        getattr(chain, name)(**arguments)


MODULES = pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])


@MODULES
@pytest.mark.parametrize("name", METHODS)
def test_out_apart_from_the_samples(module: Any, name: str) -> None:
    """Each of them, refused in the same words with and without the extension."""
    chain = module.Chain(np.tile(np.eye(4), (5, 1, 1)), np.zeros(4))
    given = {"gravity": np.zeros(3), "pi": np.zeros((4, 10))} | {key: np.zeros(4) for key in ("q", "qd", "qdd")}
    wanted = getattr(chain, name)(*(given[key] for key in METHODS[name]))
    pair = isinstance(wanted, tuple)
    for key in ("q", "qd", "qdd"):
        if key not in METHODS[name]:
            continue
        memory = np.zeros(8 + (wanted[1] if pair else wanted).size)
        arguments = [memory[:4] if other == key else given[other] for other in METHODS[name]]
        last = wanted[1] if pair else wanted
        inside = memory[2 : 2 + last.size].reshape(last.shape)
        sentence = rf"Expected out(\[1\])? to be .* got one that shares memory with {key}\. Make"
        with pytest.raises(ShapeError, match=sentence):
            getattr(chain, name)(*arguments, out=(np.empty_like(wanted[0]), inside) if pair else inside)


@MODULES
@pytest.mark.parametrize(
    ("name", "size"),
    [("rnea", (4,)), ("mass_matrix", (4, 4)), ("rigid_regressor", (4, 40)), ("gravity_regressor", (4, 16))],
)
def test_out_apart_from_the_parameters(module: Any, name: str, size: tuple[int, ...]) -> None:
    """The next sample would be computed with other parameters."""
    chain, memory = module.Chain(np.tile(np.eye(4), (5, 1, 1)), np.zeros(4)), np.zeros(200)
    parameters = {"gravity": memory[:3], "pi": memory[:40].reshape(4, 10)}
    arguments = [parameters.get(argument, np.zeros(4)) for argument in METHODS[name]]
    with pytest.raises(ShapeError, match=r"Expected out to be apart from (gravity|pi), got arrays that share memory"):
        getattr(chain, name)(*arguments, out=memory[2 : 2 + np.prod(size)].reshape(size))


def test_momentum_into_arrays_apart(chain: Any, inputs: dict[str, np.ndarray]) -> None:
    both = np.zeros((2, 35, 4))
    with pytest.raises(ShapeError, match=r"out\[1\] and out\[0\] to be apart, got arrays that share memory"):
        chain.momentum(inputs["q"], inputs["qd"], inputs["pi"], out=(both, both))


@pytest.mark.parametrize("prismatic", [False, True])
@pytest.mark.parametrize("joint", [0, 1, 2])
@pytest.mark.parametrize("name", ["forward", "jacobian", "jacobian_derivative"])
def test_a_joint_that_is_missing_shows(name: str, joint: int, prismatic: bool) -> None:
    """Also where the result depends on no joint: all axes are one, with the tool on it."""
    q = np.where(np.arange(3) == joint, np.nan, 0.5)
    for module in (_native, _reference):
        chain = module.Chain(np.tile(np.eye(4), (4, 1, 1)), [prismatic] * 3)
        arguments = (q, np.ones(3)) if name == "jacobian_derivative" else (q,)
        assert np.isnan(getattr(chain, name)(*arguments)).any()
        batch = getattr(chain, name)(*(np.tile(argument, (9, 1)) for argument in arguments))
        assert np.isnan(batch).any(axis=(1, 2)).all()


@pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])
@pytest.mark.parametrize("prismatic", [None, ["a", "b"], [[True], [False, True]]])
def test_kinds_of_joints_that_are_none(module: Any, prismatic: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected prismatic to be an array of real numbers, got .*\.$"):
        module.Chain(np.tile(np.eye(4), (3, 1, 1)), prismatic)


@pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])
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
def test_wrong_chains(module: Any, frames: np.ndarray, prismatic: list[bool], sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        module.Chain(frames, prismatic)


@pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])
def test_slightly_rough_rotations_are_projected(module: Any) -> None:
    frames = np.tile(np.eye(4), (3, 1, 1))
    frames[:, :3, :3] += 3e-8 * np.random.default_rng(3).normal(size=(3, 3, 3))
    R = module.Chain(frames, [False, False]).frames[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (3, 1, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(R, frames[:, :3, :3], rtol=0, atol=3e-7)

"""Arrays in and out of the kernels: any kind, any batch and any number of threads give the same bits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import kernels
from armlab.errors import ConfigError, ShapeError
from armlab.kernels import Chain

from .test_chain import METHODS, pose
from .test_lie import FUNCTIONS, function, inputs

KERNELS = ("forward", "jacobian", "forward_jacobian", "link_transforms")
THREADED = KERNELS[:3]


def arm(n: int, seed: int = 0) -> Chain:
    """A chain with zero, right-angle, half-turn and other twists; with four or more joints, some are prismatic."""
    rng = np.random.default_rng(seed)
    frames = np.tile(np.eye(4), (n + 1, 1, 1))
    for k, frame in enumerate(frames):
        alpha = (0.0, np.pi / 2, -np.pi / 2, np.pi, 1e-9, *rng.uniform(-3, 3, 3))[k % 8]
        c, s = np.cos(alpha), np.sin(alpha)
        frame[1:3, 1:3] = [[c, -s], [s, c]]
        frame[:3, 3] = rng.normal(size=3) * (rng.random(3) < 0.6)
    return Chain(frames, [n > 3 and i % 5 == 2 for i in range(n)])


def flat(result: Any) -> list[np.ndarray]:
    return list(result) if isinstance(result, tuple) else [result]


def assert_same_bits(ours: Any, wanted: Any) -> None:
    for one, other in zip(flat(ours), flat(wanted), strict=True):
        np.testing.assert_array_equal(np.asarray(one).view(np.int64), np.asarray(other).view(np.int64))


BATCH = (2, 35)  # whole groups of four samples, and a remainder


def batches() -> dict[str, tuple[Callable[..., Any], list[np.ndarray], int]]:
    """Every kernel that takes samples, with its arguments and how many of the first ones are samples."""
    rng, chain = (
        np.random.default_rng(1),
        Chain([pose((0.3, -0.2 * k, 0.1, 0.1, 0.2, 0.3)) for k in range(5)], [0, 1, 0, 0]),
    )
    given = inputs(BATCH, rng.uniform(0, np.pi, BATCH) * rng.integers(0, 2, BATCH), 2)
    given |= {"gravity": rng.normal(size=3), "pi": rng.normal(size=(4, 10))}
    found = {
        name: (function(kernels, name), [given[kind] for kind in kinds], len(kinds))
        for name, kinds in FUNCTIONS.items()
    }
    given |= {name: rng.normal(size=(*BATCH, 4)) for name in ("q", "qd", "qdd")}
    for name, kinds in METHODS.items():
        own = len([kind for kind in kinds if kind[0] == "q"])
        found[f"Chain.{name}"] = getattr(chain, name), [given[kind] for kind in kinds], own
    return found


CALLS = batches()
EVERY = pytest.mark.parametrize("name", CALLS)


@EVERY
def test_every_kind_of_input_gives_the_same(name: str) -> None:
    """Read-only, non-contiguous and big-endian arrays, and lists; no input is changed."""
    call, given, _ = CALLS[name]
    plain, wanted = [array.copy() for array in given], call(*given)
    for array in plain:
        array.flags.writeable = False
    strided = [np.repeat(array, 2, axis=-1)[..., ::2] for array in plain]
    swapped, lists = [array.astype(">f8") for array in plain], [array.tolist() for array in plain]
    for arguments in (plain, strided, [np.asfortranarray(array) for array in plain], swapped, lists):
        assert_same_bits(call(*arguments), wanted)
    assert_same_bits(tuple(plain), tuple(given))


@EVERY
def test_a_batch_is_a_loop(name: str) -> None:
    call, given, own = CALLS[name]
    whole = flat(call(*given))
    for index in np.ndindex(*BATCH):
        sample = [array[index] if k < own else array for k, array in enumerate(given)]
        assert_same_bits(call(*sample), tuple(array[index] for array in whole) if len(whole) > 1 else whole[0][index])


@EVERY
def test_a_missing_number_stays_in_its_sample(name: str) -> None:
    call, given, _ = CALLS[name]
    arguments, clean = [array.copy() for array in given], flat(call(*given))
    arguments[0][1, 2] = np.nan
    for dirty, wanted in zip(flat(call(*arguments)), clean, strict=True):
        assert np.isnan(dirty[1, 2]).any()
        dirty[1, 2] = wanted[1, 2]
        np.testing.assert_array_equal(dirty, wanted)


@EVERY
def test_results_go_into_arrays_of_the_caller(name: str) -> None:
    """Writable float64 arrays that share no memory with a sample."""
    call, given, own = CALLS[name]
    wanted = call(*given)
    out = [np.full(array.shape, np.nan) for array in flat(wanted)]

    def result(arguments: list[np.ndarray], last: np.ndarray) -> Any:
        return call(*arguments, out=(*out[:-1], last) if isinstance(wanted, tuple) else last)

    found = result(given, out[-1])
    assert all(ours is into for ours, into in zip(flat(found), out, strict=True))
    assert_same_bits(found, wanted)
    with pytest.raises(ShapeError, match="writable C-contiguous float64"):
        result(given, np.empty(out[-1].shape, dtype=np.float32))
    for k in range(own):
        memory, size = np.concatenate([given[k].ravel(), np.zeros(out[-1].size)]), given[k].size
        shared = [*given[:k], memory[:size].reshape(given[k].shape), *given[k + 1 :]]
        inside = memory[size - 1 :][: out[-1].size].reshape(out[-1].shape)
        with pytest.raises(ShapeError, match=r"Expected out(\[1\])? to be .* got an array that shares memory with"):
            result(shared, inside)


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 7, 32])
def test_batches_of_any_size_are_loops(name: str, n: int) -> None:
    """Batch sizes below, at and around whole groups of lanes."""
    chain = arm(n)
    q = np.random.default_rng(1).uniform(-4, 4, (17, n))
    kernel = getattr(chain, name)
    singles = [flat(kernel(row)) for row in q]
    for count in range(18):
        wanted = [np.array(parts).reshape(count, *part.shape) for part, *parts in zip(singles[0], *singles[:count])]
        assert_same_bits(kernel(q[:count]), tuple(wanted))


@pytest.mark.parametrize("name", THREADED)
@pytest.mark.parametrize("threads", [2, 3, 256])
def test_threads_give_the_same_bits(name: str, threads: int) -> None:
    chain = arm(7)
    q = np.random.default_rng(2).uniform(-4, 4, (20_011, 7))
    kernel = getattr(chain, name)
    assert_same_bits(kernel(q, threads=np.int64(threads)), kernel(q))
    assert_same_bits(kernel(q[:0], threads=threads), kernel(q[:0]))


@pytest.mark.parametrize("shift", [0, 1], ids=["streamed", "odd address"])
@pytest.mark.parametrize("threads", [1, 2])
def test_large_outputs_hold_the_same_bits(shift: int, threads: int) -> None:
    """Beyond 16 MB, results bypass the caches if the address of the output allows it."""
    chain, count = arm(6), 125_003
    q = np.random.default_rng(3).uniform(-4, 4, (count, 6))
    T = np.full(16 * count + shift, np.nan)[shift:].reshape(count, 4, 4)
    J = np.full(36 * count + shift, np.nan)[shift:].reshape(count, 6, 6)
    assert_same_bits(chain.forward(q, out=T, threads=threads), chain.forward(q))
    T[:] = np.nan
    both = chain.forward_jacobian(q, out=(T, J), threads=threads)
    assert both[0] is T
    assert both[1] is J
    assert_same_bits(both, chain.forward_jacobian(q))


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -2e6, 1e6 + 1, 4e15])
def test_bad_and_far_values_stay_in_their_sample(name: str, bad: float) -> None:
    """For any place among the lanes and any neighbours."""
    chain = Chain(np.tile(np.eye(4), (6, 1, 1)), np.zeros(5))
    clean = np.random.default_rng(5).uniform(-4, 4, (11, 5))
    kernel = getattr(chain, name)
    wanted = flat(kernel(clean))
    for row in range(11):
        dirty = clean.copy()
        dirty[row, row % 5] = bad
        others = np.arange(11) != row
        alone = flat(kernel(dirty[row]))
        for ours, theirs, one in zip(flat(kernel(dirty)), wanted, alone):
            np.testing.assert_array_equal(ours[others], theirs[others])
            np.testing.assert_array_equal(ours[row], one)
        assert np.isfinite(bad) == np.isfinite(alone[0]).all()


def test_far_angles_have_their_sine() -> None:
    chain = Chain(np.tile(np.eye(4), (2, 1, 1)), [False])
    angles = np.array([1e6, 1e6 + 1, -3e7, 1e15, 1e300, np.nextafter(1e6, 0)])
    T = chain.forward(angles[:, None])
    np.testing.assert_allclose(T[:, 0, 0], np.cos(angles), rtol=0.0, atol=3e-16)
    np.testing.assert_allclose(T[:, 1, 0], np.sin(angles), rtol=0.0, atol=3e-16)


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="long double is no longer than double")
def test_sine_and_cosine_to_rounding() -> None:
    """Errors below 2.5e-16, also where the reduction cancels, next to multiples of a right angle."""
    rng = np.random.default_rng(6)
    multiples = np.pi / 2 * rng.integers(-600_000, 600_000, 50_000)
    angles = [rng.uniform(-4, 4, 50_000), rng.uniform(-1e6, 1e6, 50_000), multiples, np.nextafter(multiples, 0)]
    angles += [multiples + rng.normal(size=50_000) * 10.0 ** rng.uniform(-16, 0, 50_000)]
    x = np.clip(np.concatenate(angles), -1e6, 1e6)
    T = Chain(np.tile(np.eye(4), (2, 1, 1)), [False]).forward(x[:, None])
    exact = x.astype(np.longdouble)
    assert np.abs(T[:, 0, 0] - np.cos(exact)).max() < 2.5e-16
    assert np.abs(T[:, 1, 0] - np.sin(exact)).max() < 2.5e-16
    assert (np.abs(T[:, :2, :2]) <= 1.0).all()


@pytest.mark.parametrize("name", THREADED)
@pytest.mark.parametrize("threads", [0, -1, 257, 10**30, 2.0, True, "two", None])
def test_numbers_of_threads_that_are_none(name: str, threads: Any) -> None:
    with pytest.raises(ConfigError, match=r"Expected threads to be an integer from 1 to 256, got .+\.$"):
        getattr(arm(3), name)(np.zeros(3), threads=threads)


def test_outputs_apart_from_each_other() -> None:
    chain, memory = arm(3), np.zeros(34)
    T, J = memory[:16].reshape(4, 4), memory[15:33].reshape(6, 3)
    with pytest.raises(ShapeError, match=r"out\[1\] and out\[0\] not to share memory, got overlapping arrays"):
        chain.forward_jacobian(np.zeros(3), out=(T, J))
    beside = memory[16:].reshape(6, 3)
    assert_same_bits(chain.forward_jacobian(np.ones(3), out=(T, beside)), chain.forward_jacobian(np.ones(3)))


def test_pair_with_the_jacobian_in_tool_axes() -> None:
    chain, q = arm(7), np.random.default_rng(7).uniform(-3, 3, (5, 7))
    T, J = chain.forward_jacobian(q, tool=True)
    np.testing.assert_array_equal(T, chain.forward(q))
    np.testing.assert_array_equal(J, chain.jacobian(q, tool=True))

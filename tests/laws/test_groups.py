"""Group laws of rotations, poses and quaternions: every law, every batch shape, every region of the group.

Samplers near the identity and near a half turn reach the series branches, which uniform samplers never do.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import numpy as np

from armlab.lie import quaternion, se3, so3

BATCHES = [(), (1,), (7,), (2, 3), (0,), (2, 0, 3)]
LAW = 1e-13


def directions(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    u = rng.standard_normal((*batch, 3))
    return u / np.linalg.norm(u, axis=-1, keepdims=True)


def uniform(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    """Rotation vectors of uniformly distributed rotations, generated without the code under test."""
    q = rng.standard_normal((*batch, 4))
    half = np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), np.abs(q[..., 0]))
    return 2 * half[..., None] * directions(rng, batch)


def tangent(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    return rng.uniform(0, np.pi, (*batch, 1)) * directions(rng, batch)


def near_identity(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    return 10.0 ** rng.uniform(-16, -1, (*batch, 1)) * directions(rng, batch)


def near_half_turn(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    return (np.pi - 10.0 ** rng.uniform(-12, -2, (*batch, 1))) * directions(rng, batch)


def special(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    return rng.choice([0.0, 1e-12, 1e-6, np.pi - 1e-9], (*batch, 1)) * directions(rng, batch)


def half_turns(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    return np.pi * directions(rng, batch)


SAMPLERS: list[Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]] = [
    uniform,
    tangent,
    near_identity,
    near_half_turn,
    special,
    half_turns,
]
DRAWN = [(uniform, batch) for batch in BATCHES] + [(sampler, batch) for sampler in SAMPLERS[1:] for batch in [(), (7,)]]


def twists(rng: np.random.Generator, batch: tuple[int, ...], sampler: Callable[..., np.ndarray]) -> np.ndarray:
    return np.concatenate([rng.standard_normal((*batch, 3)), sampler(rng, batch)], axis=-1)


def so3_case(rng, batch, sampler) -> SimpleNamespace:
    w = [sampler(rng, batch) for _ in range(3)]
    elements = [so3.exp(v) for v in w]
    return SimpleNamespace(
        sampler=sampler,
        exp=so3.exp, log=so3.log, multiply=np.matmul, inverse=lambda R: np.swapaxes(R, -1, -2),
        identity=np.eye(3), vectors=w, elements=elements,
    )  # fmt: skip


def se3_case(rng, batch, sampler) -> SimpleNamespace:
    xi = [twists(rng, batch, sampler) for _ in range(3)]
    return SimpleNamespace(
        sampler=sampler,
        exp=se3.exp, log=se3.log, multiply=np.matmul, inverse=se3.inv,
        identity=np.eye(4), vectors=xi, elements=[se3.exp(v) for v in xi],
    )  # fmt: skip


def quaternion_case(rng, batch, sampler) -> SimpleNamespace:
    w = [sampler(rng, batch) for _ in range(3)]

    def exp(v: np.ndarray) -> np.ndarray:
        return quaternion.from_matrix(so3.exp(v))

    return SimpleNamespace(
        sampler=sampler,
        exp=exp, log=lambda q: so3.log(quaternion.to_matrix(q)), multiply=quaternion.multiply,
        inverse=quaternion.conjugate, identity=np.array([1.0, 0, 0, 0]), vectors=w, elements=[exp(v) for v in w],
    )  # fmt: skip


def everywhere(law: Callable[..., None]) -> Callable[[], None]:
    """Make one test of a law for every batch shape and every region of the group."""

    def test() -> None:
        for sampler, batch in DRAWN:
            try:
                law(batch, sampler)
            except AssertionError as error:
                error.add_note(f"{sampler.__name__}, batch {batch}")
                raise

    return test


def of_every_group(law: Callable[[SimpleNamespace], None]) -> Callable[[], None]:
    """Make one test of a law for rotations, poses and quaternions."""

    @everywhere
    def test(batch: tuple[int, ...], sampler: Callable[..., np.ndarray]) -> None:
        for make in (so3_case, se3_case, quaternion_case):
            law(make(np.random.default_rng(1), batch, sampler))

    return test


def distance(a: np.ndarray, b: np.ndarray) -> float:
    assert a.shape == b.shape
    return float(np.abs(a - b).max(initial=0.0))


def same_side(case: SimpleNamespace, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Elements a, with the quaternion signs nearest to b: q and -q are the same rotation."""
    return np.where((a * b).sum(axis=-1, keepdims=True) < 0, -a, a) if case.identity.ndim == 1 else a


@of_every_group
def test_log_inverts_exp(case: SimpleNamespace) -> None:
    """A half turn has two logarithms: the exponentials are compared instead."""
    v = case.vectors[0]
    back = case.log(case.exp(v))
    if case.sampler is half_turns:
        v = case.exp(v)
        back = same_side(case, case.exp(back), v)
    assert distance(back, v) <= LAW


@of_every_group
def test_exp_inverts_log(case: SimpleNamespace) -> None:
    a = case.elements[0]
    assert distance(same_side(case, case.exp(case.log(a)), a), a) <= LAW


@of_every_group
def test_inverse(case: SimpleNamespace) -> None:
    a = case.elements[0]
    identity = np.broadcast_to(case.identity, a.shape)
    assert distance(case.multiply(a, case.inverse(a)), identity) <= LAW
    assert distance(case.multiply(case.inverse(a), a), identity) <= LAW


@of_every_group
def test_associativity(case: SimpleNamespace) -> None:
    a, b, c = case.elements
    assert distance(case.multiply(case.multiply(a, b), c), case.multiply(a, case.multiply(b, c))) <= LAW


@of_every_group
def test_identity(case: SimpleNamespace) -> None:
    a = case.elements[0]
    assert distance(case.multiply(a, np.broadcast_to(case.identity, a.shape)), a) == 0
    assert distance(case.exp(np.zeros_like(case.vectors[0])), np.broadcast_to(case.identity, a.shape)) == 0


@of_every_group
def test_closure(case: SimpleNamespace) -> None:
    """A product is in the group: it equals the exponential of its logarithm."""
    a, b, _ = case.elements
    product = case.multiply(a, b)
    again = case.exp(case.log(product))
    assert distance(same_side(case, again, product), product) <= LAW


@everywhere
def test_adjoint_is_a_homomorphism(batch: tuple[int, ...], sampler) -> None:
    case = se3_case(np.random.default_rng(2), batch, sampler)
    T_a_b, T_b_c, _ = case.elements
    assert distance(se3.adjoint(T_a_b @ T_b_c), se3.adjoint(T_a_b) @ se3.adjoint(T_b_c)) <= LAW
    assert distance(se3.adjoint_inv(T_a_b), np.linalg.inv(se3.adjoint(T_a_b))) <= LAW


@everywhere
def test_adjoint_moves_twists(batch: tuple[int, ...], sampler) -> None:
    case = se3_case(np.random.default_rng(3), batch, sampler)
    T, xi = case.elements[0], case.vectors[1]
    moved = se3.vee(T @ se3.hat(xi) @ se3.inv(T))
    assert distance((se3.adjoint(T) @ xi[..., None])[..., 0], moved) <= LAW


@everywhere
def test_power_does_not_depend_on_the_frame(batch: tuple[int, ...], sampler) -> None:
    case = se3_case(np.random.default_rng(4), batch, sampler)
    T_a_b, twist_b, wrench_b = case.elements[0], *case.vectors[1:]
    twist_a = (se3.adjoint(T_a_b) @ twist_b[..., None])[..., 0]
    wrench_a = se3.transform_wrench(T_a_b, wrench_b)
    assert distance((twist_a * wrench_a).sum(axis=-1), (twist_b * wrench_b).sum(axis=-1)) <= 1e-12
    by_adjoint = np.swapaxes(se3.adjoint_inv(T_a_b), -1, -2) @ wrench_b[..., None]
    assert distance(by_adjoint[..., 0], wrench_a) <= LAW


@everywhere
def test_left_jacobians(batch: tuple[int, ...], sampler) -> None:
    """``Ad(exp(x)) J(-x) = J(x)`` (left from right), the inverse, and ``J(x) x = x``."""
    for group in (so3, se3):
        rng = np.random.default_rng(6)
        x = sampler(rng, batch) if group is so3 else twists(rng, batch, sampler)
        J, J_inv = group.left_jacobian(x), group.left_jacobian_inv(x)
        Ad = so3.exp(x) if group is so3 else se3.adjoint(se3.exp(x))
        assert distance(Ad @ group.left_jacobian(-x), J) <= LAW
        assert distance(J_inv @ J, np.broadcast_to(np.eye(x.shape[-1]), J.shape)) <= LAW
        assert distance((J @ x[..., None])[..., 0], x) <= LAW
        assert distance((J_inv @ x[..., None])[..., 0], x) <= LAW


@everywhere
def test_the_bracket_is_the_adjoint_of_the_algebra(batch: tuple[int, ...], sampler) -> None:
    """``ad(x) y = -ad(y) x``, ``Ad(T) ad(x) Ad(T)⁻¹ = ad(Ad(T) x)``."""
    case = se3_case(np.random.default_rng(7), batch, sampler)
    T, (x, y, _) = case.elements[0], case.vectors
    assert distance((se3.ad(x) @ y[..., None])[..., 0], -(se3.ad(y) @ x[..., None])[..., 0]) <= LAW
    moved = (se3.adjoint(T) @ x[..., None])[..., 0]
    assert distance(se3.adjoint(T) @ se3.ad(x) @ se3.adjoint_inv(T), se3.ad(moved)) <= LAW


@of_every_group
def test_interpolation_is_a_flow(case: SimpleNamespace) -> None:
    """Halfway to the midpoint is a quarter of the way."""
    interpolate = {3: so3.interpolate, 4: partial(se3.interpolate, path="screw")}.get(len(case.identity))
    if case.identity.ndim == 1:
        interpolate = quaternion.slerp
    a, _, _ = case.elements
    near = case.multiply(a, case.exp(case.vectors[1] / 4))  # less than a quarter turn away: a unique shortest path
    middle = interpolate(a, near, 0.5)
    quarter = interpolate(a, near, 0.25)
    again = interpolate(a, middle, 0.5)
    assert distance(again, quarter) <= LAW

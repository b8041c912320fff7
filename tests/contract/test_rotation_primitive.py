"""The compiled orientations of a movement primitive against the reference, and both against their laws."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kernels
from armlab.errors import ShapeError
from armlab.kernels import _reference
from armlab.lie import quaternion, so3

T = np.linspace(0.0, 1.3, 60)
Q0, GOAL = quaternion.from_matrix(so3.exp([0.2, -0.4, 0.9])), quaternion.from_matrix(so3.exp([-0.8, 0.6, 0.3]))
W0, MAP, TAU = np.array([0.4, -1.0, 0.2]), np.array([[0.5, -0.2, 0.1], [0.3, 1.5, 0.0], [0.0, 0.4, -0.7]]), 0.35


def primitive(module=kernels, phase: str = "canonical", size: float = 40.0, n: int = 3):
    weights = size * np.random.default_rng(1).normal(size=(12, n))
    centres = np.linspace(0.05, 1.0, 12)
    return module.Primitive(centres, np.full(12, 0.06), weights, 25.0, 156.25, 1.0, 1 / 3, phase)


@pytest.mark.parametrize("phase", ["canonical", "time"])
@pytest.mark.parametrize("stride", [1, 25])  # steps that the spring allows, and others
def test_rollout_is_that_of_the_reference(phase: str, stride: int) -> None:
    rows = [
        module.rotation_rollout(primitive(module, phase), T[::stride], TAU, Q0, W0, GOAL, MAP)
        for module in (kernels, _reference)
    ]
    for own, wanted, size in zip(*rows, (1.0, 10.0, 400.0)):
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(np.linalg.norm(rows[0][0], axis=1), 1.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("module", [kernels, _reference])
def test_a_stepper_is_a_rollout_and_takes_another_goal_and_time_constant(module) -> None:
    stepper = module.RotationStepper(primitive(module))
    stepper.start(Q0, W0, GOAL, MAP, TAU)
    rows = [stepper.outputs(), *(stepper.step(dt) for dt in np.diff(T[:20]))]
    whole = module.rotation_rollout(primitive(module), T[:20], TAU, Q0, W0, GOAL, MAP)
    for own, wanted in zip((np.array(part) for part in zip(*rows)), whole):
        np.testing.assert_array_equal(own, wanted)
    q, w, _ = rows[-1]
    stepper.change_tau(2 * TAU)
    np.testing.assert_allclose(stepper.outputs()[1], w, rtol=1e-14)
    assert stepper.tau == 2 * TAU
    stepper.change_goal(Q0, 0 * MAP)
    for _ in range(60):
        q, w, _ = stepper.step(0.1)
    np.testing.assert_allclose(np.abs(q @ Q0), 1.0, rtol=0, atol=1e-14)
    assert stepper.elapsed > 9


@pytest.mark.parametrize("module", [kernels, _reference])
def test_order_is_four(module) -> None:
    """On the way of a smooth force, against many small steps; and where the goal is half a turn away nothing breaks."""
    smooth = module.Primitive(
        np.linspace(0, 1, 4), np.full(4, 0.3), np.full((4, 3), [60, -80, 40.0]), 25, 156.25, 1, 1 / 3, "canonical"
    )
    ends = {}
    for n in (100, 200, 3200 if module is kernels else 500):
        ends[n] = module.rotation_rollout(smooth, np.linspace(0, 1, n + 1), 1 / 3, Q0, W0, GOAL, np.eye(3))[0][n // 2]
    fine = ends[max(ends)]
    coarse, better = (np.linalg.norm(ends[n] - fine) for n in (100, 200))
    assert np.log2(coarse / better) > 3.8
    half = quaternion.multiply(quaternion.from_matrix(so3.exp([0, 0, np.pi])), Q0)
    q, _, _ = module.rotation_rollout(smooth, T, TAU, Q0, 0 * W0, half, np.eye(3))
    assert np.isfinite(q).all()


@pytest.mark.parametrize("module", [kernels, _reference])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": [0.0, 0.1, 0.1]}, "times that increase"),
        ({"t": []}, "at least one time"),
        ({"t": [0.0, np.nan]}, "finite t"),
        ({"t": [0.0, 1e9]}, "time constants"),
        ({"tau": 0.0}, "tau above zero"),
        ({"q0": np.zeros(4)}, "length 1 as q0"),
        ({"goal": np.zeros(3)}, "goal of shape"),
        ({"w0": [0, np.inf, 0]}, "finite w0"),
        ({"map": np.eye(4)}, "map of shape"),
    ],
)
def test_refusals(module, change: dict, words: str) -> None:
    given = {"t": T, "tau": TAU, "q0": Q0, "w0": W0, "goal": GOAL, "map": MAP, **change}
    with pytest.raises(ShapeError, match=words):
        module.rotation_rollout(
            primitive(module), *(np.asarray(v, float) if k != "tau" else v for k, v in given.items())
        )


@pytest.mark.parametrize("module", [kernels, _reference])
def test_another_primitive_or_step_is_refused(module) -> None:
    for other in (primitive(module, n=2), primitive(module, phase="position")):
        with pytest.raises(ShapeError, match="three coordinates"):
            module.RotationStepper(other)
    with pytest.raises(ShapeError, match="dt above zero"):
        module.RotationStepper(primitive(module)).step(0.0)

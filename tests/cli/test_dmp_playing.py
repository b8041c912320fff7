"""What `armlab dmp play` makes of each kind of primitive: a table, or what leads an arm within its limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import State, bridge, kinematics, robots
from armlab.cli.dmp.playing import (
    OPTIONS,
    SETTLES,
    Motion,
    Walk,
    distance,
    motion_of,
    numbers_in,
    rehearsed,
    resolved,
    rolled_out,
)
from armlab.errors import ConfigError
from armlab.motion import TwoDofDmp, fit_dmp, fit_periodic_dmp, fit_pose_dmp, fit_promp, profiles

ROBOT = robots.load("yumi_left")
LIMITS = bridge.Limits.of(ROBOT)
T = np.linspace(0.0, 1.0, 101)
WAY = np.deg2rad([10, -5, 8, -10, 5, 5, 20])


def path(share: float = 1.0) -> np.ndarray:
    return profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + share * WAY, 1.0).at(T)[0]


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    """One primitive of each kind that has a file."""
    dmp = fit_dmp(T, path(), n_basis=20).value
    round_and_round = ROBOT.q_home + 0.1 * np.outer(np.sin(2 * np.pi * T), np.ones(7))
    return {
        "dmp": dmp,
        "two_dof_dmp": TwoDofDmp(dmp),
        "promp": fit_promp(T, np.array([path(k) for k in (0.8, 1.0, 1.3)]), n_basis=8).value,
        "pose_dmp": fit_pose_dmp(T, kinematics.forward(ROBOT, path()), n_basis=20).value,
        "periodic_dmp": fit_periodic_dmp(T, round_and_round, period=1.0).value,
    }


@pytest.mark.parametrize("kind", OPTIONS)
def test_every_kind_leads_the_arm_and_makes_a_table(kind: str, made: dict[str, Any], tmp_path: Path) -> None:
    primitive, run = resolved(type(made[kind]).load(made[kind].save(tmp_path / "m.toml")), {"goal": None})
    table = rolled_out(primitive, run)
    assert table.names == (("T_base_tool",) if kind == "pose_dmp" else ("y", "yd", "ydd"))
    assert table.t[-1] == pytest.approx(4.0 if kind == "periodic_dmp" else 1.0, abs=0.005)
    motion = motion_of(primitive, run, ROBOT, LIMITS, firm=False)
    assert isinstance(motion, Motion)
    q = rehearsed(motion)["q"]
    assert np.abs(q[0] - motion.q_start).max() < 0.01
    assert np.abs(np.diff(q, axis=0)).max() / 0.004 <= LIMITS.qd_max.max() * (1 + 1e-9)
    end = ROBOT.q_home + (0.0 if kind == "periodic_dmp" else 31 / 30 if kind == "promp" else 1.0) * WAY
    if kind == "pose_dmp":
        assert max(distance(ROBOT, q[-1], kinematics.forward(ROBOT, end)).values()) < 1e-3
    else:
        np.testing.assert_allclose(q[-1], end, rtol=0, atol=2e-3)


@pytest.mark.parametrize("kind", ["dmp", "two_dof_dmp", "promp"])
def test_points_on_the_way_are_passed(kind: str, made: dict[str, Any]) -> None:
    point = path(1.2 if kind == "promp" else 1.0)[50] + (0.0 if kind == "promp" else 0.02)
    primitive, run = resolved(made[kind], {"via": [f"0.5:{','.join(map(str, point))}"]})
    table = rolled_out(primitive, run)
    np.testing.assert_allclose(table["y"][125], point, rtol=0, atol=2e-3)


def test_a_motion_too_fast_is_stretched(made: dict[str, Any]) -> None:
    slow = bridge.Limits.of(ROBOT, speed=0.05)
    for kind in ("dmp", "pose_dmp", "periodic_dmp"):
        primitive, run = resolved(made[kind], {"duration": 0.2})
        motion = motion_of(primitive, run, ROBOT, slow, firm=True)
        assert motion.seconds > 1.0
        assert np.all(np.abs(rehearsed(motion)["qd"]) <= slow.qd_max * (1 + 1e-9))


def test_the_walk_ends_where_it_shall() -> None:
    walk, q, k = Walk(ROBOT.q_home + WAY, ROBOT.qd_max), ROBOT.q_home, 0
    while not (command := walk(State(0.004 * k, 0.004, q, q, q))).ends:
        assert command.q is not None
        q, k = command.q, k + 1
        assert 0.004 * k < 10.0 + SETTLES
    np.testing.assert_allclose(q, ROBOT.q_home + WAY, atol=1e-9)


def test_what_does_not_fit_is_refused(made: dict[str, Any]) -> None:
    assert numbers_in(None, "goal") is None
    assert numbers_in("1,-2e-1", "goal") == pytest.approx([1.0, -0.2])
    for misuse in (
        lambda: numbers_in("1;2", "goal"),
        lambda: resolved(made["pose_dmp"], {"via": ["0.5:1"]}),
        lambda: resolved(made["dmp"], {"amplitude": 2.0}),
        lambda: resolved(made["dmp"], {"via": ["now:1"]}),
        lambda: resolved(ROBOT, {}),
    ):
        with pytest.raises(ConfigError, match=r"^Expected .*\."):
            misuse()
    far = {"goal": np.array([9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])}
    with pytest.raises(ConfigError, match="out of reach"):
        motion_of(made["pose_dmp"], far, ROBOT, LIMITS, firm=False)


def test_a_motion_is_as_fast_as_asked_within_the_limits(made: dict[str, Any]) -> None:
    seconds = [motion_of(made["dmp"], {"duration": d}, ROBOT, LIMITS, firm=True).seconds for d in (2.0, 0.5, 1e-3)]
    assert seconds[:2] == [2.0, 0.5]
    fastest = np.abs(made["dmp"].rollout(1e-4, duration=seconds[2]).yd).max(axis=0) / LIMITS.qd_max
    assert fastest.max() == pytest.approx(1.0, rel=1e-3)

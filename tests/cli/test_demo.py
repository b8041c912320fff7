"""The demo: its plan, its verdict, and the whole of it over EGM."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.cli import main
from armlab.cli.demo import PRESSES, Plan, demo, rehearse
from armlab.cli.demo_report import judge
from armlab.log import Table


@pytest.fixture(scope="module")
def plan() -> Plan:
    return Plan.make(robots.load("yumi_right"), seed=0)


def pretend(plan: Plan, error: np.ndarray, sigma: float = 0.5) -> Table:
    """A run whose estimate is the truth plus `error` (N, 6)."""
    t = np.arange(0, 3.0 + plan.test.seconds, 0.004)
    wrench = plan.wrench(t) + error if error.ndim else plan.wrench(t) + error * np.ones((len(t), 6))
    cov = np.tile(sigma**2 * np.eye(6), (len(t), 1, 1))
    columns = {"wrench_hat": wrench, "wrench_hat_cov": cov, "observability": np.ones((len(t), 6))}
    return Table(t, columns).with_column("t_guidance", t, unit="s")


def noise(plan: Plan, sd: float) -> np.ndarray:
    N = len(np.arange(0, 3.0 + plan.test.seconds, 0.004))
    return sd * np.clip(np.random.default_rng(0).standard_normal((N, 6)), -2.5, 2.5)


def test_the_plan_presses_while_the_arm_sways_and_once_at_rest(plan: Plan) -> None:
    assert [name for name, *_ in plan.presses] == [name for name, *_ in PRESSES] + ["at rest -z"]
    for name, axis, force, start, end in plan.presses:
        middle = plan.wrench(np.array([0.5 * (start + end)]))[0]
        assert middle[axis] == force, name
        assert np.count_nonzero(middle) == 1
        inside = plan.rest if "rest" in name else plan.sway
        assert inside[0] < start < end < inside[1]
    assert not plan.wrench(np.linspace(*plan.free, 100)).any()


def test_the_free_motion_stays_below_half_speed(plan: Plan) -> None:
    _, qd, _ = plan.test.sample(np.linspace(0, plan.free[1] - 3.0, 2000))
    assert np.all(np.abs(qd) <= 0.5 * robots.load("yumi_right").qd_max)


def test_a_good_estimate_passes_and_its_text_says_so(plan: Plan) -> None:
    """White errors with the stated deviation: everything but the rest is in order; with a wide band at rest, all is."""
    table = pretend(plan, noise(plan, 0.5))
    verdict = judge(table, plan)
    assert len(verdict.missed) == 1
    assert "at rest" in verdict.missed[0]
    rest = (table["t_guidance"] > plan.rest[0])[:, None, None]
    wide = table.with_column("wrench_hat_cov", np.where(rest, 100 * np.eye(6), table["wrench_hat_cov"]))
    verdict = judge(wide, plan)
    assert verdict.passed
    assert 0.94 < verdict.coverage < 0.97
    assert "500 g -z" in verdict.text()


@pytest.mark.parametrize(
    ("error", "sigma", "words"),
    [(2.0, 2.0, "force error x"), (0.0, 0.5, "coverage 100.0 %"), (1.0, 0.4, "500 g"), (2.0, 2.0, "false force")],
)
def test_each_bar_can_be_missed(plan: Plan, error: float, sigma: float, words: str) -> None:
    verdict = judge(pretend(plan, np.array(error), sigma), plan)
    assert any(words in missed for missed in verdict.missed)


def test_an_axis_that_cannot_be_seen_misses_the_bar(plan: Plan) -> None:
    """No sample with observability above 0.9: there is no error to judge, and the demo does not pass."""
    table = pretend(plan, noise(plan, 0.5))
    blind = table.with_column("observability", 0.5 * np.ones((len(table), 6)))
    assert any("force error x nan" in missed for missed in judge(blind, plan).missed)


@pytest.mark.slow
def test_the_demo_meets_its_bars_and_leaves_its_files(tmp_path, capsys) -> None:
    assert demo(fast=True, output=tmp_path / "demo") == 0
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"excite.mcap", "model.toml", "press.csv", "press.mcap", "summary.json", "torque.png", "wrench.png"}
    assert json.loads((tmp_path / "demo" / "summary.json").read_text())["passed"]
    said = capsys.readouterr().out
    assert "every bar is met" in said
    assert "p50" in said
    log, model = str(tmp_path / "demo" / "press.mcap"), str(tmp_path / "demo" / "model.toml")
    assert main(["estimate", "yumi_right", log, "--model", model]) == 0
    assert capsys.readouterr().out.count("contact") >= len(PRESSES) - 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_other_seeds_meet_the_bars(tmp_path, seed: int) -> None:
    outcome = rehearse("yumi_left" if seed == 2 else "yumi_right", seed, tmp_path / "demo", fast=True)
    verdict = judge(outcome["estimate"], outcome["plan"])
    assert verdict.passed, verdict.missed
    assert replace(verdict, missed=("x",)).passed is False

"""The demo: its plan, its verdict, and the whole of it over EGM."""

from __future__ import annotations

import json

import numpy as np
import pytest

from armlab import robots
from armlab.cli import main
from armlab.cli.demo import PRESSES, Plan, demo, judge, rehearse
from armlab.errors import ControllerLate


@pytest.fixture(scope="module")
def plan() -> Plan:
    return Plan.make(robots.load("yumi_right"), seed=0)


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


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--robot", "irb2400"], "yumi_left, yumi_right"),
        (["--seed=-1"], "seed of 0 or more"),
        ([], "new folder"),
    ],
)
def test_refusals_come_before_the_work(tmp_path, capsys, words: list[str], sentence: str) -> None:
    assert main(["demo", "--fast", "-o", str(tmp_path), *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_busy_computer_is_told_of_the_fast_demo(tmp_path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def late(*_: object) -> None:
        raise ControllerLate("The controller was too slow.")

    monkeypatch.setattr("armlab.cli.demo.rehearse", late)
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 1
    said = capsys.readouterr().err
    assert "too slow" in said
    assert "armlab demo --fast" in said


@pytest.mark.slow
def test_the_demo_meets_its_bars_and_leaves_its_files(tmp_path, capsys) -> None:
    assert demo(fast=True, output=tmp_path / "demo") == 0
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"excite.mcap", "model.toml", "press.csv", "press.mcap", "summary.json", "torque.png", "wrench.png"}
    assert json.loads((tmp_path / "demo" / "summary.json").read_text())["passed"]
    said = capsys.readouterr().out
    assert "every bar is met" in said
    assert "p50" in said
    log, model = str(tmp_path / "demo" / "press.mcap"), str(tmp_path / "again.toml")
    assert main(["identify", "yumi_right", str(tmp_path / "demo" / "excite.mcap"), "-o", model]) == 0
    assert main(["log", "show", log]) == 0
    capsys.readouterr()
    assert main(["estimate", "yumi_right", log, "--model", model]) == 0
    assert capsys.readouterr().out.count("contact") >= len(PRESSES) - 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 10))
def test_nine_other_seeds_meet_the_bars(tmp_path, seed: int) -> None:
    """With seed 0 above: ten seeds, both arms, over EGM in lockstep, causal, at 248 Hz."""
    outcome = rehearse("yumi_left" if seed % 2 else "yumi_right", seed, tmp_path / "demo", fast=True)
    verdict = judge(outcome["estimate"], outcome["plan"])
    assert verdict.passed, verdict.missed

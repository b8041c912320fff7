"""The demo: its plan, its verdict, and a complete run over EGM."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab import robots
from armlab.cli import main
from armlab.cli.demo import PRESSES, UNIT, Plan, demo, force_unit, judge, rehearse
from armlab.errors import ControllerLate, LinkError, LogError, RobotError, UnknownName
from armlab.log import Table
from armlab.robots import inertia

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import any_arm


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
    _, qd, _ = plan.test.sample(np.linspace(0, plan.free[1] - 3.0, 2000))
    assert np.all(np.abs(qd) <= 0.5 * robots.load("yumi_right").qd_max)


@pytest.mark.parametrize("error", [ControllerLate, LinkError])
def test_a_busy_computer_is_told_of_the_fast_demo(
    error: type[Exception], tmp_path, command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(*_: object) -> None:
        raise error("The controller was too slow.")

    monkeypatch.setattr("armlab.cli.demo.rehearse", late)
    said = command(["demo", "-o", tmp_path / "demo"], 1).err
    assert "too slow" in said
    assert "armlab demo --fast" in said


@pytest.mark.slow
def test_the_demo_meets_its_bars_and_leaves_its_files(tmp_path, command, capsys) -> None:
    assert demo(fast=True, output=tmp_path / "demo") == 0
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    texts = {"identify.txt", "model.toml", "press.csv", "summary.json"}
    assert names == texts | {"excite.mcap", "press.mcap", "torque.png", "wrench.png"}
    assert json.loads((tmp_path / "demo" / "summary.json").read_text())["passed"]
    said = capsys.readouterr().out
    assert "every target is met" in said
    assert "p50" in said
    log, model = str(tmp_path / "demo" / "press.mcap"), str(tmp_path / "again.toml")
    assert main(["identify", "yumi_right", str(tmp_path / "demo" / "excite.mcap"), "-o", model]) == 0
    assert main(["log", "show", log]) == 0
    capsys.readouterr()
    assert command(["estimate", "yumi_right", log, "--model", model]).out.count("contact") >= len(PRESSES) - 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_other_seeds_meet_the_bars(tmp_path, seed: int) -> None:
    """Together with seed 0 above: three seeds, both arms, over EGM in lockstep, causal, at 248 Hz."""
    outcome = rehearse("yumi_left" if seed % 2 else "yumi_right", seed, tmp_path / "demo", fast=True)
    verdict = judge(outcome["estimate"], outcome["plan"])
    assert verdict.passed, verdict.missed


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), list(zip(any_arm.ARMS, range(1, 1 + len(any_arm.ARMS)))))
@pytest.mark.filterwarnings("ignore:The arm of .* omits")  # the fingers of a hand
def test_any_arm_with_masses_meets_its_scaled_bars(name: str, seed: int, tmp_path) -> None:
    """One seed per arm of `benchmarks/any_arm.py`, which runs five seeds."""
    try:
        found = any_arm.demo(name, seed, tmp_path)
    except (UnknownName, RobotError) as error:
        pytest.skip(f"needs the description of {name}: {error}")
    assert found["passed"], found["missed"]


def test_forces_and_bars_go_with_the_torque_limits(tmp_path) -> None:
    units = [force_unit(robots.load(f"yumi_{side}"))[0] / UNIT for side in ("left", "right")]
    assert units == pytest.approx([1, 1], 0.01)
    path = tmp_path / "scara.urdf"
    path.write_text(any_arm.SCARA)
    weak, strong = robots.load(path), tmp_path / "strong.urdf"
    strong.write_text(re.sub(r'effort="(\d+)"', lambda found: f'effort="{3 * int(found[1])}"', any_arm.SCARA))
    unit, seen = force_unit(weak)
    assert force_unit(robots.load(strong))[0] == pytest.approx(3 * unit, rel=1e-6)
    assert seen.all()
    plan = Plan.make(weak, 0)
    assert plan.scale == pytest.approx(unit / UNIT, rel=0.05)
    np.testing.assert_allclose(max(abs(force) for _, _, force, *_ in plan.presses), 5.0 * plan.scale)
    q = plan.test.sample(np.linspace(0, plan.test.seconds, 500))[0]
    assert np.all((q > weak.q_min) & (q < weak.q_max))


def test_directions_that_no_torque_tells_are_neither_pressed_nor_judged() -> None:
    pi = inertia.from_body([2.0, 1.0], [[0.2, 0, 0], [0.1, 0, 0]], 0.01 * np.eye(3))
    limits = {"q_min": [-2, -2], "q_max": [2, 2], "qd_max": [2, 2], "q_home": [0.3, 0.9], "tau_max": [20, 10]}
    flat = robots.from_dh("flat", [0.0, 0.0], [0.4, 0.3], [0.0, 0.0], inertias=pi, **limits)
    plan = Plan.make(flat, 0)
    assert plan.seen == (True, True, False)
    assert {axis for _, axis, *_ in plan.presses} == {0, 1}
    blind = judge(pretend(plan, noise(plan, 0.1)), plan)
    assert not any(" z " in missed for missed in blind.missed)


def pretend(plan: Plan, error: np.ndarray, sigma: float = 0.5) -> Table:
    """Return a run whose estimate is the truth plus `error` (N, 6)."""
    t = np.arange(0, 3.0 + plan.test.seconds, 0.004)
    wrench = plan.wrench(t) + error if error.ndim else plan.wrench(t) + error * np.ones((len(t), 6))
    cov = np.tile(sigma**2 * np.eye(6), (len(t), 1, 1))
    columns = {"wrench_hat": wrench, "wrench_hat_cov": cov, "observability": np.ones((len(t), 6))}
    return Table(t, columns).with_column("session_t", t)


def noise(plan: Plan, sd: float) -> np.ndarray:
    N = len(np.arange(0, 3.0 + plan.test.seconds, 0.004))
    return sd * np.clip(np.random.default_rng(0).standard_normal((N, 6)), -2.5, 2.5)


def test_a_good_estimate_passes_and_its_text_says_so(plan: Plan) -> None:
    table = pretend(plan, noise(plan, 0.5))
    verdict = judge(table, plan)
    assert len(verdict.missed) == 1
    assert "at rest" in verdict.missed[0]
    rest = (table["session_t"] > plan.rest[0])[:, None, None]
    wide = table.with_column("wrench_hat_cov", np.where(rest, 100 * np.eye(6), table["wrench_hat_cov"]))
    verdict = judge(wide, plan)
    assert verdict.passed
    assert 0.94 < verdict.coverage < 0.97
    assert "weight -z" in verdict.text()


@pytest.mark.parametrize(
    ("error", "sigma", "words"),
    [(2.0, 2.0, "force error x"), (0.0, 0.5, "coverage 100.0 %"), (1.0, 0.4, "weight"), (2.0, 2.0, "false force")],
)
def test_each_bar_can_be_missed(plan: Plan, error: float, sigma: float, words: str) -> None:
    verdict = judge(pretend(plan, np.array(error), sigma), plan)
    assert any(words in missed for missed in verdict.missed)


def test_what_has_no_estimate_misses_the_bar_when_it_is_too_much(plan: Plan) -> None:
    table = pretend(plan, noise(plan, 0.5))

    def without(every: int) -> Table:
        holed = np.array(table["wrench_hat"])
        holed[::every] = np.nan
        return table.with_column("wrench_hat", holed)

    blind = table.with_column("observability", 0.5 * np.ones((len(table), 6)))
    assert any("force error x nan" in missed for missed in judge(blind, plan).missed), "there is no error to judge"
    for part in (table.between(0.0, plan.presses[-1][3]), table.rows(slice(0, 0))):
        with pytest.raises(LogError, match="with all presses"):
            judge(part, plan)
    few = judge(without(200), plan)
    assert few.holes == pytest.approx(0.005, abs=1e-3)
    assert all(np.isfinite(press["error"]) for press in few.presses)
    assert not any("without an estimate" in missed for missed in few.missed)
    assert any("without an estimate" in missed for missed in judge(without(20), plan).missed)

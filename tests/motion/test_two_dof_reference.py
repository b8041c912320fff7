"""Two-degree-of-freedom control against the reference numbers of the ancestor's README and of the paper."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.motion import Dmp
from armlab.motion.disturbances import Displace, Hold, Push
from armlab.motion.two_dof import TwoDofDmp

PATH = Path(__file__).parents[3] / "shared" / "data" / "dmp_reference.json"
Build = Callable[..., Dmp]
H = 0.004
KEYS = {"yc": "yc", "yc_dot": "ycd", "ya": "ya", "ya_dot": "yad", "e": "e", "x": "x"}
TABLE = [  # section 6 of the specification: t, free yc1, yc1, ya1, e1, x
    (2.5, 0.738096, 0.738096, 0.738096, 0.0, 0.472367),
    (4, 1.199431, 0.795673, 0.738096, -0.055895, 0.446330),
    (5, 1.512554, 0.842864, 0.840485, -0.007294, 0.426121),
    (6, 1.792184, 1.128821, 1.128791, -0.000163, 0.322576),
    (10, 1.999813, 1.985984, 1.985984, 0.0, 0.097159),
]


def reference() -> dict[str, Any]:
    """The reference numbers; skips the test where there are none."""
    if not PATH.exists():
        pytest.skip("needs ../shared/data/dmp_reference.json: numbers of an independent implementation")
    return json.loads(PATH.read_text(encoding="utf-8"))


def readme_dmp(plain: Build, data: dict[str, Any], dofs: tuple[int, ...] = (0, 1)) -> Dmp:
    """The primitive with the weights of the reference, of one or both coordinates."""
    fit, which = data["readme_fit"], list(dofs)
    g = np.array([2.0, 1.0])[which]
    weights = np.array(fit["w_lwr_dof1"])[:, None] * g
    return plain(weights, fit["centers"], np.full(15, np.sqrt(fit["sigma2"])), 10.0, np.zeros(len(which)), g)


def test_the_experiment_of_the_specification(plain: Build) -> None:
    run = TwoDofDmp(readme_dmp(plain, reference())).simulate([0, *(row[0] for row in TABLE)], [Hold(2.5, 4)])
    found = np.column_stack([run.t, run.free.y[:, 0], run.yc[:, 0], run.ya[:, 0], run.e[:, 0], run.x])[1:]
    np.testing.assert_allclose(found, TABLE, atol=5.1e-7)


@pytest.mark.parametrize("dofs", [None, (0,)], ids=["both", "dof1"])
def test_coupled_runs_of_the_reference(dofs: tuple[int, ...] | None, plain: Build) -> None:
    data = reference()
    want = data["readme_2dof"][f"coupled_{'both_dofs' if dofs is None else 'only_dof1'}_stopped"]
    run = TwoDofDmp(readme_dmp(plain, data)).simulate(data["readme_2dof"]["t"], [Hold(2.5, 4, dofs)])
    for i in (1, 2):
        columns = {f"yc{i}": run.yc, f"ya{i}": run.ya, f"e{i}": run.e}
        for name, found in columns.items():
            np.testing.assert_allclose(found[:, i - 1], want[name], rtol=0, atol=1e-8, err_msg=name)
        np.testing.assert_allclose((run.tau_a[:, None] * run.ycd)[:, i - 1], want[f"z{i}"], atol=1e-8)
    np.testing.assert_allclose(run.x, want["x"], rtol=0, atol=1e-8)


@pytest.mark.parametrize("dof", [0, 1])
def test_each_coordinate_alone_is_that_of_the_ancestor(dof: int, plain: Build) -> None:
    """Its own e, x and tau_a: undisturbed, and held with the velocity at 0."""
    data = reference()
    rows, alone = data["readme_2dof"], TwoDofDmp(readme_dmp(plain, data, (dof,)))
    held = alone.simulate(rows["t"], [Hold(2.5, 4)])
    want = rows["physical_stop_continuous_limit"][f"dof{dof + 1}"]
    cases = [(held, want), (alone.simulate(rows["t"]), rows["unperturbed"])][: 2 - dof]
    for run, numbers in cases:
        for key, name in KEYS.items():
            found, expected = getattr(run, name).reshape(len(run.t)), np.array(numbers[key])
            before = np.isin(run.t, [4.0]) & (key == "ya_dot")  # the reference lists 0 while held, and so do we
            np.testing.assert_allclose(found[~before], expected[~before], rtol=0, atol=1e-8, err_msg=key)


@pytest.mark.parametrize("event", ["stop", "push"])
def test_simulation_of_the_paper(event: str, plain: Build) -> None:
    data = reference()["ifac2017_simulation"]
    g, want = data["g"], data["continuous_limit"]
    weights, widths = np.array(data["w"])[:, None] * g, np.array(data["precision"]) ** -0.5
    dmp = plain(weights, data["centers"], widths, 4.2, np.zeros(1), np.array([g]))
    happens = Hold(2, 3) if event == "stop" else Push(2, 3, 0.15)
    run = TwoDofDmp(dmp).simulate([0, *want["t"]], [happens], dt=0.002)
    known = slice(11)  # at the last time all kernels have faded below 1e-10, which the reference adds to their sum
    for key, name in (("yc", "yc"), ("ya", "ya"), ("ya_dot", "yad"), ("e", "e")):
        found = getattr(run, name)[1:, 0]
        np.testing.assert_allclose(found[known], want[event][key][known], rtol=0, atol=1e-8, err_msg=key)
    np.testing.assert_allclose(run.x[1:][known], want[event]["x"][known], rtol=0, atol=1e-8)


@pytest.mark.parametrize("p", [0.0, 0.05, 0.2, 0.5, -0.5, 1.0, -1.0, 2.0])
def test_errors_at_250_hz_after_a_blow(p: float, plain: Build) -> None:
    """At 2.5 s ya jumps by p, then it is held to 4 s; p = 0 is undisturbed."""
    data = reference()
    alone, t = TwoDofDmp(readme_dmp(plain, data, (0,))), H * np.arange(2501)
    events = [Displace(2.5, p), Hold(2.5, 4)] if p else []
    coarse, fine = (alone.simulate(t, events, dt=H / k) for k in (1, 16))
    for method in ("rk4", "heun"):
        want = data["z_form_250Hz_expected_errors"][f"p={p} z-{method} h=0.004"]
        for name in ("yc", "ya", "x"):
            error = np.abs(getattr(coarse, name) - getattr(fine, name)).max()
            assert error <= 1.5 * want[f"err_{name}"], (method, name)


def test_errors_of_the_loop_at_250_hz(plain: Build) -> None:
    """The robot integrates the acceleration that it was given last; held from 2.5 to 4 s."""
    data = reference()
    alone = TwoDofDmp(readme_dmp(plain, data, (0,)))
    exact = alone.simulate(H * np.arange(2501), [Hold(2.5, 4)], dt=H / 16)
    stepper, ya, yad, worst = alone.stepper(v0=[0.0]), np.zeros(1), np.zeros(1), np.zeros(2)
    for k in range(2501):
        held = 625 <= k < 1000
        yad = np.zeros(1) if held else yad
        found = stepper.step(H if k else 0.0, ya, yad)
        worst = np.maximum(worst, np.abs([found.yc - exact.yc[k], ya - exact.ya[k]]).max(axis=1))
        if not held:
            ya, yad = ya + H * yad + 0.5 * H**2 * found.ydd_ref, yad + H * found.ydd_ref
    want = data["online_250Hz_errors_physical_stop"]
    for method in ("rk4 extrap=1", "heun extrap=1"):
        assert (worst <= 1.1 * np.array(want[method])).all()
    assert (worst <= 4e-4).all()

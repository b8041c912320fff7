"""The ancestor's two degrees of freedom, each with its own e, x and tau_a: here only, to hold its published numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PATH = Path(__file__).parents[3] / "shared" / "data" / "dmp_reference.json"
KP, KV, KC, ALPHA_E, ALPHA_Z, BETA_Z = 25.0, 10.0, 1e4, 5.0, 25.0, 6.25
TAU, STEP = 10 / 3, 10 / 1509
HELD = (2.5, 4.0)


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    if not PATH.exists():
        pytest.skip("needs ../shared/data/dmp_reference.json: numbers of an independent implementation")
    return json.loads(PATH.read_text(encoding="utf-8"))


def slopes(fit: dict[str, Any], g: float, state: np.ndarray) -> np.ndarray:
    """Derivative of [yc, yc', ya, ya', e, x], the ancestor's stiff form."""
    yc, v, ya, va, e, x = state
    psi = np.exp(-((x - np.array(fit["centers"])) ** 2) / (2 * fit["sigma2"]))
    f = psi @ fit["w_lwr_dof1"] / psi.sum() * x * g
    tau_a, ed = TAU * (1 + KC * e**2), ALPHA_E * (ya - yc - e)
    zd = (ALPHA_Z * (BETA_Z * (g - yc) - tau_a * v) + f) / tau_a
    a = (zd - v * 2 * TAU * KC * e * ed) / tau_a
    return np.array([v, a, va, KP * (yc - ya) + KV * (v - va) + a, ed, -x / tau_a])


@pytest.mark.parametrize("kind", ["seed_callback", "physical_stop"])
def test_sequences_of_euler(data: dict[str, Any], kind: str) -> None:
    """After every step that lands in the hold ya is put back; the physical stop sets ya' to 0 too."""
    want = data["readme_2dof"][f"{kind}_explicit_euler_h=10/1509"]
    state, rows = np.array([0.0, 0, 0, 0, 0, 1]), []
    for k in range(1510):
        if k in want["index"]:
            rows.append(state)
        before, state = state, state + STEP * slopes(data["readme_fit"], 2.0, state)
        if HELD[0] <= (k + 1) * STEP < HELD[1]:
            state[2] = before[2]
            if kind == "physical_stop":
                state[3] = 0.0
    for i, name in enumerate(("yc", "yc_dot", "ya", "ya_dot", "e", "x")):
        np.testing.assert_allclose(np.array(rows)[:, i], want[name], rtol=0, atol=1e-11, err_msg=name)


@pytest.mark.parametrize("dof", [1, 2])
def test_continuous_limit_of_the_callback(data: dict[str, Any], dof: int) -> None:
    """ya is held while ya' goes on integrating: the arm jumps off at 0.16 when it is let go."""
    from scipy.integrate import solve_ivp

    rows = data["readme_2dof"]
    want, t, fit = rows["seed_callback_continuous_limit"][f"dof{dof}"], np.array(rows["t"]), data["readme_fit"]

    def held(_: float, state: np.ndarray) -> np.ndarray:
        return slopes(fit, 2.0 / dof, state) * [1, 1, 0, 1, 1, 1]

    def free(_: float, state: np.ndarray) -> np.ndarray:
        return slopes(fit, 2.0 / dof, state)

    found, state = np.empty((len(t), 6)), np.array([0.0, 0, 0, 0, 0, 1])
    for a, b, law in ((0.0, 2.5, free), (2.5, 4.0, held), (4.0, 10.0, free)):
        inside = (t > a) & (t <= b)
        run = solve_ivp(law, (a, b), state, "LSODA", t[inside], rtol=1e-10, atol=1e-12)
        found[inside], state = run.y.T, run.y[:, -1]
    found[0] = [0, 0, 0, 0, 0, 1]
    for i, name in enumerate(("yc", "yc_dot", "ya", "ya_dot", "e", "x")):
        np.testing.assert_allclose(found[:, i], want[name], rtol=0, atol=1e-8, err_msg=name)


class Paper:
    """The simulation in the authors' example: explicit Euler at 250 Hz in the order z, yc, x, ya', ya, e."""

    tau, dt, samples = 1.4, 1 / 250, 2100

    def __init__(self, numbers: dict[str, Any]) -> None:
        self.w, self.c, self.D = (np.array(numbers[name]) for name in ("w", "centers", "precision"))
        self.g = numbers["g"]

    def force(self, x: float) -> float:
        psi = np.exp(-self.D * (x - self.c) ** 2 / 2)
        return psi @ self.w / (psi.sum() + 1e-10) * x * self.g

    def alone(self) -> tuple[np.ndarray, float, float]:
        """Positions, and velocity and acceleration that are left over at the end."""
        y = z = yd = ydd = 0.0
        x, path = 1.0, [0.0]
        for _ in range(self.samples - 1):
            zd = (ALPHA_Z * (BETA_Z * (self.g - y) - z) + self.force(x)) / self.tau
            z += zd * self.dt
            yd, ydd = z / self.tau, zd / self.tau
            y += yd * self.dt
            x -= x / self.tau * self.dt
            path.append(y)
        return np.array(path), yd, ydd

    def coupled(self, moved: float, z: float, ycd: float, ycdd: float) -> tuple[np.ndarray, float]:
        """Rows yc, ya, e of each sample, and the last z; between samples 500 and 750 ya' is `moved`."""
        yc = ya = yad = e = 0.0
        x, rows = 1.0, [(0.0, 0.0, 0.0)]
        for k in range(1, self.samples):
            acceleration = KP * (yc - ya) + KV * (ycd - yad) + ycdd
            tau_a, ed = self.tau * (1 + KC * e**2), ALPHA_E * (ya - yc - e)
            zd = (ALPHA_Z * (BETA_Z * (self.g - yc) - z) + self.force(x)) / tau_a
            z += zd * self.dt
            ycd = z / tau_a
            ycdd = (zd * tau_a - 2 * self.tau * KC * z * e * ed) / tau_a**2
            yc += ycd * self.dt
            x -= x / tau_a * self.dt
            yad = moved if 500 < k + 1 < 750 else yad + acceleration * self.dt
            ya += yad * self.dt
            e += ALPHA_E * (ya - yc - e) * self.dt
            rows.append((yc, ya, e))
        return np.array(rows), z


def test_discrete_runs_of_the_paper(data: dict[str, Any]) -> None:
    """With its quirks: the runs start with velocity, acceleration and z that are left over from the runs before."""
    want = data["ifac2017_simulation"]
    paper, at = Paper(want), np.array(want["index_1based"]) - 1
    path, yd, ydd = paper.alone()
    stop, z = paper.coupled(0.0, 0.0, yd, ydd)
    push, _ = paper.coupled(0.15, z, 0.0, 0.0)
    np.testing.assert_allclose(path[at], want["y_unperturbed"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(stop[at].T, [want[f"stop_{name}"] for name in ("yc", "ya", "e")], rtol=0, atol=1e-9)
    np.testing.assert_allclose(push[at, :2].T, [want["push_yc"], want["push_ya"]], rtol=0, atol=1e-9)

"""Place, time and size of a contact: hypotheses, contact intervals, comparison with measurements."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import lfilter

from armlab import identify, robots
from armlab.contact import Estimator, compare, contacts, hypotheses
from armlab.contact.contacts import Comparison, Contact, Hypotheses
from armlab.estimation.robust import correlation_time
from armlab.log import Column, Table

ROBOT = robots.load("yumi_left")
SD = 0.01 * np.array([40.0, 40, 25, 25, 10, 10, 5])  # of the torque error [N m]
PRIOR = np.array([20.0, 20, 20, 2, 2, 2])
STEP, MEMORY, ROWS = 0.004, 0.1, 250
LINE = np.array([[0.0, 0, 0], [0, 0, 0.06], [0, 0.04, 0.06]])  # 100 mm along two sides


@dataclass(frozen=True)
class Pushes:
    table: Table
    places: np.ndarray

    def windows(self, found: Hypotheses) -> np.ndarray:
        """Indices of the windows that contain one push each."""
        return np.arange(len(self.places)) * 2


def at_link(q: np.ndarray, link: int, x: np.ndarray) -> np.ndarray:
    """Jacobian (3, 7) of a point x on a link, in base axes."""
    J, tool = ROBOT.chain.jacobian(q), ROBOT.chain.forward(q)[:3, 3]
    return (J[:3] + np.cross(J[3:].T, x - tool).T) * (np.arange(7) < link)


def pushes(kind: str, trials: int, seed: int, memory: float = MEMORY) -> Pushes:
    """One-second pushes at random poses: 5 to 15 standard deviations of the full wrench estimate, at most twice the
    prior's 20 N, in a well-observed direction; the error has a correlation time of `memory`."""
    rng = np.random.default_rng(seed)
    fade = np.exp(-STEP / memory)
    q, error, places = np.empty((trials, ROWS, 7)), np.empty((trials, ROWS, 7)), np.zeros(trials)
    for k in range(trials):
        pose = rng.uniform(np.maximum(ROBOT.q_min, -2), np.minimum(ROBOT.q_max, 2))
        T_base_tool, J = ROBOT.chain.forward(pose), ROBOT.chain.jacobian(pose)
        P = np.linalg.inv(J @ np.diag(1 / SD**2) @ J.T + np.diag(1 / PRIOR**2))[:3, :3]
        directions = rng.standard_normal((200, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sigma = np.sqrt(np.einsum("ki,ij,kj->k", directions, P, directions))
        chosen = int(np.argmax(sigma < np.sqrt(0.1) * 20.0))  # observability 0.9; otherwise the first direction
        force = rng.uniform(5, min(15, 40 / sigma[chosen])) * sigma[chosen] * directions[chosen]
        places[k] = rng.uniform(0, 0.1) if kind == "segment" else 0.0
        at = T_base_tool[:3, 3] + T_base_tool[:3, :3] @ [0, max(places[k] - 0.06, 0), min(places[k], 0.06)]
        if kind == "link":
            origins = ROBOT.chain.link_transforms(pose)[3:5, :3, 3]
            at = origins[0] + rng.uniform() * (origins[1] - origins[0])
        torque = at_link(pose, 4 if kind == "link" else 7, at).T @ force * (kind != "none")
        noise = lfilter([np.sqrt(1 - fade**2)], [1, -fade], rng.standard_normal((2 * ROWS, 7)), axis=0)[ROWS:]
        q[k], error[k] = pose, torque + SD * noise
    N = trials * ROWS
    values = {
        "q": q.reshape(N, 7),
        "qd": np.ones((N, 7)),
        "tau_error": error.reshape(N, 7),
        "tau_variance": np.tile(SD**2, (N, 1)),
    }
    units = {"tau_error": Column(unit="N m"), "tau_variance": Column(unit="N^2 m^2")}
    return Pushes(Table(STEP * np.arange(N), values, units), places)


def decisions(made: Pushes, **options) -> tuple[list[str], np.ndarray, Hypotheses]:
    found = hypotheses(made.table, ROBOT, memory=MEMORY, **options)
    rows = made.windows(found)
    return [found.decision[i] for i in rows], found.link[rows], found


@pytest.mark.slow  # 5 s beside other work
def test_clear_pushes_are_taken_for_what_they_are() -> None:
    """Correct for 94 % at the known point and 97 % on the segment; the rest look like a push on link 4 through the
    wrist axes and are mostly undecided."""
    at_point, _, point = decisions(pushes("point", 400, seed=11))
    made = pushes("segment", 400, seed=12)
    on_segment, _, segment = decisions(made, segment=LINE)
    right = [name == "point" for name in at_point], [name == "segment" for name in on_segment]
    assert np.mean(right) >= 0.95
    assert np.mean(right, axis=1).min() >= 0.93
    assert np.mean([name not in ("point", "undecided") for name in at_point]) < 0.03
    assert point.names == ("none", "point", "wrench", *(f"link {k}" for k in range(1, 7)))
    np.testing.assert_allclose(point.posterior.sum(axis=1), 1.0)
    np.testing.assert_allclose(point.samples, 5.0)
    assert np.isnan(point.place).all()
    error = np.abs(segment.place[made.windows(segment)] - made.places)
    assert np.median(error) < 0.01
    assert np.all((segment.place >= 0) & (segment.place <= 0.1 + 1e-12))


@pytest.mark.parametrize("segment", [None, LINE])
def test_a_push_on_a_link_is_never_reported_as_one_on_the_tool_without_a_flag(segment) -> None:
    names, flags, found = decisions(pushes("link", 100, seed=3), segment=segment)
    tool = np.isin(names, ["point", "segment", "wrench"])
    assert not np.any(tool & ~flags)
    assert np.mean([name.startswith("link") for name in names]) > 0.6
    assert "link 4" in found.text()


@pytest.mark.parametrize("memory", [0.025, 0.2])
def test_the_default_memory_makes_no_false_decision_where_the_error_remembers_less_or_more(memory: float) -> None:
    """No false contact, no link push attributed to the tool without its flag, few tool pushes misclassified."""
    found = {kind: hypotheses(made.table, ROBOT) for kind in ("none", "point", "link")
             if (made := pushes(kind, 60, 4, memory))}  # fmt: skip
    names = {kind: [one.decision[i] for i in range(0, 120, 2)] for kind, one in found.items()}
    assert all(name in ("none", "undecided") for name in names["none"])
    assert np.mean([name not in ("point", "undecided") for name in names["point"]]) <= 0.05
    assert not np.any(np.isin(names["link"], ["point", "wrench"]) & ~found["link"].link[:120:2])


def test_the_default_memory_is_above_that_of_an_identified_arm(truth, model) -> None:
    motion = identify.design_excitation(truth.robot, seconds=20, f0=0.07, harmonics=6, speed=0.4, seed=2)
    table = Estimator(model, truth.robot).run(truth.log(motion, seed=2)).between(1.0, 20.0)
    white = table["tau_error"] / np.sqrt(table["tau_variance"])
    assert max(correlation_time(column, STEP) for column in white.T) < 0.1


def test_no_contact() -> None:
    names, flags, _ = decisions(pushes("none", 100, seed=4))
    assert np.mean([name == "none" for name in names]) > 0.9
    assert not np.any(flags & np.isin(names, ["none"]))
    quiet = hypotheses(pushes("none", 4, seed=4).table, ROBOT, memory=MEMORY)
    assert quiet.text() == "no contact in any window"
    assert re.match(r"none \d+ %", quiet.during(0.0, 1.0))


def test_evidence_is_the_density_of_the_torque_error() -> None:
    """One row, one sample: log N(tau_e; 0, J^T C J + C_tau) as computed by SciPy."""
    from scipy.stats import multivariate_normal

    table = pushes("point", 1, seed=5).table.rows(slice(0, 2))
    found = hypotheses(table, ROBOT, window=STEP, memory=1.0)
    q, e = table["q"][0], table["tau_error"][0]
    J = ROBOT.chain.jacobian(q)
    expected = [
        multivariate_normal.logpdf(e, cov=np.diag(SD**2)),
        multivariate_normal.logpdf(e, cov=400.0 * J[:3].T @ J[:3] + np.diag(SD**2)),
        multivariate_normal.logpdf(e, cov=J.T @ np.diag(PRIOR**2) @ J + np.diag(SD**2)),
    ]
    constant = 3.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(found.log_evidence[0, :3] - constant, expected, rtol=1e-9)


def test_an_estimated_log(truth, perfect) -> None:
    """From the estimator's own table: a press at the tool point is found, and no contact before it."""
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.3, seed=4)
    force = np.array([0.0, 12.0, -12.0, 0, 0, 0])
    log = truth.log(motion, seed=1, wrench=lambda t: np.outer((t > 6) & (t < 8), force))
    found = hypotheses(Estimator(perfect, truth.robot).run(log), truth.robot)
    assert re.match(r"point \d+ %( \(wrench|$|;)", found.during(6.0, 8.0))
    assert found.during(3.0, 5.0).startswith("none")
    assert "point" in found.text()


# Contact intervals and comparison.


def estimate(force: np.ndarray) -> Table:
    N = len(force)
    wrench = np.column_stack([force, np.zeros((N, 5))])
    return Table(np.arange(N) * 0.004, {"wrench_hat": wrench, "wrench_hat_cov": np.tile(np.eye(6), (N, 1, 1))})


def test_contacts_are_found_merged_and_short_ones_left_out() -> None:
    force = np.random.default_rng(0).standard_normal(2000) * 0.5
    force[500:800] = 5.0
    force[600:610] = 0.0  # a hole of 40 ms
    force[1000:1020] = 5.0  # 80 ms: too short
    force[1500] = np.nan
    (found,) = contacts(estimate(force))
    assert isinstance(found, Contact)
    assert found.start == pytest.approx(2.0)
    assert found.end == pytest.approx(799 * 0.004)
    assert found.force[0] == pytest.approx(5.0 * 290 / 300, rel=1e-6)
    assert found.band == pytest.approx(2.0)


def test_short_presses_and_weak_ones_are_found_where_they_begin() -> None:
    rng, press = np.random.default_rng(1), np.zeros(5000)
    press[1000:1020] = 9.0  # 80 ms
    press[3000:3250] = 3.5  # 1 s, barely above the 95 % limit of a row
    found = contacts(estimate(press + lfilter([0.4], [1.0, -0.917], rng.standard_normal(5000))))
    assert [one.start for one in found] == pytest.approx([4.0, 12.0], abs=0.1)
    assert [one.end for one in found] == pytest.approx([4.08, 13.0], abs=0.1)


@pytest.mark.parametrize("memory", [0.004, 0.05, 0.1])
def test_less_than_one_false_alarm_in_ten_minutes(memory: float) -> None:
    """An hour of errors with a standard deviation of 1, correlated over `memory`."""
    keep = np.exp(-2.0 * 0.004 / memory)
    white = np.random.default_rng(7).standard_normal((900_000, 3))
    force = lfilter([np.sqrt(1.0 - keep * keep)], [1.0, -keep], white, axis=0)
    cov = np.broadcast_to(np.eye(6), (len(force), 6, 6))
    wrench = np.concatenate([force, np.zeros_like(force)], axis=1)
    assert len(contacts(Table(np.arange(len(force)) * 0.004, {"wrench_hat": wrench, "wrench_hat_cov": cov}))) <= 6


def test_nothing_touches() -> None:
    assert contacts(estimate(np.zeros(500))) == []
    assert contacts(estimate(np.full(500, np.nan))) == []


def test_a_chain_of_short_excursions_is_no_contact() -> None:
    """Output of a slow filter without contact: 20 ms outside and 60 ms inside the band, repeatedly."""
    force = np.zeros(1000)
    for start in range(300, 600, 20):
        force[start : start + 5] = 5.0
    assert contacts(estimate(force)) == []


N = 5000


@pytest.fixture
def table() -> Table:
    rng = np.random.default_rng(1)
    sigma = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    true = rng.normal(size=(N, 6))
    hat = true + sigma * rng.normal(size=(N, 6))
    hat[:7] = np.nan
    cov = np.broadcast_to(np.diag(sigma**2), (N, 6, 6))
    return Table(np.arange(N) * 0.004, {"wrench_hat": hat, "wrench_hat_cov": cov, "wrench_true": true, "wrench": hat})


def test_errors_are_those_against_the_truth_where_there_is_one(table: Table) -> None:
    found = compare(table)
    assert isinstance(found, Comparison)
    error = (table["wrench_hat"] - table["wrench_true"])[7:]
    assert found.rows == N - 7
    assert found.rms == pytest.approx(np.sqrt(np.mean(error**2, axis=0)))
    assert found.inside == pytest.approx(0.954, abs=0.015)
    rms = " ".join(f"{value:.2f}" for value in found.rms[:3])
    assert found.text() == f"force x y z against the true wrench: {rms} N RMS, 95 % within 2 sigma"
    assert not found.rms.flags.writeable


def test_else_against_the_sensor(table: Table) -> None:
    found = compare(table.without("wrench_true"))
    assert found.against == "the force sensor"
    assert not found.rms.any()

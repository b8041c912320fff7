"""Targets of the specification on public logs of two real arms: residual on held-out blocks in % of the torque SD.

The README beside the data describes the logs and their sources. Earlier and current results are in
docs/how_to/real_arm.md.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots, signals
from armlab.contact import Estimator, contacts
from armlab.dynamics import base_parameters
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Rows, least_squares
from armlab.identify import extrapolation, fit_dynamics, predict, prepare, with_velocity
from armlab.identify.record import Record
from armlab.identify.regression import Design
from armlab.identify.solve import alternate, refined
from armlab.identify.validation import training
from armlab.lie import euler, se3
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.torque import Quality
from armlab.robots import Robot, couplings

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared/data/ident"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.exists(), reason="needs ../shared: public logs of a Staubli TX40 and of a TIAGo"),
]

TX40_RATE = 5000.0  # Hz
TX40_GEARS = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])  # q_motor = GEARS q
TX40_GEARS[5, 4] = 32.0
TX40_ZERO = np.array([0.0, -0.5 * np.pi, 0.5 * np.pi, 0.0, 0.0, 0.0])

TIAGO_JOINTS = (  # xyz [m], rpy [rad] of each joint in its parent
    ((-0.062, 0, 0.790), (0, 0, 0)),
    ((0.15505, 0.014, -0.151), (0, 0, -np.pi / 2)),
    ((0.125, 0.0195, -0.031), (np.pi / 2, 0, 0)),
    ((0.0895, 0, -0.0015), (-np.pi / 2, 0, np.pi / 2)),
    ((-0.02, -0.027, -0.222), (-np.pi / 2, -np.pi / 2, 0)),
    ((-0.162, 0.02, 0.027), (np.pi / 2, -np.pi / 2, -np.pi / 2)),
    ((0, 0, 0.15), (0, -np.pi / 2, -np.pi / 2)),
    ((0, 0, 0), (np.pi / 2, 0, np.pi / 2)),
)
TIAGO_GEARS = np.array([1.0, 100, 100, 100, 100, 336, 336, 336])
TIAGO_CONSTANTS = np.array([1.0, 0.136, 0.136, -0.087, -0.087, -0.0613, -0.0613, -0.0613])  # N m/A
TIAGO_ROWS = slice(921, 6791)


def read_tx40() -> tuple[Robot, Table, np.ndarray]:
    """Return the arm, its log at 5 kHz with q and tau on the joint side, and the torques (N, 6) of the motors."""
    folder = DATA / "staubli_tx40"
    robot = replace(robots.load(folder / "tx40_mdh_modified.urdf"), coupling=np.linalg.inv(TX40_GEARS))
    motors = log.read_csv(folder / "pos_read_data.csv.gz", rate=TX40_RATE)
    currents = log.read_csv(folder / "curr_data.csv.gz", rate=TX40_RATE).matching("Joint_")
    q = couplings.motor_to_joint(robot, motors.matching("Joint_")) + TX40_ZERO
    tau = couplings.motor_torque_to_joint(robot, currents)
    return robot, Table(motors.t, {"q": q, "tau": tau}), currents


def tx40_protocol(table: Table, stop: float) -> Table:
    """Return 0.1 s to `stop`, low-passed at 50 Hz with central differences; every 50th row is for the fit."""
    q, tau = (signals.lowpass_offline(table[name], TX40_RATE, 50.0) for name in ("q", "tau"))
    whole = Table(table.t, {"q": q, "qd": signals.central_diff(q, table.t), "tau": tau})
    return whole.between(0.1 - 1e-9, stop - 1e-9)


def read_tiago() -> tuple[Robot, Table]:
    """Return lift and arm, and the log at 100 Hz: rows 921 to 6790, torque from motor current."""
    links = [se3.from_rp(euler.from_rpy(rpy[::-1], "zyx"), np.array(xyz, dtype=float)) for xyz, rpy in TIAGO_JOINTS]
    sliding = [True] + [False] * 7
    names = ["torso_lift", *(f"arm_{k}" for k in range(1, 8))]
    gravity = (0.0, 0.0, -9.81)
    robot = robots.from_links("tiago", [*links, np.eye(4)], sliding, gravity=gravity, joint_names=names)
    files = [log.read_csv(DATA / f"tiago/tiago_{what}.csv.gz") for what in ("position", "velocity", "effort")]
    values = (np.hstack([file.matching("torso"), file.matching("arm")]) for file in files)
    q, qd, current = (array[TIAGO_ROWS] for array in values)
    return robot, Table(files[0].t[TIAGO_ROWS], {"q": q, "qd": qd, "tau": TIAGO_GEARS * TIAGO_CONSTANTS * current})


def tiago_protocol(table: Table) -> Table:
    """Return the log low-passed at 2 Hz without 100 rows at either end; every fifth row is for the fit."""
    rate = 1.0 / float(np.median(np.diff(table.t)))
    smooth = {name: signals.lowpass_offline(table[name], rate, 2.0) for name in ("q", "qd", "tau")}
    return Table(table.t, smooth).rows(slice(100, -100))


def share(residual: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return the RMS residual of each joint in % of the standard deviation of its torque."""
    return 100.0 * np.sqrt(np.mean(residual**2, axis=0)) / np.std(tau, axis=0)


@pytest.fixture(scope="module")
def tx40() -> tuple[Robot, Table, np.ndarray]:
    return read_tx40()


@pytest.fixture(scope="module")
def tx40_model(tx40) -> TorqueModel:
    """The model that a user would fit to the raw log of the motion until 5.82 s, 65 % of the whole."""
    robot, table, _ = tx40
    return fit_dynamics(table.between(0.1, 5.82), robot).value


@pytest.fixture(scope="module")
def tiago() -> tuple[Robot, Table]:
    return read_tiago()


def held_out(data: Record, robot: Robot, test: np.ndarray, every: int, method: str, joints=None) -> np.ndarray:
    """Fit to the kept rows outside `test` and return the residual share of each joint on those inside."""
    design = Design.build(data, robot, base_parameters(robot, joints=joints), cutoff=np.inf, every=every, joints=joints)
    design, theta = refined(*alternate(design, method, use=~test), method)
    return share(design.residuals(theta)[test], design.tau[test])


@pytest.mark.parametrize(
    ("stop", "bars"), [(8.9, [8, 9, 14, 11, 14, 13]), (7.2, [7, 7, 13.5, 10.5, 13, 12])], ids=["whole", "moving"]
)
@pytest.mark.parametrize("method", ["irls", "wls"])
def test_tx40_on_held_out_blocks(tx40, stop: float, bars: list[float], method: str) -> None:
    """Alternating blocks of 0.5 s; takes 10 s per method."""
    robot, table, _ = tx40
    data = prepare(tx40_protocol(table, stop), robot)
    t = data.t[::50]
    assert len(t) == round(100 * (stop - 0.1))
    found = held_out(data, robot, np.floor(t / 0.5 + 1e-9) % 2 == 1, 50, method)
    print(f"TX40 to {stop} s, {method}:", found.round(1))
    assert np.all(found <= bars)


@pytest.mark.parametrize("method", ["irls", "wls"])
def test_tiago_on_held_out_blocks(tiago, method: str) -> None:
    """Alternating blocks of 40 samples, 2 s; the torque of arm_1 to arm_4 while all eight joints move."""
    robot, table = tiago
    arm = [1, 2, 3, 4]
    data = prepare(tiago_protocol(table), robot, arm)
    test = np.arange(len(data.t[::5])) // 40 % 2 == 1
    assert len(test) == 1130  # no velocity in the last five rows: it is 0.19 s late
    found = held_out(data, robot, test, 5, method, arm)
    print(f"TIAGo, {method}:", found.round(1))
    assert np.all(found <= [14, 18, 15.5, 12])


def read_ur3(log_name: str) -> tuple[Robot, Table]:
    """Return the arm and its log with the sign of torque as published, which opposes the motion."""
    rows = np.loadtxt(DATA.parent / "force/ur3_free" / log_name, delimiter=",", skiprows=1)
    table = Table(rows[:, 0], {"q": rows[:, 1:7], "qd": rows[:, 7:13], "tau": rows[:, 13:19]})
    turns, lengths = [0.5 * np.pi, 0, 0, 0.5 * np.pi, -0.5 * np.pi, 0], [0, -0.24365, -0.21325, 0, 0, 0]
    return robots.from_dh("ur3", turns, lengths, [0.1519, 0, 0, 0.11235, 0.08535, 0.0819]), table


@pytest.mark.parametrize("log_name", ["ur3_id1.csv", "ur3_id2.csv"])
def test_ur3_is_named_as_reversed(log_name: str) -> None:
    """As published, its motor torques oppose the motion; negated, no sign is doubted."""
    robot, table = read_ur3(log_name)
    with pytest.raises(ShapeError, match="joints 1, 2, 3, 4, 5, 6: the torque sign is probably reversed"):
        fit_dynamics(table, robot)
    fit = fit_dynamics(table.with_column("tau", -table["tau"]), robot)
    quality = fit.value.quality
    print(f"{log_name}:", share_of(quality), fit.notes, fit.doubts)
    assert not any("sign" in said for said in fit.doubts)
    assert np.all(share_of(quality)[:3] < 25)


@pytest.mark.parametrize(
    ("trained", "other", "alarms"), [("ur3_id1.csv", "ur3_id2.csv", 10), ("ur3_id2.csv", "ur3_id1.csv", 0)]
)
def test_ur3_in_another_free_motion(trained: str, other: str, alarms: int) -> None:
    """The specification asks for 90 % per axis and two contacts per minute. Trained on the slower log, observer and kf
    miss this on the other: friction there is 2 to 11 % smaller, and the torque of joint 5 jumps twice."""
    robot, table = read_ur3(trained)
    model = fit_dynamics(table.with_column("tau", -table["tau"]), robot).value
    _, table = read_ur3(other)
    for method, least in (("map", 0.9), ("observer", 0.87), ("kf", 0.83)):
        found = Estimator(model, robot, method).run(table.with_column("tau", -table["tau"])).between(1.0, table.t[-1])
        sigma = np.sqrt(np.einsum("kii->ki", found["wrench_hat_cov"])[:, :3])
        inside = np.mean(np.abs(found["wrench_hat"][:, :3]) < 2.0 * sigma, axis=0)
        print(f"{trained} to {other}, {method}:", inside.round(3), len(contacts(found)))
        assert np.all(inside > least)
        assert len(contacts(found)) <= alarms


def share_of(quality: Quality) -> np.ndarray:
    """Return the held-out residual in % of the torque SD."""
    return (100.0 * quality.rms_cv / quality.torque_sd).round(1)


def plain_regressor(robot: Robot, t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the 61 columns (N, 6, 61) of the earlier figures: sharp sign, no Stribeck, one wrist of three terms."""
    qdd, base, n = signals.central_diff(qd, t), base_parameters(robot), robot.n
    Y = np.zeros((len(t), n, 11 * n))
    Y[:, :, : 10 * n] = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity)
    Y[:, range(n), range(10 * n, 11 * n)] = qdd
    A = np.zeros((len(t), n, 40 + 3 * n + 3))
    A[:, :, :40] = Y[:, :, base.kept]
    for k, column in enumerate((qd, np.sign(qd), np.ones_like(qd))):
        A[:, range(n), range(40 + k, 40 + 3 * n, 3)] = column
    A[:, 4, 58], A[:, 5, 58], A[:, 4, 59], A[:, 5, 59] = qdd[:, 5], qdd[:, 4], qd[:, 5], qd[:, 4]
    A[:, 4, 60] = A[:, 5, 60] = np.sign(qd[:, 4] + qd[:, 5])
    return A, [f"x{k}" for k in range(61)]


def test_tx40_is_read_as_others_read_it(tx40) -> None:
    """Plain least squares in motion, split 65 % to 35 %: the earlier figures for this log, to the last digit."""
    robot, table, _ = tx40
    whole = tx40_protocol(table, 7.2)
    A, names = plain_regressor(robot, whole.t, whole["q"], whole["qd"])
    A, tau = A[::50], whole["tau"][::50]
    cut = int(0.65 * len(A))
    rows = [Rows(A[:cut, i], tau[:cut, i], np.zeros(cut, dtype=int), i, np.arange(61)) for i in range(6)]
    found = least_squares(rows, names, method="ols")
    assert np.linalg.matrix_rank(A[:cut].reshape(-1, 61) / np.linalg.norm(A[:cut].reshape(-1, 61), axis=0)) == 61
    residual = tau[cut:] - A[cut:] @ found.x
    np.testing.assert_allclose(share(residual, tau[cut:]), [8.5, 8.1, 15.3, 12.3, 23.0, 21.8], rtol=0, atol=0.06)


def test_tx40_rests_where_it_was_not_trained(tx40, tx40_model) -> None:
    """A 65 % to 35 % split of the whole log warns of rest (48 % against 5 %); a split of the motion alone does not."""
    whole = with_velocity(tx40[1])
    for stop, rests in ((8.9, True), (7.2, False)):
        border = 0.1 + 0.65 * (stop - 0.1)
        trained = whole.between(0.1, border)
        known = replace(tx40_model, training=training(trained.t, trained["q"], trained["qd"], ((0, len(trained)),)))
        found = extrapolation(known, whole.between(border, stop))
        assert any("rest" in sentence for sentence in found.warnings) == rests
        assert found.trained_rest_share == pytest.approx(0.046, abs=0.005)
        assert found.rest_share == pytest.approx(0.48 if rests else 0.044, abs=0.01)


def test_tx40_wrist_is_in_the_model(tx40, tx40_model) -> None:
    """Fitted to motion until 5.8 s, judged until 7.2 s: the coupled motor cuts wrist residuals by over 40 %."""
    model, later = tx40_model, tx40[1].between(5.82, 7.2)
    found = predict(model, later)
    shares = share(found["tau"] - found["tau_model"], found["tau"])
    print("TX40, 65 % to 35 % in motion, band of 10 Hz:", shares.round(1))
    assert model.coupled is not None
    np.testing.assert_array_equal(np.nonzero(model.coupled.ratios)[1], [4, 5])
    bare = predict(replace(model, coupled=None), later)
    without = share(bare["tau"] - bare["tau_model"], bare["tau"])
    assert np.all(shares[4:] < 0.6 * without[4:])


def test_tx40_torque_of_the_motors_is_told(tx40) -> None:
    robot, table, currents = tx40
    motors = table.with_column("tau", currents)
    with pytest.raises(
        ShapeError, match="joint-side torques in N m, got: joint 4: the torque sign is probably reversed"
    ):
        fit_dynamics(motors.between(0.1, 5.8), robot)
    angles = couplings.joint_to_motor(robot, table["q"] - TX40_ZERO)
    with pytest.raises(ShapeError, match=r"joint_1 \(67\.\d+, limit 3\.14: degrees or motor side, gear ratio 32"):
        prepare(table.with_column("q", angles), robot)


def test_tiago_joints_that_send_no_torque_are_named(tiago) -> None:
    robot, table = tiago
    with pytest.raises(NotExcited, match=r"arm_5 \(the same torque in \d\d % of the rows\), arm_6 .*arm_7") as caught:
        prepare(table, robot)
    assert caught.value.directions == ("arm_5", "arm_6", "arm_7")


def test_tiago_by_the_joints_that_send_torque(tiago) -> None:
    """As a user would fit it: the raw log, in the estimator's own 10 Hz band, held out."""
    robot, table = tiago
    quality = fit_dynamics(table, robot, joints=[1, 2, 3, 4]).value.quality
    shares = 100.0 * quality.rms_cv / quality.torque_sd
    print("TIAGo, held out, band of 10 Hz:", shares.round(1))
    assert np.array_equal(np.isfinite(shares), np.isin(np.arange(8), [1, 2, 3, 4]))
    assert np.all(shares[1:5] < [28, 21, 21, 18])


def test_the_example_runs_on_the_log() -> None:
    command = [sys.executable, ROOT / "examples/13_real_arm.py", DATA / "staubli_tx40"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "warning: Expected as little standstill as in training" in done.stdout

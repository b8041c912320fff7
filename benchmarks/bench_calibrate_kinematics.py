"""Kinematic calibration compared with pybotics and robotkinecal: times, and errors on the same samples.

Both peers solve by least squares without weights or covariance: robotkinecal over twists in the base frame, pybotics
over a modified DH table. Peers that are not installed are omitted.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import kinematics_bars as bars
import numpy as np
from blocks import Contender, Table, agree, loop, once, table
from scipy.optimize import least_squares

from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.estimation import Fit
from armlab.kinematics import forward, parameter_jacobian
from armlab.lie import so3
from armlab.sim import cell

EVALUATIONS, BAR = 12, 2.0  # kernel evaluations of a fit to 50 poses with report; target relative to kernel time
HALF = np.pi / 2
TOOL = (0.1, 0.05, 0.1)
MODIFIED_TABLE = np.array(
    [  # alpha_{j-1}, a_{j-1}, theta, d of the IRB 2400
        [0.0, 0.0, 0.0, 0.615], [-HALF, 0.1, -HALF, 0.0], [0.0, 0.705, 0.0, 0.0],
        [-HALF, 0.135, np.pi, 0.755], [-HALF, 0.0, 0.0, 0.0], [HALF, 0.0, 0.0, 0.085],
    ]
)  # fmt: skip
PYBOTICS_STEPS = 60  # pybotics would take minutes to reach its minimum
Forward = Callable[[np.ndarray], np.ndarray]


def run(quick: bool) -> list[Table]:
    """Measure 50 poses, 50 positions, outliers, many samples and two arms; then determine errors from many runs."""
    rounds, runs, tries = (5, 20, 1) if quick else (10, 400, 2)
    one, waves, two = (cell(bars.SEEDS[name]) for name in ("K1", "K4", "K6"))
    few, tool = [one.kinematics(k, tool=False) for k in range(10)], [one.kinematics(k) for k in range(10)]
    text = f"Noise given: {1e3 * few[0].noise[0]:.1f} mm, 0.01 degrees. {_errors(tries)}"
    return [
        table("Kinematic calibration", f"{text}\n\n{_bars(runs)}", "ms",
              [_ours("fit_kinematics, 50 poses", few), _ours("the same, model=poe", few, model="poe"),
               _ours("the same, noise estimated", few, noise=None),
               _ours("50 positions", tool, position=True),
               _ours("5 of 50 poses wrong, robust", [one.kinematics(k, wrong=5) for k in range(5)], robust=True),
               _ours("harmonics 1 and 2, 100 poses", [waves.kinematics(k, 100, harmonics=True) for k in range(5)],
                     harmonics=(1, 2)),
               _ours("1000 positions", [one.kinematics(0, 1000)], position=True),
               Contender("armlab fit_dual_arm, 60 relative poses",
                         loop(_dual, [two.two_arms(k) for k in range(5)]), "armlab")], rounds),
        table("Kinematic calibration, 50 poses", "", "ms",
              [_ours("fit_kinematics", few), _ours("the same, with its report", few, report=True),
               *_kinecal(few, False),
               Contender("its kernels", loop(_kernels, few), "limit", BAR, f"{EVALUATIONS} evaluations")], 2),
        table("Kinematic calibration, 50 positions", "", "ms",
              [_ours("fit_kinematics", tool, position=True), *_pybotics(tool[0]), *_kinecal(tool, True)], 2),
    ]  # fmt: skip


def _kernels(run: Any) -> None:
    """Compute the minimum that any fit needs: residuals, their parameter Jacobian, and its triangular factor."""
    for _ in range(EVALUATIONS):
        T, J = forward(run.robot, run.q), parameter_jacobian(run.robot, run.q)
        r = np.concatenate(
            [T[:, :3, 3] - run.pose[:, :3, 3], so3.log(T[:, :3, :3].transpose(0, 2, 1) @ run.pose[:, :3, :3])], 1
        )
        np.linalg.qr(np.column_stack([J.reshape(r.size, -1), r.ravel()]), mode="r")


def _ours(name: str, data: list[Any], position: bool = False, report: bool = False, **options: object) -> Contender:
    def fit(run: Any) -> object:
        found = _fit(run, position, **options)
        return found.report() if report else found

    return Contender(f"armlab {name}", loop(fit, data), "armlab", note="value, covariance, residuals, null space")


def _fit(run: Any, position: bool, **options: object) -> Fit[Any]:
    return fit_kinematics(run.robot, run.q, **{**bars.measured(run, position), **options})


def _dual(run: Any) -> object:
    return fit_dual_arm(**run.given, noise=run.noise)


def _has(name: str) -> bool:
    return find_spec(name) is not None


def _pybotics(run: Any) -> list[Contender]:
    if not _has("pybotics"):
        return []
    note = "modified DH table, base and tool by SciPy, 60 steps, no covariance"
    return [Contender("pybotics", once(lambda: solve_pybotics(run)), note=note)]


def solve_pybotics(run: Any) -> Forward:
    """Fit 24 parameters, base and tool of pybotics to positions, as in its documentation; return forward kinematics."""
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot as Pybotics

    robot = Pybotics.from_parameters(MODIFIED_TABLE)
    robot.tool.position = TOOL
    agree("pybotics at its start", np.array(robot.fk(run.q[0]))[:3, 3], forward(run.robot, run.q[0])[:3, 3])
    handler = OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=[True] * 3 + [False] * 3, world_mask=True)
    start = handler.generate_optimization_vector()
    seen = run.pose[:, :3, 3]
    found = least_squares(optimize_accuracy, start, args=(handler, run.q, seen), max_nfev=PYBOTICS_STEPS)
    handler.apply_optimization_vector(found.x)
    return lambda q: np.stack([np.array(handler.robot.fk(row)) for row in q])


def _kinecal(data: list[Any], position: bool) -> list[Contender]:
    if not _has("robotkinecal"):
        return []
    note = "twist in the base frame, no weights"
    return [Contender("robotkinecal", loop(lambda run: solve_kinecal(run, position), data[:1]), note=note)]


def solve_kinecal(run: Any, position: bool) -> Forward:
    """Fit robotkinecal's screws to poses or positions; return its forward kinematics."""
    import roboticstoolbox as rtb
    from robotkinecal import SerialRobotKineCal
    from spatialmath import SE3

    links, steps = [], [rtb.ET.SE3(run.robot.frames[0])]
    for j, frame in enumerate(run.robot.frames[1:]):
        links.append(rtb.Link(rtb.ETS([*steps, rtb.ET.Rz()]), name=f"link{j}", parent=links[-1] if links else None))
        steps = [rtb.ET.SE3(frame)]
    links.append(rtb.Link(rtb.ETS(steps), name="tool", parent=links[-1]))
    arm = rtb.Robot(links)
    peer = SerialRobotKineCal(arm, ee_name="tool")
    seen = [T[:3, 3].reshape(3) if position else SE3(T, check=False) for T in run.pose]
    peer.set_observations(list(run.q), seen)
    peer.solve()
    return lambda q: np.stack([peer.forward_kinematics(peer.N_JOINTS + 1, row).A for row in q])


def _errors(tries: int) -> str:
    """Return the errors of armlab and its peers at validation poses for the same samples."""
    found: dict[str, list[tuple[float, float]]] = {}
    for k in range(tries):
        pose, point = cell(bars.SEEDS["K1"]).kinematics(k, tool=False), cell(bars.SEEDS["K1"]).kinematics(k)
        ways: list[tuple[str, Any, Forward]] = [
            ("armlab, poses", pose, _fit(pose, False).value.forward),
            ("armlab, positions", point, _fit(point, True).value.forward),
        ]
        if _has("pybotics"):
            ways.append(("pybotics, positions", point, solve_pybotics(point)))
        if _has("robotkinecal"):
            ways.append(("robotkinecal, poses", pose, solve_kinecal(pose, False)))
            ways.append(("robotkinecal, positions", point, solve_kinecal(point, True)))
        for name, run, solved in ways:
            found.setdefault(name, []).append(_error(run, solved))
    rms = {name: np.sqrt(np.mean(np.square(errors), axis=0)) for name, errors in found.items()}
    parts = [
        f"{name} {e[0]:.4f} mm" + ("" if "positions" in name else f" {e[1]:.5f} degrees") for name, e in rms.items()
    ]
    return f"Errors at validation poses over {tries} runs: {'; '.join(parts)}."


def _error(run: Any, solved: Forward) -> tuple[float, float]:
    T = solved(run.q_valid)
    T[:, :3, :3] = so3.project(T[:, :3, :3])[0]
    return run.error(T)


def _bars(runs: int) -> str:
    rows = [bars.HEAD, "|---|---|---|---|---|---|---|", *(bar.text() for bar in bars.bars(runs))]
    deviation = 1.0 / np.sqrt(2.0 * 30.0 * runs)
    what = (
        f"Errors relative to the Cramér-Rao bound in {runs} runs; the standard error of a ratio is about "
        f"{deviation:.3f}."
    )
    return "\n".join([what, "", *rows])

"""``armlab demo``: the main job without a robot.

A simulated YuMi is excited over EGM, its torque model identified from the log, then the arm sways while an operator
presses on the tool, and the force is estimated live from motor torques. The estimator sees only what comes over the
wire; the operator's forces come from the plan and are compared afterwards.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlencode

from cyclopts import Parameter

from armlab.errors import ConfigError, ControllerLate, UnknownName

if TYPE_CHECKING:
    import numpy as np

    from armlab.contact import Estimator
    from armlab.identify import Trajectory
    from armlab.robots import Robot
    from armlab.state import Command, State

__all__ = ["Plan", "demo", "rehearse"]

APPROACH = 3.0  # s, walk to the start of a motion
EXCITATION = 36.0  # s
FREE = 10.0  # s, free motion below half speed
WALK = 2.0  # s between motions
SETTLE = 1.8  # s of sway before the first press and after the last
HOLD, RAMP, GAP = 2.0, 0.1, 0.3  # s, one press
REST = 5.0  # s at rest at the end
ROBOTS = ("yumi_right", "yumi_left")  # the bars and the presses are made for them
PRESSES: tuple[tuple[str, int, float], ...] = (
    ("+x", 0, 5.0),
    ("-x", 0, -5.0),
    ("+y", 1, 5.0),
    ("-y", 1, -5.0),
    ("+z", 2, 5.0),
    ("-z", 2, -5.0),
    ("500 g +x", 0, 4.905),
    ("500 g -z", 2, -4.905),
)


@dataclass(frozen=True)
class Plan:
    """What the demo does: motions and presses, in seconds of guidance time of the second run.

    Attributes
    ----------
    excitation, test : motions of the two runs.
    presses : name, axis, force [N], start and end of the full force.
    free, sway, rest : windows of the second run.
    times, wrenches : (K,), (K, 6) corners of the operator's wrench.
    """

    excitation: Trajectory
    test: Trajectory
    presses: tuple[tuple[str, int, float, float, float], ...]
    free: tuple[float, float]
    sway: tuple[float, float]
    rest: tuple[float, float]
    times: np.ndarray
    wrenches: np.ndarray

    @classmethod
    def make(cls, robot: Robot, seed: int) -> Plan:
        """Lay out the motions of a robot; `seed` chooses the excitation and the free motion."""
        import numpy as np

        from armlab.identify import design_excitation, dither, sequence

        sway_length = 2 * SETTLE + len(PRESSES) * (HOLD + 2 * RAMP + GAP)
        free = design_excitation(robot, FREE, f0=0.12, harmonics=5, speed=0.45, acceleration=8.0, seed=1000 + seed)
        motions = [free, dither(robot.q_home, sway_length), dither(robot.q_home, REST, amplitude=0.0)]
        sway_start = APPROACH + FREE + WALK
        rest_start = sway_start + sway_length + WALK
        presses, times, wrenches = [], [], []

        def press(name: str, axis: int, force: float, start: float, end: float) -> None:
            wrench = force * np.eye(6)[axis]
            times.extend([start - RAMP, start, end, end + RAMP])
            wrenches.extend([0 * wrench, wrench, wrench, 0 * wrench])
            presses.append((name, axis, force, start, end))

        for k, (name, axis, force) in enumerate(PRESSES):
            start = sway_start + SETTLE + k * (HOLD + 2 * RAMP + GAP) + RAMP
            press(name, axis, force, start, start + HOLD)
        press("at rest -z", 2, -4.905, rest_start + 1.5, rest_start + 4.0)
        return cls(
            excitation=design_excitation(robot, EXCITATION, seed=seed),
            test=sequence(motions, walk=WALK),
            presses=tuple(presses),
            free=(APPROACH + 1.0, APPROACH + FREE),
            sway=(sway_start + 1.0, sway_start + sway_length - 1.0),
            rest=(rest_start + 0.5, rest_start + REST),
            times=np.array(times),
            wrenches=np.array(wrenches),
        )

    def wrench(self, t: np.ndarray) -> np.ndarray:
        """Return the operator's wrench (N, 6) at guidance times `t` (N,)."""
        import numpy as np

        return np.stack([np.interp(t, self.times, w, left=0.0, right=0.0) for w in self.wrenches.T], axis=1)


def demo(
    *,
    fast: bool = False,
    view: bool = False,
    seed: int = 0,
    robot: str = "yumi_right",
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
) -> int:
    """Simulated YuMi, from excitation to the estimated force of a hand. No robot needed.

    Ends with status 1 when an estimate misses its bar.

    Parameters
    ----------
    fast : bool
        As fast as the machine can (lockstep) instead of in real time.
    view : bool
        Also show arm, force and curves in the browser while the demo runs; prints the address.
    seed : int
        Of motions, noise and operator.
    robot : str
        yumi_right or yumi_left.
    output : Path
        New folder for logs, model, figures and summary; demo-<time> when left out.
    """
    from armlab.cli.demo_report import figures, judge, latency_line
    from armlab.cli.output import note, result

    if robot not in ROBOTS:
        raise UnknownName.among("robot of the demo", robot, ROBOTS)
    if seed < 0:
        raise ConfigError(f"Expected a seed of 0 or more, got {seed}. Leave it out for 0.")
    folder = output or Path(f"demo-{datetime.now(UTC):%Y%m%d-%H%M%S}")
    try:
        outcome = rehearse(robot, seed, folder, fast, view)
    except ControllerLate:
        note("This computer is too busy for real time now; armlab demo --fast does the same without it.")
        raise
    verdict = judge(outcome["estimate"], outcome["plan"])
    result(outcome["fit"].report())
    result("")
    result(verdict.text())
    result(f"\nloop latency {latency_line(outcome['run'])}")
    note("drawing the figures")
    files = figures(folder, outcome, verdict)
    result("files in " + str(folder) + ": " + ", ".join(path.name for path in files))
    if view:
        result(f"the motion again: armlab view {folder / 'press.mcap'}")
    result("every bar is met" if verdict.passed else f"MISSED: {'; '.join(verdict.missed)}")
    return 0 if verdict.passed else 1


def rehearse(robot_name: str, seed: int, folder: Path, fast: bool, view: bool = False) -> dict[str, Any]:
    """Run both motions over EGM and return plan, fit, run and the table of the estimate.

    Parameters
    ----------
    robot_name : name in the library, or a robot file.
    seed : of motions and noise.
    folder : new folder for the logs and the model.
    fast : lockstep. view : show it in the browser.

    Raises
    ------
    ConfigError : when the folder exists. LinkError : when the view cannot begin.
    """
    import numpy as np

    from armlab import log, robots
    from armlab.cli.output import progress
    from armlab.contact import Estimator
    from armlab.identify import fit_dynamics

    robot = robots.load(robot_name)
    if folder.exists():
        raise ConfigError(f"Expected a new folder, got {folder}, which exists. Choose another name.")
    plan = Plan.make(robot, seed)
    folder.mkdir(parents=True)
    press_file = folder / "press.csv"
    rows = np.column_stack([plan.times, plan.wrenches])
    np.savetxt(press_file, rows, delimiter=",", header="t,fx,fy,fz,mx,my,mz", comments="", fmt="%.9g")
    with ExitStack() as stack:
        cell = f"demo-{os.getpid()}" if view else ""
        if view:
            stack.enter_context(_shown(cell))
        with progress("1/3 excite") as tell:
            controller = plan.excitation.controller(APPROACH)
            seconds = APPROACH + plan.excitation.seconds
            _drive(robot, _url(robot_name, fast, 2 * seed), controller, seconds, folder / "excite.mcap", tell, cell)
        with progress("2/3 identify") as tell:
            fit = fit_dynamics(log.read(folder / "excite.mcap"), robot, progress=tell)
            fit.save(folder / "model.toml")
        with progress("3/3 press") as tell:
            controller = _estimating(plan, Estimator(fit.value, robot))
            url = _url(robot_name, fast, 2 * seed + 1, press_file)
            run = _drive(robot, url, controller, APPROACH + plan.test.seconds, folder / "press.mcap", tell, cell)
    return {"plan": plan, "fit": fit, "run": run, "estimate": log.read(folder / "press.mcap"), "robot": robot}


def _url(robot: str, fast: bool, seed: int, operator: Path | None = None) -> str:
    query: dict[str, str] = {"seed": str(seed)}
    if fast:
        query["lockstep"] = "true"
    if operator is not None:
        query["operator"] = str(operator)
    return f"sim://{robot}?{urlencode(query)}"


def _estimating(plan: Plan, estimator: Estimator) -> Any:
    """Return the controller that moves and, in the same step, estimates the wrench and records it."""
    move = plan.test.controller(APPROACH)

    def step(state: State) -> Command:
        wrench = estimator.step(state)
        record = {"wrench_hat": wrench.wrench, "wrench_hat_cov": wrench.cov, "observability": wrench.observability}
        return replace(move(state), record=record)

    return step


@contextmanager
def _shown(cell: str) -> Iterator[None]:
    """Show in the browser what links offer under this name; the view can hold none of them up."""
    from armlab.cli.output import result
    from armlab.cli.view import beside

    with beside(cell) as line:
        result(line)
        sys.stdout.flush()
        yield


def _drive(robot: Robot, url: str, controller: Any, seconds: float, path: Path, tell: Any, cell: str) -> Any:
    from armlab import bridge
    from armlab.log import Column

    extra = {"observability": Column(shape=(6,))}  # wrench_hat and its covariance need no declaration
    with bridge.connect(url, robot, offer=cell) as link:
        return link.run(controller, seconds, record=path, extra=extra, progress=tell)

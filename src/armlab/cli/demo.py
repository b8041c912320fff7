"""``armlab demo``: run the whole workflow in simulation, with tables, figures and a summary file."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
import webbrowser
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import armlab
from armlab.cli.support.options import OptionalOutput, load_robot, mesh_option, sim_url
from armlab.cli.support.output import aligned, note, progress, result
from armlab.cli.view import beside
from armlab.errors import ConfigError, LinkError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.contact import Estimator
    from armlab.identify import Trajectory
    from armlab.log import Table
    from armlab.robots import Robot
    from armlab.state import Command, State

APPROACH = 2.0  # s, motion to the start
EXCITATION = 30.0  # s
FREE = 10.0  # s, free motion below half speed
WALK = 1.5  # s between motions
SETTLE = 1.5  # s of motion before the first press and after the last
HOLD, RAMP, GAP = 1.0, 0.1, 0.3  # s, per press
LAG = 0.1  # s, lag of the estimate after a force change
REST = 3.6  # s at rest at the end
SWAY = math.radians(2.0)  # rad or m
UNIT = 1.35  # N, force unit of a YuMi; scales the presses and targets of other arms
TORQUE_ERROR = 0.01  # relative to each torque limit; the force unit is the resulting force error
SEES = 30.0  # maximum ratio of force errors between observable axes
AXES = "xyz"
PRESSES: tuple[tuple[str, int, float], ...] = (
    *((f"{sign}{name}", axis, force) for axis, name in enumerate(AXES) for sign, force in (("+", 5.0), ("-", -5.0))),
    ("weight +x", 0, 4.905),
    ("weight -z", 2, -4.905),
)


def force_unit(robot: Robot) -> tuple[float, np.ndarray]:
    """Return the RMS force error [N] caused by 1 % torque errors at the home position, and the mask (3,) of observable
    axes.

    The variances are the diagonal of ``(J W Jᵀ)⁻¹``, where W is the diagonal matrix of the inverse squares of 1 % of
    the torque limits. With fewer than six joints, J is the Jacobian of the tool point alone, because the contact is a
    pure force.
    """
    import numpy as np

    from armlab.sim.arm.truth import synthetic_truth

    J = robot.chain.jacobian(robot.q_home) / (TORQUE_ERROR * synthetic_truth(robot).tau_max)
    J = J if robot.n >= 6 else J[:3]
    spread = np.sqrt(np.diag(np.linalg.inv(J @ J.T + 1e-9 * np.eye(len(J))))[:3])
    seen = spread < SEES * spread.min()
    return float(np.sqrt(np.mean(spread[seen] ** 2))), seen


@dataclass(frozen=True)
class Plan:
    """Planned motions of the demo, and the presses applied by its simulated operator. Times are guidance times of the
    second run [s]."""

    excitation: Trajectory  # motion of the first run
    test: Trajectory  # motion of the second run
    presses: tuple[tuple[str, int, float, float, float], ...]  # name, axis, force [N], start and end of the full force
    free: tuple[float, float]  # window of free motion
    sway: tuple[float, float]  # window of presses during small motion
    rest: tuple[float, float]  # window of a press at rest
    times: np.ndarray  # (K,) breakpoints of the operator's wrench
    wrenches: np.ndarray  # (K, 6)
    scale: float = 1.0  # scale of presses and targets: ratio of the force unit to that of a YuMi
    seen: tuple[bool, ...] = (True, True, True)  # observable axes

    @classmethod
    def make(cls, robot: Robot, seed: int) -> Plan:
        """Plan the motions of a robot; `seed` determines the excitation and the free motion."""
        import numpy as np

        unit, seen = force_unit(robot)
        scale = float(f"{unit / UNIT:.2g}")
        chosen = [(name, axis, scale * force) for name, axis, force in PRESSES if seen[axis]]
        sway_length = 2 * SETTLE + len(chosen) * (HOLD + 2 * RAMP + GAP)
        width = np.minimum(SWAY, 0.1 * (robot.q_max - robot.q_min))
        free = armlab.identify.design_excitation(
            robot, FREE, f0=0.12, harmonics=5, speed=0.45, acceleration=8.0, seed=1000 + seed
        )
        sway = armlab.identify.dither(robot.q_home, sway_length, width)
        motions = [free, sway, armlab.identify.dither(robot.q_home, REST, amplitude=0.0)]
        sway_start = APPROACH + FREE + WALK
        rest_start = sway_start + sway_length + WALK
        presses, times, wrenches = [], [], []

        def press(name: str, axis: int, force: float, start: float, end: float) -> None:
            wrench = force * np.eye(6)[axis]
            times.extend([start - RAMP, start, end, end + RAMP])
            wrenches.extend([0 * wrench, wrench, wrench, 0 * wrench])
            presses.append((name, axis, force, start, end))

        for k, (name, axis, force) in enumerate(chosen):
            start = sway_start + SETTLE + k * (HOLD + 2 * RAMP + GAP) + RAMP
            press(name, axis, force, start, start + HOLD)
        down = 2 if seen[2] else int(np.argmax(seen))
        press(f"at rest -{AXES[down]}", down, -4.905 * scale, rest_start + 1.0, rest_start + 2.6)
        return cls(
            excitation=armlab.identify.design_excitation(robot, EXCITATION, seed=seed),
            test=armlab.identify.sequence(motions, walk=WALK),
            presses=tuple(presses),
            free=(APPROACH + 1.0, APPROACH + FREE),
            sway=(sway_start + 1.0, sway_start + sway_length - 1.0),
            rest=(rest_start + 0.5, rest_start + REST),
            times=np.array(times),
            wrenches=np.array(wrenches),
            scale=scale,
            seen=tuple(seen.tolist()),
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
    output: OptionalOutput = None,
) -> int:
    """Run the whole workflow on a simulated YuMi, from excitation to contact-force estimation.

    --robot selects another arm whose description has masses; its torque limits scale the forces and targets.
    The exit status is 1 if an estimate misses its target.

    Parameters:
        fast: Run in lockstep, as fast as the computer can, instead of in real time.
        view: Also show the arm, the force and the curves in the browser during the demo.
        seed: Seed of the motions, the noise and the operator.
        robot: Name in the library, or a robot file with masses.
        output: New folder for logs, model, figures and summary; default: demo-<time>.
    """
    from armlab.sim.arm.truth import no_masses

    if why := no_masses(load_robot(robot)):
        raise ConfigError(f"Expected a robot with masses for the demo, but {why}.")
    if seed < 0:
        raise ConfigError(f"Expected a seed of 0 or more, got {seed}. Omit --seed to use 0.")
    folder = output or Path(f"demo-{datetime.now(UTC):%Y%m%d-%H%M%S}")
    try:
        outcome = rehearse(robot, seed, folder, fast, view)
    except LinkError:  # the loop was late, or the arm was far behind its reference
        if not fast:
            note("The real-time demo requires an idle computer; armlab demo --fast runs the same demo in lockstep.")
        raise
    verdict = judge(outcome["estimate"], outcome["plan"])
    (folder / "identify.txt").write_text(outcome["fit"].report() + "\n")
    quality = outcome["fit"].value.quality
    shares = 100.0 * quality.rms_cv / quality.torque_sd
    result(
        f"identified from {quality.seconds:.0f} s of motion: held-out residual {shares.min():.1f} to "
        f"{shares.max():.1f} % of the torque standard deviation (identify.txt)\n"
    )
    result(verdict.text())
    report = outcome["run"].report().splitlines()
    result(f"\nloop latency {next((line.strip() for line in report if 'p50' in line), report[0])}")
    note("drawing the figures")
    files = figures(folder, outcome, verdict)
    result(f"files in {folder}: {', '.join(path.name for path in files)}")
    result(f"view the motion: {shlex.join(['armlab', 'view', str(folder / 'press.mcap'), *mesh_option(robot)])}")
    result("every target is met" if verdict.passed else f"MISSED: {'; '.join(verdict.missed)}")
    return 0 if verdict.passed else 1


def rehearse(robot_name: str, seed: int, folder: Path, fast: bool, view: bool = False) -> dict[str, Any]:
    """Run both motions over EGM; return the plan, the fit, the run and the table with the estimate."""
    import numpy as np

    robot = load_robot(robot_name)
    if folder.exists():
        raise ConfigError(f"Expected a new folder, but {folder} already exists. Choose another name.")
    plan = Plan.make(robot, seed)
    folder.mkdir(parents=True)
    press_file = folder / "press.csv"
    rows = np.column_stack([plan.times, plan.wrenches])
    np.savetxt(press_file, rows, delimiter=",", header="t,fx,fy,fz,mx,my,mz", comments="", fmt="%.9g")
    with ExitStack() as stack:
        cell = f"demo-{os.getpid()}" if view else ""
        if view:
            line = stack.enter_context(beside(cell, robot_name))  # a separate process cannot delay the run
            result(line)
            sys.stdout.flush()
            if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
                webbrowser.open(line.removeprefix("View: "))
        with progress("1/3 excite") as tell:
            controller = plan.excitation.controller(APPROACH)
            seconds = APPROACH + plan.excitation.seconds
            _drive(robot, _url(robot_name, fast, 2 * seed), controller, seconds, folder / "excite.mcap", tell, cell)
        with progress("2/3 identify") as tell:
            fit = armlab.identify.fit_dynamics(armlab.log.read(folder / "excite.mcap"), robot, progress=tell)
            fit.save(folder / "model.toml")
        with progress("3/3 press") as tell:
            prior = max(plan.scale, 1.0) * np.array(PRIOR)
            controller = _estimating(plan, armlab.contact.Estimator(fit.value, robot, prior=prior))
            url = _url(robot_name, fast, 2 * seed + 1, press_file)
            run = _drive(robot, url, controller, APPROACH + plan.test.seconds, folder / "press.mcap", tell, cell)
    return {"plan": plan, "fit": fit, "run": run, "estimate": armlab.log.read(folder / "press.mcap")}


def _url(robot: str, fast: bool, seed: int, operator: Path | None = None) -> str:
    query = {"seed": seed} | ({"lockstep": "true"} if fast else {}) | ({"operator": operator} if operator else {})
    return sim_url(robot, **query)


def _estimating(plan: Plan, estimator: Estimator) -> Any:
    move = plan.test.controller(APPROACH)

    def step(state: State) -> Command:
        wrench = estimator.step(state)
        record = {"wrench_hat": wrench.wrench, "wrench_hat_cov": wrench.cov, "observability": wrench.observability}
        return replace(move(state), record=record)

    return step


def _drive(robot: Robot, url: str, controller: Any, seconds: float, path: Path, tell: Any, cell: str) -> Any:
    extra = {"observability": armlab.log.Column(shape=(6,))}  # wrench_hat and its covariance are always declared
    with armlab.bridge.connect(url, robot, offer=cell) as link:
        return link.run(controller, seconds, record=path, extra=extra, progress=tell)


SEEN = 0.9  # smallest observability of an axis that is included in the RMS errors
MAX_RMS = 1.5  # N per axis, with contact and in free motion; multiplied by the scale
PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)  # N, N m, prior of the estimator; multiplied by max(scale, 1)
MAX_PRESS_ERROR = 0.15  # mean error during a press, relative to the weight
COVERAGE = (0.85, 0.99)
MAX_HOLES = 0.02  # maximum fraction of cycles without an estimate; a busy computer misses some cycles


@dataclass(frozen=True)
class DemoVerdict:
    """Comparison of the estimate with the operator's forces."""

    # name, true force [N], estimated force (x, y, z) [N], 2-sigma band and error along the press [N]
    presses: tuple[dict[str, Any], ...]
    rms: np.ndarray  # (3,) RMS error on observable axes while the operator acts [N]
    free_rms: np.ndarray  # (3,) RMS error in free motion on observable axes [N]
    coverage: float  # fraction of forces inside 2 sigma during presses and motion
    rest_inside: float  # fraction of forces inside 2 sigma at rest
    rest_band: np.ndarray  # (3,) mean 2-sigma band at rest [N]
    holes: float  # fraction of cycles without an estimate
    bar: float = MAX_RMS  # target of the RMS errors [N]
    seen: tuple[bool, ...] = (True, True, True)

    @property
    def passed(self) -> bool:
        return not self.missed

    @property
    def missed(self) -> tuple[str, ...]:
        missed = [
            f"{what} {AXES[i]} {values[i]:.2f} N"
            for what, values in (("force error", self.rms), ("false force", self.free_rms))
            for i in range(3)
            if self.seen[i] and not values[i] <= self.bar
        ]
        if self.holes > MAX_HOLES:
            missed.append(f"{100 * self.holes:.1f} % of the cycles without an estimate")
        if not COVERAGE[0] <= self.coverage <= COVERAGE[1]:
            missed.append(f"coverage {100 * self.coverage:.1f} %")
        missed += [
            f"{p['name']}: {p['error']:+.2f} N"
            for p in self.presses
            if p["name"].startswith("weight") and not abs(p["error"]) <= MAX_PRESS_ERROR * abs(p["true"])
        ]
        if not self.rest_inside >= 1.0:
            missed.append(f"true force at rest within 2 sigma for only {100 * self.rest_inside:.1f} %")
        return tuple(missed)

    def text(self) -> str:
        rows: list[tuple[str, ...]] = [("press", "true [N]", "estimated x", "y", "z", "2-sigma", "error")]
        for p in self.presses:
            forces = (f"{force:+.2f}" for force in (p["true"], *p["force"]))
            rows.append((p["name"], *forces, f"{p['band']:.2f}", f"{p['error']:+.2f}"))
        rms, free, band = (" ".join(f"{v:.2f}" for v in a) for a in (self.rms, self.free_rms, self.rest_band))
        return "\n".join(
            [
                aligned(rows, right=range(1, 7)),
                f"force error x y z, RMS while swaying and pressing  {rms} N (target {self.bar:.3g})",
                f"false force x y z, RMS in free motion              {free} N (target {self.bar:.3g})",
                f"within 2 sigma while swaying and pressing          {100 * self.coverage:.1f} % (target 85 to 99)",
                f"at rest: within 2 sigma {100 * self.rest_inside:.1f} %, mean 2-sigma x y z {band} N: "
                "static friction masks small forces",
            ]
        )


def judge(table: Table, plan: Plan) -> DemoVerdict:
    """Compare the recorded live estimate with the operator's forces.

    Cycles without an estimate are ignored; if their fraction exceeds MAX_HOLES, this counts as a missed target.
    """
    import numpy as np

    estimated = np.asarray(np.isfinite(table["wrench_hat"]).all(axis=1))
    cycles = table["session_t"]
    asked = (cycles >= plan.sway[0]) & (cycles < plan.sway[1])
    holes = float(np.mean(~estimated[asked])) if asked.any() else 1.0
    table = table.where(estimated)
    t = table["session_t"]
    force, truth = table["wrench_hat"][:, :3], plan.wrench(t)[:, :3]
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])[:, :3])
    seen = table["observability"][:, :3] >= SEEN
    error = force - truth

    def window(span: tuple[float, float]) -> np.ndarray:
        return (t >= span[0]) & (t < span[1])

    def rms(rows: np.ndarray) -> np.ndarray:
        kept = rows[:, None] & seen
        return np.array([np.sqrt(np.mean(error[kept[:, i], i] ** 2)) if kept[:, i].any() else np.nan for i in range(3)])

    if not len(t) or t[-1] < plan.presses[-1][4]:
        raise LogError(
            f"Expected a run of {plan.presses[-1][4]:.1f} s with all presses, got {t[-1] if len(t) else 0.0:.1f} s. "
            "Run the demo again."
        )
    sway, rest = window(plan.sway), window(plan.rest)
    for edge in plan.presses[-1][3:]:  # the filtered estimate lags behind force changes
        rest &= ~window((edge - RAMP, edge + RAMP + LAG))
    presses = []
    for name, axis, true, start, end in plan.presses:
        rows = window((start + 0.1, end))
        mean, band = force[rows].mean(axis=0), float(2 * sigma[rows, axis].mean())
        press = {"name": name, "true": true, "force": mean.tolist(), "band": band}
        presses.append(press | {"error": float(mean[axis] - true)})
    return DemoVerdict(
        presses=tuple(presses),
        rms=rms(sway),
        free_rms=rms(window(plan.free)),
        coverage=float(np.mean((np.abs(error[sway]) < 2 * sigma[sway])[:, list(plan.seen)])),
        rest_inside=float(np.mean(np.abs(error[rest]) < 2 * sigma[rest])),
        rest_band=2 * sigma[rest].mean(axis=0),
        holes=holes,
        bar=plan.scale * MAX_RMS,
        seen=plan.seen,
    )


def figures(folder: Path, outcome: dict[str, Any], verdict: DemoVerdict) -> list[Path]:
    """Write torque.png, wrench.png and summary.json to the folder; return all files in it."""
    from armlab.plots.style import png

    table, excited = outcome["estimate"], armlab.log.read(folder / "excite.mcap")
    truth = table.with_column("wrench_true", outcome["plan"].wrench(table["session_t"]))
    (folder / "torque.png").write_bytes(png(armlab.plots.torque_fit(outcome["fit"].value, excited), dpi=120))
    (folder / "wrench.png").write_bytes(png(armlab.plots.wrench(truth), dpi=120))
    summary = {
        "passed": verdict.passed,
        "missed": list(verdict.missed),
        "force_bar": verdict.bar,
        "presses": list(verdict.presses),
        "force_rms": verdict.rms.tolist(),
        "false_force_rms": verdict.free_rms.tolist(),
        "coverage": verdict.coverage,
        "rest_inside": verdict.rest_inside,
        "rest_two_sigma": verdict.rest_band.tolist(),
    }
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return sorted(folder.iterdir())

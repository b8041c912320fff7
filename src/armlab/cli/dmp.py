"""``armlab dmp``: movement primitives from logs, and played on a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

if TYPE_CHECKING:
    import numpy as np

    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.motion import Dmp
    from armlab.motion.profile import Profile
    from armlab.state import Command, State

__all__ = ["dmp", "fit", "play"]

MOVES = 0.02  # of the largest speed: below it the arm still rests, or rests again
STILL = 2e-3  # rad/s or m/s: noise of an arm at rest
MARGIN = 0.1  # s of rest that is kept at both ends
SOFT = 2.0  # rad/s^2 or m/s^2 on the way to the start
SETTLES = 1.0  # s after the end

dmp = App(name="dmp", help="Movement primitives: fit one to logs of a motion, play it on a robot.")


@dmp.command
def fit(
    *logs: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    column: str = "q",
    start: float | None = None,
    end: float | None = None,
    whole: bool = False,
    basis: int = 50,
    schedule: str = "canonical",
    scaling: str = "goal",
    convention: str = "lund",
    json: bool = False,
    force: bool = False,
) -> int:
    """Fit a movement primitive to the motion in a log, or to several demonstrations of it, and save it.

    Rest before and after the motion is left out. Prints how far the motion of the primitive is from what was shown.

    Parameters
    ----------
    logs : tuple of Path
        One log per demonstration: MCAP, CSV, MAT or Parquet.
    output : Path
        File of the primitive, .toml.
    column : str
        What moves: q, or another column of positions.
    start : float
        Only from this time of the log on [s].
    end : float
        Only up to this time [s].
    whole : bool
        Keep rest before and after the motion.
    basis : int
        Number of kernels.
    schedule : str
        Phase: canonical, time, or position for motions that never turn.
    scaling : str
        Of the motion with its goal: goal, none, amplitude or rotate.
    convention : str
        lund or ijspeert.
    json : bool
        Print JSON for scripts.
    force : bool
        Replace an existing file.
    """
    from armlab import log as files
    from armlab.cli.output import check_output, note, print_json, result
    from armlab.errors import ConfigError
    from armlab.motion import fit_dmp

    if not logs:
        raise ConfigError("Expected the log of a motion, got none. Name one or several files.")
    check_output(output, force, [".toml"])
    tables = [_cut(files.read(path), column, start, end, whole) for path in logs]
    t, y = [table.t for table in tables], [table[column] for table in tables]
    one = len(tables) == 1
    found = fit_dmp(
        t[0] if one else t,
        y[0] if one else y,
        n_basis=basis,
        schedule=schedule,
        scaling=scaling,
        convention=convention,
    )
    if json:
        print_json(_numbers(found))
    else:
        result(_text(found, len(tables)))
    sources = [source for table in tables for source in table.source if "sha256" in source]
    note(f"primitive: {found.save(output, sources)}")
    return 0


@dmp.command
def play(
    robot: str,
    primitive: Path,
    *,
    link: str | None = None,
    duration: float | None = None,
    goal: list[float] | None = None,
    speed: float = 1.0,
    firm: bool = False,
    log: Path = Path("dmp.mcap"),
    json: bool = False,
) -> int:
    """Play a movement primitive on a robot: walk to its start, run it, record a log, and say how near the goal it came.

    The motion waits for an arm that is held up, and goes on when it is released. A motion too fast for the limits of
    the robot is stretched.

    Parameters
    ----------
    robot : str
        Name in the library, or a robot file.
    primitive : Path
        File of `armlab dmp fit`.
    link : str
        egm://HOST:PORT for a robot; the simulated robot when not given.
    duration : float
        Of the motion [s]; that of the demonstration when not given.
    goal : list of float
        Joint positions to end at [rad or m]; those of the demonstration when not given.
    speed : float
        Share of the robot's speed limits that is allowed, in (0, 1].
    firm : bool
        Tell the arm the path whatever it does, instead of waiting for an arm that is held up.
    log : Path
        Recording of the motion; -2, -3 is added to a name that exists.
    json : bool
        Print JSON for scripts.
    """
    import numpy as np

    from armlab import bridge, robots
    from armlab.cli.output import note, print_json, progress, result
    from armlab.motion import Dmp, TwoDofDmp, duration_within

    arm = robots.load(robot)
    motion, limits = Dmp.load(primitive), bridge.Limits.of(arm, speed=speed)
    g = None if goal is None else np.array(goal)
    law = motion if firm else TwoDofDmp(motion)
    law.controller(arm, limits=limits, g=g)  # refuses another arm or goal before anything moves
    least = duration_within(motion, speed * arm.qd_max, g=g)
    seconds = max(motion.duration if duration is None else duration, least)
    controller = law.controller(arm, limits=limits, g=g, duration=seconds)
    with bridge.connect(link or f"sim://{arm.name}", arm) as end:
        end.run(_Walk(motion.y0, speed * arm.qd_max), limits=limits)
        with progress("motion") as tell:
            whole = seconds + SETTLES
            done = end.run(controller, whole, limits=limits, record=log, extra=controller.columns(), progress=tell)
    off = float(np.abs(done.table["q"][-1] - controller.goal).max())
    if json:
        print_json({"seconds": seconds, "goal_error": off, "reason": done.reason, "log": str(done.path)})
    else:
        result(f"{seconds:.2f} s of motion, ended {off:.2g} rad from the goal: {done.reason}")
    note(f"log: {done.path}")
    return 0


class _Walk:
    """From where the arm stands to a posture, with minimum jerk; then the end of the run."""

    def __init__(self, q: np.ndarray, qd_max: np.ndarray) -> None:
        self._q, self._qd_max, self._begin = q, qd_max, 0.0
        self._profile: Profile | None = None

    def __call__(self, state: State) -> Command:
        from armlab.motion import profiles
        from armlab.state import Command

        if self._profile is None:
            whole = profiles.minimum_jerk(state.q, self._q, 1e-2)
            self._profile, self._begin = whole.slowed(self._qd_max, SOFT), state.t
        clock = state.t - self._begin
        if clock > self._profile.duration + 0.5 * SETTLES:
            return Command.stop()
        q, qd, _ = self._profile.at(clock)
        return Command(q, qd)


def _cut(table: Table, column: str, start: float | None, end: float | None, whole: bool) -> Table:
    """Return the rows of the motion."""
    import numpy as np

    from armlab.errors import ConfigError

    first, last = table.t[0] if start is None else start, np.inf if end is None else end
    part = table.between(first, last)
    if whole or len(part) < 3:
        return part
    speed = np.abs(np.gradient(part[column], part.t, axis=0)).reshape(len(part), -1).max(axis=1)
    moving = np.flatnonzero(speed > max(MOVES * np.nanmax(speed), STILL))
    if not len(moving):
        raise ConfigError(f"Expected a motion in {column} of {table.source[0]}, got rest. Name another log or column.")
    return part.between(float(part.t[moving[0]]) - MARGIN, float(part.t[moving[-1]]) + MARGIN)


def _errors(found: Fit[Dmp]) -> np.ndarray:
    import numpy as np

    return np.sqrt((found.residuals**2).mean(axis=0))


def _text(found: Fit[Dmp], demonstrations: int) -> str:
    from armlab.cli.output import aligned

    value = found.value
    head = (
        f"{value.duration:.2f} s of {value.n} coordinates from {demonstrations} demonstration"
        f"{'s' if demonstrations > 1 else ''} with {found.n} samples; {value.n_basis} kernels"
    )
    rows = [("coordinate", "start", "goal", "motion off by (RMS)")]
    rows += [
        (f"{i + 1}", f"{a:.4f}", f"{b:.4f}", f"{e:.2e}")
        for i, (a, b, e) in enumerate(zip(value.y0, value.g, _errors(found)))
    ]
    return f"{head}\n{aligned(rows, right=(1, 2, 3))}"


def _numbers(found: Fit[Dmp]) -> dict[str, Any]:
    value = found.value
    told = {"duration": value.duration, "samples": found.n, "kernels": value.n_basis, "unscaled": list(value.unscaled)}
    arrays = {"start": value.y0, "goal": value.g, "rms": _errors(found)}
    return told | {name: array.tolist() for name, array in arrays.items()}

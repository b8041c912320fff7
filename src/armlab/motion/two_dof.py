"""Two-degree-of-freedom control of a movement primitive: the path waits while the arm is held back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number, numbers, positive, still
from armlab.errors import ConfigError, ShapeError
from armlab.estimation.fit import value_of
from armlab.motion.arguments import MAX_SAMPLES
from armlab.motion.control import MAX_STEP, Arms, Controller, JointLimits, Pace, check_joints, steps_in
from armlab.motion.disturbances import FULL_SPEED, Displace, Plant, Push, TwoDofRun, simulated
from armlab.motion.dmp import Dmp
from armlab.motion.primitive.run import Rollout, RunOptions, RunParameters, progress
from armlab.motion.storage import Saved
from armlab.state import State

if TYPE_CHECKING:
    from armlab.log import Column, Table


@dataclass(frozen=True, eq=False, repr=False)
class TwoDofDmp(Saved, kind="two_dof_dmp"):
    """Movement primitive whose coupled path yc slows down while the arm position ya cannot follow.

    The time constant grows with the filtered error beyond a dead zone; docs/theory/two_dof_dmp.md describes the law.
    All coordinates share the phase x and tau_a, so the path keeps its shape. A static error of 1, 2, 5, 10 or 20 mrad
    slows the motion by a factor of 1.01, 1.04, 1.25, 2 or 5. Set `e0` above the error caused by sensors, friction and
    delay.

    Attributes
    ----------
    dmp : the primitive, or the result of `fit_dmp`.
    kp, kv : position gain [1/s^2] and velocity gain [1/s].
    kc : slow-down gain.
    alpha_e : error filter rate [1/s].
    e0 : dead zone, one number or (n,), in the unit of y.
    e_scale : error that is normalised to 1, with the same shape as e0.
    e_max : normalised error |ya - yc| / e_scale above which the path pauses, until the error is below 0.8 e_max.

    Raises
    ------
    ShapeError : negative gains, e_scale or e_max not positive, wrong shapes, NaN.

    References
    ----------
    Karlsson, Bagge Carlson, Robertsson, Johansson, "Two-Degree-of-Freedom Control for Trajectory Tracking and
    Perturbation Recovery during Execution of Dynamical Movement Primitives", IFAC World Congress 2017.
    """

    dmp: Dmp
    kp: float = 25.0
    kv: float = 10.0
    kc: float = 1e4
    alpha_e: float = 5.0
    e0: ArrayLike = 0.0
    e_scale: ArrayLike = 1.0
    e_max: float = np.inf

    UNITS: ClassVar[dict[str, str]] = {
        "kp": "1/s^2",
        **dict.fromkeys(("kv", "alpha_e"), "1/s"),
        **dict.fromkeys(("e0", "e_scale"), "unit of y, rad or m"),
        **dict.fromkeys(("kc", "e_max"), "1"),
    }

    def __post_init__(self) -> None:
        object.__setattr__(self, "dmp", value_of(self.dmp))
        if not isinstance(self.dmp, Dmp):
            raise ShapeError(f"Expected a Dmp, got {type(self.dmp).__name__}. Use motion.fit_dmp.")
        for name in ("kp", "kv", "kc", "alpha_e"):
            if not 0.0 <= number(getattr(self, name), name) < np.inf:
                raise ShapeError(f"Expected a finite {name} of at least 0, got {getattr(self, name)}.")
        if not number(self.e_max, "e_max") > 0.0:
            raise ShapeError(f"Expected e_max above 0, got {self.e_max}. Infinity disables pausing.")
        for name in ("e0", "e_scale"):
            values = numbers(getattr(self, name), name, ShapeError)
            if values.shape not in ((), (self.dmp.n,)):
                raise ShapeError(f"Expected {name} to be one number or {self.dmp.n} numbers, got shape {values.shape}.")
            least = 0.0 if name == "e0" else np.finfo(float).tiny
            if not ((values >= least) & np.isfinite(values)).all():
                raise ShapeError(f"Expected {name} {'of at least' if name == 'e0' else 'above'} 0, got {values}.")
            object.__setattr__(self, name, still(np.broadcast_to(values, (self.dmp.n,)), name))

    def _law(self, run: RunParameters) -> Any:
        """Return the `armlab.kernels.TwoDof` of a run."""
        gains = np.array([self.kp, self.kv, self.kc, self.alpha_e, self.e_max])
        zone, unit = np.asarray(self.e0), np.asarray(self.e_scale)
        return kernels.TwoDof(run.primitive, run.tau, run.y0, run.g, run.scale, gains, zone, unit)

    def simulate(
        self,
        t: ArrayLike = MAX_STEP,
        events: Sequence[Push | Displace | Plant] = (),
        *,
        dt: float = MAX_STEP,
        **run: Unpack[RunOptions],
    ) -> TwoDofRun:
        """Simulate an arm with perfect tracking, ``ya'' = ya_ref''``, under disturbances.

        Integration is of fourth order; a step ends at every event.

        Parameters
        ----------
        t : (N,) increasing times [s], relative to the first; or a time step [s] for a run to the end of the motion.
        events : `Hold`, `Push`, `Displace`, and at most one plant, ``(t, ya, ya', ya_ref'') -> ya''``, in place of
            perfect tracking.
        dt : longest integration step [s].
        **run : as in `Dmp.rollout`. The arm starts on the path, with the path velocity.

        Raises
        ------
        ShapeError : as in `Dmp.rollout`; overlapping events; a plant that does not return accelerations.
        ConfigError : both duration and tau_d given.
        """
        longest = positive(dt, "dt", "At 250 Hz, dt is 0.004 s.")
        setting, free = RunParameters.of(self.dmp, **run), _free(self.dmp, t, longest, run)
        law = self._law(setting)
        states, disturbed = simulated(law, starting(setting), free.t, events, longest)
        yc, _, e, ya, yad = states[:, :-2].reshape(len(states), 5, law.n).swapaxes(0, 1)
        ycd, ycdd, ydd_ref = np.array([law.reference(y, FULL_SPEED) for y in states]).swapaxes(0, 1)
        tau_a = np.array([law.time_constant(y) for y in states])
        x = states[:, -2] if self.dmp.schedule != "position" else progress(yc, setting.y0, setting.g)
        return TwoDofRun(free.t, yc, ycd, ycdd, ya, yad, ydd_ref, e, x, tau_a, states[:, -1] > 0, free, disturbed)

    def recorded(
        self,
        table: Table,
        disturbed: Sequence[tuple[float, float]] = (),
        *,
        duration: float | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> TwoDofRun:
        """Return a run recorded with `controller`, together with the undisturbed motion; times begin at 0.

        Parameters
        ----------
        table : log of ``link.run(controller, extra=controller.columns())``; rows without a path are skipped.
        disturbed : interval (t0, t1) of each known disturbance of the arm [s].
        duration, g, amplitude : as passed to the controller.

        Raises
        ------
        UnknownName : a column recorded by the controller is missing.
        ShapeError : the table has no row with a path.
        """
        begun = np.asarray(np.isfinite(table["path"]).all(axis=1))
        if not begun.any():
            raise ShapeError(
                "Expected a log with a path, got NaN in all rows of the column path. Record a run of the controller."
            )
        rows = table.where(begun)
        t = rows.t - rows.t[0]
        run: RunOptions = {"duration": duration, "g": g, "amplitude": amplitude}
        run |= {"y0": rows["q"][0], "v0": np.zeros(self.dmp.n)}
        free = _free(self.dmp, t, MAX_STEP, run)
        names = ("path", "path_qd", "path_qdd", "q", "qd", "qdd_ref", "path_error", "phase", "tau_a")
        parts: list[Any] = [np.asarray(rows[name]) for name in names]
        parts += [rows["frozen"].astype(bool), free, tuple(disturbed)]
        return TwoDofRun(t, *parts)

    def stepper(self, **run: Unpack[RunOptions]) -> TwoDofStepper:
        """Return a stepper that runs the control law sample by sample with measured positions.

        The stepper's ``step(dt, ya, yad)`` takes the time since the last sample [s] (0 at the first sample), and the
        measured position and velocity (n,). The method returns `yc`, `ycd`, `ycdd` of the coupled path and the
        reference acceleration `ydd_ref`, each (n,). ``change_goal(g)`` changes the goal (n,), and ``reset()`` returns
        to the start. `x`, `tau_a` [s], `e` (n,), `frozen` and `has_ended` describe the state of the run.

        Parameters
        ----------
        **run : as in `Dmp.rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `Dmp.rollout`.
        """
        return TwoDofStepper(self, RunParameters.of(self.dmp, **run))

    def controller(
        self,
        robot: Arms,
        *,
        limits: JointLimits | Sequence[JointLimits] | None = None,
        duration: float | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
        give_way: Callable[[State], np.ndarray] | None = None,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge` that starts at rest at the measured position.

        Parameters
        ----------
        robot, limits : as in `Dmp.controller`.
        duration, g, amplitude : as in `Dmp.rollout`.
        give_way : function of the State that returns the acceleration (n,) due to contact, added to the reference, for
            an arm that is not itself compliant. Example: ``lambda state: J(state.q).T @ force(state) / inertia``.

        Raises
        ------
        ShapeError : wrong number of joints, or a goal outside the limits.
        ConfigError : as in `Dmp.rollout`.
        """
        return TwoDofController(robot, self, {"duration": duration, "g": g, "amplitude": amplitude}, limits, give_way)


def _free(dmp: Dmp, t: ArrayLike, longest: float, given: RunOptions) -> Rollout:
    """Return the undisturbed primitive at times t, integrated in steps of at most `longest`."""
    times = dmp.rollout(t, **given).t
    if not times[-1] - times[0] < longest * MAX_SAMPLES:
        steps = (times[-1] - times[0]) / longest
        raise ShapeError(
            f"Expected fewer than {MAX_SAMPLES} steps, got {steps:.3g} at dt = {longest:g} s. Use a longer dt."
        )
    if len(times) < 2:
        return dmp.rollout(times, **given)
    parts = np.maximum(np.ceil(np.diff(times) / longest - 1e-9), 1).astype(int)
    fine = [np.linspace(a, b, k, endpoint=False) for a, b, k in zip(times, times[1:], parts)]
    found = dmp.rollout(np.append(np.concatenate(fine), times[-1]), **given)
    kept = np.concatenate([[0], np.cumsum(parts)])
    return Rollout(times, *(getattr(found, f.name)[kept] for f in fields(Rollout)[1:]))


class Reference(NamedTuple):
    """Result of `TwoDofStepper.step`."""

    yc: np.ndarray
    ycd: np.ndarray
    ycdd: np.ndarray
    ydd_ref: np.ndarray


class TwoDofStepper:
    """Run of a `TwoDofDmp` with measured positions; created by `TwoDofDmp.stepper`.

    Between two samples, ya is extrapolated with the last measured velocity, and the control law is integrated in steps
    of at most 4 ms.
    """

    goal: np.ndarray

    def __init__(self, two_dof: TwoDofDmp, run: RunParameters) -> None:
        self._two_dof, self._run = two_dof, run
        self.reset()

    def reset(self) -> None:
        """Return to the start and restore the initial goal."""
        run = self._run
        self._law, self.goal = self._two_dof._law(run), run.g
        self._state = starting(run)

    def step(self, dt: float, ya: np.ndarray, yad: np.ndarray, speed: np.ndarray = FULL_SPEED) -> Reference:
        """Process a measurement of the arm and return the current reference."""
        found = self._law.follow(self._state, dt, steps_in(dt), speed, ya, yad)
        self._state, (ycd, ycdd, ydd_ref) = found
        return Reference(self._state[: self._law.n], ycd, ycdd, ydd_ref)

    def change_goal(self, g: ArrayLike) -> None:
        """Change the goal; with scaling "goal", the forcing is scaled accordingly."""
        scaling = self._two_dof.dmp.scaling
        if scaling == "rotate":
            raise ConfigError("Expected a constant goal with scaling 'rotate', got a new goal. Create a new stepper.")
        run = self._run.towards(g, scaling == "goal")
        self._law, self.goal = self._two_dof._law(run), run.g

    @property
    def e(self) -> np.ndarray:
        """Filtered error (n,)."""
        return self._state[2 * self._law.n : 3 * self._law.n]

    @property
    def x(self) -> float:
        """Phase shared by all coordinates; with schedule "position", this phase only measures time."""
        return float(self._state[-2])

    @property
    def tau_a(self) -> float:
        """Current time constant [s]: nominal while the arm follows the path, otherwise longer."""
        return self._law.time_constant(self._state)

    @property
    def frozen(self) -> bool:
        """Whether the path is paused because the arm is too far from it."""
        return bool(self._state[-1])

    @property
    def has_ended(self) -> bool:
        """Whether the phase has reached its value at the end of the demonstration."""
        x, dmp = self.x, self._two_dof.dmp
        if dmp.schedule == "time":
            return x >= 1.0
        return x <= np.exp(-dmp.alpha_x * dmp.duration / dmp.tau_d)


def starting(run: RunParameters) -> np.ndarray:
    """Return the state (5 n + 2,) at the start of a run, with the arm on the path."""
    x = 0.0 if run.dmp.schedule == "time" else 1.0
    return np.concatenate([run.y0, run.tau * run.v0, np.zeros(run.dmp.n), run.y0, run.v0, [x, 0.0]])


class TwoDofController(Controller):
    """Controller for a `TwoDofDmp`: integrates the reference acceleration twice, using measured positions."""

    stepper: TwoDofStepper

    def __init__(
        self,
        robot: Arms,
        two_dof: TwoDofDmp,
        settings: Mapping[str, Any],
        limits: JointLimits | Sequence[JointLimits] | None = None,
        give_way: Callable[[State], np.ndarray] | None = None,
    ) -> None:
        check_joints(robot, two_dof.dmp.n)
        self._two_dof, self._settings, self._give_way = two_dof, settings, give_way
        self.stepper = two_dof.stepper(**settings)
        super().__init__(robot, limits, self.stepper.goal)

    def columns(self) -> dict[str, Column]:
        """Return the recorded columns, for ``link.run(extra=...)`` and `TwoDofDmp.recorded`."""
        from armlab.log import Column

        own = {"path_qd": Column((self._n,), unit="rad/s"), "path_qdd": Column((self._n,), unit="rad/s^2")}
        own |= {"path_error": Column((self._n,), unit="rad"), "phase": Column((), unit="1")}
        return super().columns() | own | {"tau_a": Column((), unit="s")}

    def _begin(self, state: State) -> None:
        given = {**self._settings, "g": self._goal, "y0": state.q, "v0": np.zeros_like(state.q)}
        self.stepper = self._two_dof.stepper(**given)
        self._qdd = np.zeros_like(state.q)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        found = self.stepper.step(dt, state.q, state.qd, np.array(pace))
        q, _, qd = self._sent
        if dt > 0.0:
            gained = dt * self._qdd
            q, qd = q + dt * qd + (0.5 * dt) * gained, qd + gained
        self._qdd = found.ydd_ref if self._give_way is None else found.ydd_ref + self._give_way(state)
        self.frozen: bool = self.stepper.frozen
        self._found = found
        return q, qd, self._qdd, found.yc

    def _record(self) -> dict[str, Any]:
        found, stepper = self._found, self.stepper
        of_path = {"path_qd": found.ycd, "path_qdd": found.ycdd, "path_error": stepper.e}
        return of_path | {"phase": stepper.x, "tau_a": stepper.tau_a}

    def _change_goal(self, g: np.ndarray) -> None:
        self.stepper.change_goal(g)

    @property
    def _is_over(self) -> bool:
        return self.stepper.has_ended

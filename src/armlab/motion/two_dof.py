"""Two-degree-of-freedom control of a movement primitive: the path waits for an arm that was held up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number, numbers, positive
from armlab.errors import ShapeError
from armlab.motion._arguments import MOST_SAMPLES
from armlab.motion._saved import Saved
from armlab.motion._setting import Setting
from armlab.motion._solving import progress
from armlab.motion.control import LONGEST_STEP, Arms, Controller, Limits
from armlab.motion.dmp import Dmp
from armlab.motion.events import Displace, Push
from armlab.motion.rollout import Rollout, RunOptions
from armlab.motion.two_dof_run import FULL_SPEED, Plant, TwoDofRun, simulated
from armlab.motion.two_dof_stepper import TwoDofStepper, starting
from armlab.state import State

if TYPE_CHECKING:
    from armlab.log import Table

__all__ = ["TwoDofDmp"]


@dataclass(frozen=True, eq=False)
class TwoDofDmp(Saved, kind="two_dof_dmp"):
    """A movement primitive whose path yc an arm follows at ya, and which slows down while the arm cannot follow.

    With e the filtered error, ``e' = alpha_e (ya - yc - e)``, and d that part of it beyond the dead zone::

        tau_a = tau_d (1 + kc sum (d / e_scale)^2)
        tau_a yc' = z,   tau_a z' = alpha_z (beta_z (g - yc) - z) + f(x),   tau_a x' = -alpha_x x
        ya_ref'' = kp (yc - ya) + kv (yc' - ya') + yc''

    All coordinates share the phase x and tau_a, so the path keeps its shape. A standing error of 1, 2, 5, 10, 20 mrad
    slows by 1.01, 1.04, 1.25, 2, 5: set `e0` above the level of sensors, friction and delay.

    Attributes
    ----------
    dmp : the primitive.
    kp, kv : gains on position [1/s^2] and velocity [1/s]. kc : of the slow-down. alpha_e : of the filter [1/s].
    e0 : dead zone, one number or (n,), in the unit of y. e_scale : error that counts as 1 in kc, as e0.
    e_max : error |ya - yc| / e_scale beyond which the path stands still until it is below 0.8 of it.

    Raises
    ------
    ShapeError : gains below 0, e_scale or e_max not above 0, other shapes, NaN.

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
        """Check and freeze."""
        if not isinstance(self.dmp, Dmp):
            raise ShapeError(f"Expected a Dmp, got {type(self.dmp).__name__}. Fit one by motion.fit_dmp.")
        for name in ("kp", "kv", "kc", "alpha_e"):
            if not 0.0 <= number(getattr(self, name), name) < np.inf:
                raise ShapeError(f"Expected a finite {name} of at least 0, got {getattr(self, name)}.")
        if not number(self.e_max, "e_max") > 0.0:
            raise ShapeError(f"Expected e_max above 0, got {self.e_max}. Infinity never freezes.")
        for name in ("e0", "e_scale"):
            values = numbers(getattr(self, name), name, ShapeError)
            if values.shape not in ((), (self.dmp.n,)):
                raise ShapeError(f"Expected {name} as one number or {self.dmp.n}, got shape {values.shape}.")
            least = 0.0 if name == "e0" else np.finfo(float).tiny
            if not ((values >= least) & np.isfinite(values)).all():
                raise ShapeError(f"Expected {name} {'of at least' if name == 'e0' else 'above'} 0, got {values}.")
            frozen = np.array(np.broadcast_to(values, (self.dmp.n,)))
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)

    def law(self, run: Setting) -> Any:
        """Return the `armlab.kernels.TwoDof` of a run.

        Parameters
        ----------
        run : start, goal and duration, resolved.
        """
        gains = np.array([self.kp, self.kv, self.kc, self.alpha_e, self.e_max])
        zone, unit = np.asarray(self.e0), np.asarray(self.e_scale)
        return kernels.TwoDof(run.primitive, run.tau, run.y0, run.g, run.scale, gains, zone, unit)

    def simulate(
        self,
        t: ArrayLike = LONGEST_STEP,
        events: Sequence[Push | Displace | Plant] = (),
        *,
        dt: float = LONGEST_STEP,
        **run: Unpack[RunOptions],
    ) -> TwoDofRun:
        """Simulate an arm that does what it is told, ``ya'' = ya_ref''``, but for what happens to it.

        Steps are of fourth order and end at every event, never across one.

        Parameters
        ----------
        t : (N,) increasing times [s], the motion starts at the first; or one step [s] until the end of the motion.
        events : `Hold`, `Push`, `Displace`; and at most one plant, ``(t, ya, ya', ya_ref'') -> ya''``, in place of the
            perfect arm.
        dt : longest step of the solution [s].
        **run : as in `Dmp.rollout`. The arm starts on the path, with its velocity.

        Raises
        ------
        ShapeError : as in `Dmp.rollout`; events that contradict each other; a plant that gives no accelerations.
        ConfigError : both duration and tau_d.
        """
        longest = positive(dt, "dt", "At 250 Hz it is 0.004.")
        setting, free = Setting.of(self.dmp, **run), _free(self.dmp, t, longest, run)
        law = self.law(setting)
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
        """Return what a log says of a run with `controller`, beside the primitive undisturbed; times begin at 0.

        Parameters
        ----------
        table : of ``link.run(controller, extra=controller.columns())``; rows without a path are left out.
        disturbed : (t0, t1) of each time when something held or pushed the arm, as far as that is known [s].
        duration, g, amplitude : as they were given to the controller.

        Raises
        ------
        UnknownName : a column that the controller records is missing. ShapeError : no row with a path.
        """
        begun = np.asarray(np.isfinite(table["path"]).all(axis=1))
        if not begun.any():
            raise ShapeError("Expected a log with a path, got none. The controller was never asked.")
        rows = table.where(begun)
        t = rows.t - rows.t[0]
        run: RunOptions = {"duration": duration, "g": g, "amplitude": amplitude}
        run |= {"y0": rows["q"][0], "v0": np.zeros(self.dmp.n)}
        free = _free(self.dmp, t, LONGEST_STEP, run)
        return TwoDofRun(
            t=t,
            yc=rows["path"],
            ycd=rows["path_qd"],
            ycdd=rows["path_qdd"],
            ya=rows["q"],
            yad=rows["qd"],
            ydd_ref=rows["qdd_ref"],
            e=rows["path_error"],
            x=rows["phase"],
            tau_a=rows["tau_a"],
            frozen=rows["frozen"].astype(bool),
            free=free,
            disturbed=tuple(disturbed),
        )

    def stepper(self, **run: Unpack[RunOptions]) -> TwoDofStepper:
        """Return what runs the law sample by sample with a measured arm.

        Parameters
        ----------
        **run : as in `Dmp.rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `Dmp.rollout`.
        """
        return TwoDofStepper(self, Setting.of(self.dmp, **run))

    def controller(
        self,
        robot: Arms,
        *,
        limits: Limits | Sequence[Limits] | None = None,
        duration: float | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
        give_way: Callable[[State], np.ndarray] | None = None,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge`, which starts where the arm is, at rest.

        Parameters
        ----------
        robot : the arm whose joints the coordinates are, or several arms whose joints are one after another.
        limits : what has q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`, one per arm;
            those of the robots when None.
        duration, g, amplitude : as in `Dmp.rollout`.
        give_way : acceleration (n,) that a contact adds to the reference, for an arm that does not yield by itself:
            for example ``lambda state: J(state.q).T @ force(state) / inertia``.

        Raises
        ------
        ShapeError : a primitive of another number of joints, a goal outside the limits. ConfigError : as `Dmp.rollout`.
        """
        from armlab.motion.controllers import TwoDofController

        settings: Mapping[str, Any] = {"duration": duration, "g": g, "amplitude": amplitude}
        return TwoDofController(robot, self, settings, limits, give_way)


def _free(dmp: Dmp, t: ArrayLike, longest: float, given: RunOptions) -> Rollout:
    """Return the primitive undisturbed at times t, solved in steps of at most `longest`."""
    times = dmp.rollout(t, **given).t
    if not times[-1] - times[0] < longest * MOST_SAMPLES:
        raise ShapeError(f"Expected less than {MOST_SAMPLES} steps, got more at dt = {longest:g} s. Take a longer dt.")
    if len(times) < 2:
        return dmp.rollout(times, **given)
    parts = np.maximum(np.ceil(np.diff(times) / longest - 1e-9), 1).astype(int)
    fine = [np.linspace(a, b, k, endpoint=False) for a, b, k in zip(times, times[1:], parts)]
    found = dmp.rollout(np.append(np.concatenate(fine), times[-1]), **given)
    kept = np.concatenate([[0], np.cumsum(parts)])
    return Rollout(times, *(getattr(found, f.name)[kept] for f in fields(Rollout)[1:]))

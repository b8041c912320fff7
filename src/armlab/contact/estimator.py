"""Causal estimation of the contact wrench from joint motion and torque at the control rate.

Static methods use ``tau_e = model - measured = J^T F + error``, low-pass filtered at the model's cut-off frequency, and
its velocity-dependent covariance C_tau(qd).

"map"       maximum a posteriori F for F ~ N(0, C_F): ``S = J^T C_F J + C_tau, K = C_F J S^-1, F = K tau_e``. Valid at
            singular poses, where unobservable directions keep the prior. Shrinkage causes the bias ``(I - K J^T) F``.
"bounded"   treats friction near rest as bounded rather than random, and minimises
            ``sum max(|tau_e - J^T F| - D, 0)^2 / s^2 + F^T C_F^-1 F`` by semismooth Newton (after Linderoth, Stolt,
            Robertsson and Johansson, IROS 2013). Reports a contact only if friction cannot explain the torques, and
            does not drift at rest. Joints within their bounds contribute nothing.
"interval"  like "bounded", plus the guaranteed interval of every axis for |friction error| <= D, |noise| <= 3 s and
            torque gains within 3 standard deviations, by linear programming.
"clip"      like "bounded", by a method that is easy to audit but needs thousands of iterations. For comparison only.
"ls"        weighted least squares without a prior. For comparison only; estimates become huge near singular poses.
"ols"       same as "ls" without weights, ``(J J^T)^-1 J tau_e``: TFRT-7651, eq. (1). For comparison only.
"lund"      ``(J C_tau J^T + C_F^-1)^-1 J C_tau tau_e`` as printed in TFRT-7651, eq. (2). For comparison only; using a
            covariance instead of a weight gives the noisiest joint the largest weight. The sign is armlab's; F_ext in
            the report is -F.

Momentum methods need no acceleration: ``p = M qd``, ``dp/dt = u + J^T F``, ``u = tau + C^T qd - G - friction``.

"observer"  ``r <- r + (1 - e^(-K h)) (dp/h - u - r)`` is the low-pass filtered J^T F; F is then computed as in "map"
            (De Luca and Mattone 2003).
"kf"        Kalman filter for momentum and wrench; the wrench is a leaky random walk (Wahrburg et al. 2015, 2018).
            With ``bias``, the unknown friction after a stop is an additional state, and `tare` separates it from
            contact.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from threading import get_ident
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown, brief
from armlab._numbers import number, numbers
from armlab.errors import ConcurrentUse, ConfigError, ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation.fit import Fit, value_of
from armlab.log import Table
from armlab.log.units_check import check_known
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.friction import Friction, FrictionBound
from armlab.models.uncertainty import FORCE_RATES, PRIOR
from armlab.robots import Robot
from armlab.robots.robot import arm_length
from armlab.state import State

INVALID = 1
"""The sample was not finite; the estimate is NaN."""
WEAK = 2
"""At least one axis has an observability below 0.5, so the prior outweighs the torques."""
STUCK = 4
"""Every joint torque is within its friction bound; only bounds on the wrench are known."""
INFEASIBLE = 8
"""No wrench explains the torques within their bounds; the contact point or the model is wrong."""
SINGULAR = 16
"""Without a prior, this pose does not determine the wrench; the estimate is NaN."""
TARED = 32
"""`Estimator.tare` separated friction from contact, and every joint has stayed in place since."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Wrench(Shown):
    """Wrench [f; m] exerted by the environment on the robot, in base axes at the tool point.

    Attributes
    ----------
    wrench : (6,) estimate [N, N m].
    cov : (6, 6) posterior covariance, including the uncertainty of the torque gains.
    observability : (6,) 1 - posterior variance / prior variance, in [0, 1], for known gains.
    torque_error : (n,) filtered model minus measured torque [N m]; for "kf", the part explained by the estimate.
    torque_variance : (n,) variance of `torque_error`.
    prior : (6,) prior variances of the unknowns: the wrench, or a force at a known point (the last three unused).
    flags : bits INVALID, WEAK, STUCK, INFEASIBLE, SINGULAR, TARED.
    active : (n,) joints that contribute; with INFEASIBLE, the joints that contradict each other.
    interval : (6, 2) guaranteed smallest and largest value per axis, for the method "interval".
    at_point : True for a contact at a known point, which has three unknowns instead of six.
    tared_at : time of the active tare [s], or None.
    """

    wrench: np.ndarray
    cov: np.ndarray
    observability: np.ndarray
    torque_error: np.ndarray
    torque_variance: np.ndarray
    prior: np.ndarray
    flags: int
    active: np.ndarray
    interval: np.ndarray | None = None
    at_point: bool = False
    tared_at: float | None = None

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation per axis (6,) [N, N m]."""
        return np.sqrt(np.diag(self.cov))

    @property
    def cond(self) -> float:
        """Condition number of C_tau^-1/2 J^T C_F^1/2, which is the anisotropy of the observability; inf if singular."""
        shares = self._spectrum()[0]
        if not np.isfinite(shares).all():
            return float("nan")
        gains = np.maximum(1.0 / np.clip(shares, 1e-300, 1.0) - 1.0, 0.0)  # squared singular values
        return float(np.sqrt(gains.max() / gains.min())) if gains.min() > 0 else float("inf")

    @property
    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Observability (k,) of k orthogonal directions (worst first), and the directions as columns (k, k).

        Directions are in prior-scaled axes and are the eigenvectors of ``C_F^-1/2 P C_F^-1/2``; k is 6, or 3 at a known
        point.
        """
        shares, vectors = self._spectrum()
        return np.maximum(1.0 - shares[::-1], 0.0), vectors[:, ::-1]

    @property
    def hidden(self) -> np.ndarray:
        """Unit direction (k,) with the lowest observability in prior-scaled axes; NaN for an invalid sample."""
        return self._spectrum()[1][:, -1]

    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ratios of posterior to prior variance (k,), ascending, and their directions as columns."""
        k = 3 if self.at_point else 6
        cov, scale = self.cov[:k, :k], np.sqrt(self.prior[:k])
        if not np.isfinite(cov).all():
            return np.full(k, np.nan), np.full((k, k), np.nan)
        shares, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
        return shares, vectors


def contact_point(point: ArrayLike, robot: Robot) -> np.ndarray:
    """Validate a contact point and return a copy (3,)."""
    place = np.array(numbers(point, "the contact point", ShapeError))
    if place.shape != (3,) or not np.all(np.isfinite(place)):
        raise ShapeError(f"Expected the contact point to be three finite numbers [m] in tool axes, got {point!r}.")
    check_distance(place[None], robot)
    return place


def check_distance(places: np.ndarray, robot: Robot) -> None:
    """Reject points farther from the tool than the length of the arm; such points are usually in millimetres."""
    far, length = float(np.linalg.norm(places, axis=1).max(initial=0.0)), arm_length(robot)
    if far > length:
        raise ShapeError(
            f"Expected a contact point within {length:.3g} m of the tool, the length of {robot.name!r}, got a point "
            f"{far:.4g} m away. Pass metres in tool axes; divide millimetres by 1000."
        )


Method = Literal["map", "bounded", "clip", "interval", "ls", "lund", "ols", "observer", "kf"]
METHODS = get_args(Method)
STATIC = METHODS[: METHODS.index("observer")]  # in the order of the kernel's `WrenchMethod`
GAIN = 30.0  # 1/s, gain of the observer
PARTS = 100  # progress reports per log
TARE, MEMORY = 0.5, 0.1  # s: shortest tare; correlation time of errors
STAYS = 0.5  # minimum SD after a tare, relative to the SD at rest; 1.0 made a Panda's bands twice as wide as needed


class Estimator:
    """Estimator of the contact wrench, sample by sample or for a whole log.

    `step` and `run` call the same kernel and return bitwise equal results for equal rows. All methods are causal.
    Static methods use a second-order residual filter at the model's cut-off (10 Hz: 22 ms delay), the observer uses a
    first-order filter (33 ms), and the delay of the Kalman filter follows from the covariances.

    Create one estimator per thread; if two threads shared an estimator, its filter would mix their samples. Another
    thread may take over an estimator; `step` then raises `ConcurrentUse` in earlier threads until `reset`. A copy has
    the same state; an unpickled estimator starts in the reset state.

    Parameters
    ----------
    model : TorqueModel or Fit
        Identified torque model or its fit.
    robot : Robot
        Arm to which the model belongs.
    method : str
        See the module docstring; "map" and "kf" are for motion, "bounded" and "interval" for an arm that may stop.
    prior : array_like, shape (6,), optional
        Standard deviations of the wrench before any measurement [N, N m]. Default: 20 N and 2 N m. At a known point,
        only the first three components (force) are used.
    point : array_like, shape (3,), optional
        Known contact point in tool axes [m], which reduces the unknowns from six to three. A correct contact point
        halves the error; a wrong point doubles it.
    force_rate : {"smooth", "normal", "fast"} or array_like, shape (6,), optional
        Random-walk intensity of the wrench for "kf" [N/sqrt(s), N m/sqrt(s)]: "smooth" is 2 and 0.2, "normal"
        (default) is 5 and 0.5, "fast" is 20 and 2.
    leak : float or array_like, shape (6,), optional
        For "kf": decay rate of the wrench [1/s]; 0 gives a pure random walk. By default, unobserved directions keep
        the prior uncertainty.
    gain : float, optional
        For "observer": gain [1/s]. Default: 30.
    bias : bool
        For "kf": add a friction error per joint as a state that is constant while the joint rests.

    Raises
    ------
    ModelMismatchError
        The model belongs to another robot, or lacks the noise model that momentum methods need.
    UnknownName
        The method or the rate name is unknown.
    ShapeError
        The prior, rate, leak or gain is not positive, or the point is not finite or is farther from the tool than the
        length of the arm.
    ConfigError
        An option belongs to another method.

    Examples
    --------
    >>> estimator = Estimator(models.load("model.toml"), robot)  # doctest: +SKIP
    >>> estimator.step(state).wrench  # doctest: +SKIP
    """

    def __init__(
        self,
        model: TorqueModel | Fit[TorqueModel],
        robot: Robot,
        method: Method = "map",
        prior: ArrayLike | None = None,
        point: ArrayLike | None = None,
        *,
        force_rate: ArrayLike | Literal["smooth", "normal", "fast"] | None = None,
        leak: ArrayLike | None = None,
        gain: float | None = None,
        bias: bool = False,
    ) -> None:
        model = value_of(model)
        if not isinstance(model, TorqueModel):
            raise ModelMismatchError.no_model(model)
        model.check_robot(robot)
        if method not in METHODS:
            raise UnknownName.among("estimation method", method, METHODS)
        options = {"kf": {"force_rate": force_rate, "leak": leak, "bias": bias or None}, "observer": {"gain": gain}}
        _refuse_idle(method, options)
        deviations = _positive(
            PRIOR if prior is None else prior, "standard deviations [N, N, N, N m, N m, N m] as prior"
        )
        if point is not None:
            point = contact_point(point, robot)
        variances = deviations**2
        variances.flags.writeable = False
        self._robot, self._prior, self._at_point = robot, variances, point is not None
        options = {"force_rate": force_rate, "leak": leak, "gain": gain, "bias": bias}
        self._with = partial(Estimator, robot=robot, method=method, prior=prior, point=point, **options)
        self._model = model
        self._method, self._tare = method, None
        if method in STATIC:
            self._kernel = model.estimator_kernel(variances, STATIC.index(method), point)
        else:
            rate, leaks = _walk(force_rate, leak)
            gain = float(_positive(GAIN if gain is None else gain, "gain [1/s] of the observer", ()))
            kernel = model.momentum_kernel(variances, rate, leaks, gain, method == "kf", bias, point)
            self._kernel, self._tare = kernel, kernel.tare if bias else None
        self._running = False
        self._forget()

    def __repr__(self) -> str:
        return f"Estimator({self._model.robot_name!r}, method={self._method!r}, prior={brief(np.sqrt(self._prior))})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the model and options; the unpickled estimator starts in the reset state."""
        return self._with, (self._model,)

    def __copy__(self) -> Estimator:
        """Return an estimator with the same state, for another thread."""
        self._refuse_running()
        made = self._with(self._model)
        made._kernel = copy(self._kernel)
        made._tare = self._tare and getattr(made._kernel, "tare", None)
        made._t, made._missed, made._tared_at = self._t, self._missed, self._tared_at
        return made

    def __deepcopy__(self, memo: dict[int, Any]) -> Estimator:
        return copy(self)

    @property
    def prior(self) -> np.ndarray:
        """Prior variances (6,) [N^2, (N m)^2]."""
        return self._prior

    @property
    def method(self) -> str:
        """Estimation method."""
        return self._method

    def reset(self) -> None:
        """Reset all state: filter, presliding, tare and thread ownership.

        Raises
        ------
        ConcurrentUse : another thread is in `run`.
        """
        self._refuse_running()
        self._kernel.reset()
        self._forget()

    def step(self, state: State) -> Wrench:
        """Advance by one state and return the wrench.

        A non-finite sample, or one whose torque overflows, yields NaN and does not change the state. The next time step
        starts at the last valid sample.

        Parameters
        ----------
        state : with t, dt and q, qd, tau (n,).

        Raises
        ------
        ConcurrentUse : another thread has taken over, or is in `run`.
        """
        if get_ident() != self._thread:
            self._take_over()
        dt = state.dt
        if self._missed and dt > 0 and state.t > self._t:
            dt = state.t - self._t
        F, cov, observability, error, variance, flags, active, interval = self._kernel.step(
            state.q, state.qd, state.tau, dt
        )
        self._missed = bool(flags & INVALID)
        if not self._missed:
            self._t = state.t
        tared_at = self._tared_at if flags & TARED else None
        return Wrench(
            F, cov, observability, error, variance, self._prior, flags, active, interval, self._at_point, tared_at
        )

    def tare(self) -> None:
        """Declare that there is no contact now; the torque error is then attributed to friction.

        The tare conditions the state on a zero wrench. The tare remains valid as long as no joint moves. Once a joint
        moves by more than its presliding distance, its friction changes: the friction error is discarded and the flag
        TARED is cleared.

        Raises
        ------
        ConfigError : the estimator was not made with ``method="kf"`` and ``bias=True``.
        NotExcited : a joint moves or has rested for less than 0.4 s.
        ConcurrentUse : another thread is in `run`.
        """
        if self._tare is None:
            raise ConfigError(
                f"Expected an estimator with method='kf' and bias=True to tare, got method={self._method!r} without a "
                "friction state. Create an estimator with these options."
            )
        self._refuse_running()
        if not self._tare():
            raise NotExcited(
                "Expected every joint at rest for 0.4 s to tare, got motion or no sample. Stop the arm, wait, and "
                "tare.",
                ["friction at rest"],
            )
        self._tared_at = self._t

    def run(
        self,
        table: Table,
        *,
        tare: float | slice | None = None,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> Table:
        """Return the table with the estimate of every row.

        Columns: wrench_hat, wrench_hat_cov, observability, tau_error, tau_variance, wrench_flags, wrench_active, and
        wrench_interval (6, 2) for the method "interval".

        Parameters
        ----------
        table : log with columns q, qd, tau (N, n).
        tare : duration from the start [s], or slice of rows, in which the arm rests without contact. The torque error
            in this interval is attributed to friction while every joint stays within its presliding distance. The
            torque standard deviation decreases by up to half. Tared rows have the flag TARED.
        progress : called with (rows done, total rows, description).

        Raises
        ------
        ShapeError : `table` is not a table, its joint count differs from the model's, or its positions are in degrees
            or on the motor side.
        NotExcited : joints move while no torque changes (torque not measured); or the arm moves during the tare, or
            rests for less than 0.5 s.
        ConcurrentUse : another thread is in `run`.
        """
        if tare is not None:
            return self._tared(table, tare, progress)
        if not isinstance(table, Table):
            raise ShapeError.no_table(table)
        q, qd, tau = (np.ascontiguousarray(table[name], dtype=float) for name in ("q", "qd", "tau"))
        if q.shape != (len(table), self._robot.n):
            raise ShapeError(
                f"Expected q of shape ({len(table)}, {self._robot.n}), got {q.shape}. "
                "Pass a log of the robot to which the model belongs."
            )
        check_known(q, tau, self._robot)
        found = self._run(q, qd, tau, np.ascontiguousarray(table.dt), progress)
        missed = (found[5] & INVALID) > 0
        if missed.any():  # the time step of the next row starts at the last valid row, as in `step`
            found = self._run(q, qd, tau, _bridged(table, missed), progress)
        F, cov, observability, error, variance, flags, active, interval = found
        table = (
            table.with_column("wrench_hat", F)
            .with_column("wrench_hat_cov", cov)
            .with_column("observability", observability)
            .with_column("tau_error", error)
            .with_column("tau_variance", variance)
            .with_column("wrench_flags", flags)
            .with_column("wrench_active", active.astype(np.int64))
        )
        return table if interval is None else table.with_column("wrench_interval", interval)

    def _tared(self, table: Table, tare: float | slice, tell: Callable[[int, int, str], None] | None) -> Table:
        """Return the estimates of `run`, with the tare applied while no joint moves."""
        plain = self.run(table, progress=tell)
        model, shift, rows = tared(self._model, self._robot, table, tare)
        rested = self._with(model).run(table.with_column("tau", table["tau"] + shift), progress=tell)
        there = np.zeros(len(table), dtype=bool)
        there[rows] = True
        rested = rested.with_column("wrench_flags", rested["wrench_flags"] | TARED)
        for name in rested.names:
            if name.startswith(("wrench_", "tau_", "observability")):
                chosen = there.reshape(-1, *[1] * (rested[name].ndim - 1))
                plain = plain.with_column(name, np.where(chosen, rested[name], plain[name]))
        return plain

    def _run(
        self,
        q: np.ndarray,
        qd: np.ndarray,
        tau: np.ndarray,
        dt: np.ndarray,
        tell: Callable[[int, int, str], None] | None,
    ) -> tuple[Any, ...]:
        """Run the kernel over all rows, in parts if progress is reported."""
        self.reset()
        self._take_over()
        self._running = True  # the kernel releases the GIL
        try:
            rows, parts = len(dt), []
            if tell is None or rows < PARTS:
                return self._kernel.run(q, qd, tau, dt)
            for a, b in pairwise(np.linspace(0, rows, PARTS + 1).astype(int)):
                tell(int(a), rows, f"{self._method} estimate of {rows} rows")
                parts.append(self._kernel.run(q[a:b], qd[a:b], tau[a:b], dt[a:b]))
            tell(rows, rows, "done")
            return tuple(None if values[0] is None else np.concatenate(values) for values in zip(*parts))
        finally:
            self._running = False

    def _forget(self) -> None:
        self._t, self._missed, self._tared_at = float("nan"), False, None
        self._thread, self._earlier = 0, set[int]()

    def _refuse_running(self) -> None:
        if self._running:
            raise ConcurrentUse(
                "Expected one thread at a time to use an Estimator, but another thread is in run(). Create one "
                "estimator per thread."
            )

    def _take_over(self) -> None:
        """Make this thread the owner; previous owners are locked out until a reset."""
        self._refuse_running()
        self._earlier.add(self._thread)
        self._thread = 0  # the state is mixed: reject every thread until a reset
        if get_ident() in self._earlier:
            raise ConcurrentUse(
                "Expected one thread at a time to use an Estimator, got samples from two alternating threads. Create "
                "one estimator per thread, or call reset() before another thread takes over."
            )
        self._thread = get_ident()


def tared(model: TorqueModel, robot: Robot, table: Table, tare: float | slice) -> tuple[TorqueModel, np.ndarray, slice]:
    """Return the model of a tared arm at rest, the torque correction (n,), and the rows in which both are valid."""
    if isinstance(tare, slice):
        span = slice(*tare.indices(len(table))[:2])
    else:
        seconds = number(tare, "the tare duration [s]", ShapeError)
        span = slice(0, int(np.searchsorted(table.t, table.t[0] + seconds)))
    free = replace(Friction.none(model.n), delta=model.friction.delta, resolution=model.friction.resolution)
    rested = replace(model, friction=free, friction_map=None, warm_up=None, parameters=None)  # constant errors at rest
    error = Estimator(rested, robot).run(table)["tau_error"][span]
    t, q = table.t[span], table["q"][span]
    error, steps = error[np.isfinite(error).all(axis=1)], np.ptp(q, axis=0) if len(q) else np.full(model.n, np.inf)
    slack = np.maximum(model.friction.delta, 2.0 * model.friction.resolution)
    if len(error) < 2 or t[-1] - t[0] < TARE or np.any(steps > slack):
        seconds, moved = (t[-1] - t[0] if len(t) else 0.0), np.flatnonzero(steps > slack) + 1
        raise NotExcited(
            f"Expected an arm at rest for at least {TARE} s to tare, got {seconds:.2g} s"
            + (f" in which joints {', '.join(map(str, moved))} move" if len(moved) else "")
            + ". Pass a segment in which the arm rests without contact.",
            ["friction at rest"],
        )
    samples = (t[-1] - t[0]) / MEMORY
    spread = np.var(error, axis=0) * (1.0 + 1.0 / samples) * (samples - 1.0) / (samples - 3.0)  # Student's t
    spread = np.maximum(spread, STAYS**2 * model.covariance.variance(np.zeros(model.n)))
    away = np.any(np.abs(table["q"] - np.median(q, axis=0)) > slack, axis=1)
    before, after = np.flatnonzero(away[: span.start]), np.flatnonzero(away[span.stop :])
    first = int(before[-1]) + 1 if len(before) else 0
    rows = slice(first, span.stop + int(after[0]) if len(after) else len(table))
    momentum = model.momentum and replace(model.momentum, alpha2_kf=1.0, alpha2_observer=1.0)
    still = FrictionBound(np.zeros(model.n), model.bound.speed, 2.0 * np.sqrt(spread))
    covariance = velocity_covariance("const", spread, spread)
    rested = replace(rested, covariance=covariance, bound=still, momentum=momentum)
    return rested, model.gains * error.mean(axis=0), rows


def _refuse_idle(method: str, options: dict[str, dict[str, object]]) -> None:
    """Reject options that have no effect with the chosen method."""
    for owner, values in options.items():
        given = [name for name, value in values.items() if value is not None]
        if given and method != owner:
            raise ConfigError(
                f"Expected {', '.join(given)} with method={owner!r} only, got method={method!r}. Omit "
                f"{', '.join(given)}, or use method={owner!r}."
            )


def _positive(values: ArrayLike, what: str, shape: tuple[int, ...] = (6,)) -> np.ndarray:
    found = numbers(values, what, ShapeError)
    if found.shape != shape or not np.all(np.isfinite(found)) or not np.all(found > 0):
        count = "six positive" if shape else "a positive"
        raise ShapeError(f"Expected {count} {what}, got {values!r}. Pass the expected magnitude.")
    return found


def _walk(force_rate: ArrayLike | str | None, leak: ArrayLike | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the intensity [N^2/s, (N m)^2/s] and leak [1/s] of the wrench's random walk, each (6,)."""
    if force_rate is None or isinstance(force_rate, str):
        name = force_rate or "normal"
        if name not in FORCE_RATES:
            raise UnknownName.among("force rate", name, FORCE_RATES)
        force_rate = FORCE_RATES[name]
    rate = _positive(force_rate, "rates [N/sqrt(s) and N m/sqrt(s)] as force_rate") ** 2
    if leak is None:
        return rate, None
    leaks = numbers(leak, "the leak [1/s]", ShapeError)
    if leaks.shape not in ((), (6,)) or not np.all(np.isfinite(leaks)) or not np.all(leaks >= 0):
        raise ShapeError(f"Expected a leak of one or six non-negative numbers [1/s], got {leak!r}. Correct the leak.")
    return rate, np.array(np.broadcast_to(leaks, 6))


def _bridged(table: Table, missed: np.ndarray) -> np.ndarray:
    """Return the time (N,) from the last valid row to each row."""
    rows, dt = np.arange(len(table)), np.array(table.dt)
    last = np.concatenate([[-1], np.maximum.accumulate(np.where(missed, -1, rows))[:-1]])
    after = ~missed & (last >= 0) & (last < rows - 1) & (dt > 0)
    dt[after] = table.t[after] - table.t[last[after]]
    return dt

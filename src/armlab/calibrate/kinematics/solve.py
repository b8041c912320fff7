"""Solution shared by one arm and two: descent, identifiability, covariance without the gauge."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from armlab._numbers import numbers
from armlab.calibrate.kinematics.identifiability import Judgement, UnobservableDirection, spread_covariance
from armlab.calibrate.kinematics.measurements import Kind
from armlab.errors import ConfigError, NotConverged, NotExcited, UnknownName
from armlab.estimation import Excitation, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.nonlinear import NonlinearSolution

SCHEDULE = (1000.0, 300.0, 100.0, 30.0, 10.0)
UNIT = 1e-3  # 1 mm and 1 mrad: of equal steps the smallest is taken
WEAK = ("refuse", "prior")
MISFIT = 0.1  # of the size of what was measured, or of half a turn: these samples do not belong together
NO_NOISE = 1e-12  # m or rad: records that repeat themselves have none
ROUNDING = 1e-9  # of the largest coordinate: what moves less does not move
NOBODY = np.zeros(0, dtype=int)

S = TypeVar("S")


class Residuals(Protocol[S]):
    """Residuals of kinematic measurements at a state, with named unknowns; see `KinematicProblem`."""

    @property
    def kinds(self) -> tuple[Kind, ...]: ...
    @property
    def active(self) -> np.ndarray: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...
    @property
    def waves(self) -> int: ...
    def sizes(self, length: float, angle: float) -> np.ndarray: ...
    def gauge(self, state: S, used: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]: ...
    def evaluate(self, state: S) -> list[Measurement]: ...
    def retract(self, state: S, y: np.ndarray) -> S: ...
    def measurements(self, state: S, local: bool = False) -> list[Measurement]: ...
    def priors(self, state: S, local: bool = False) -> Iterator[Measurement]: ...


@dataclass(frozen=True, eq=False)
class Question(ABC, Generic[S]):
    """One estimation problem: descent, identifiability and covariance."""

    problem: Residuals[S]  # residuals
    used: np.ndarray  # (d,) unknowns there are, gauge included
    limits: tuple[float, float]  # (metres, radians) that are accepted
    hold: bool  # go on where they are exceeded

    @abstractmethod
    def nature(self, state: S) -> list[UnobservableDirection]:
        """Return directions that these kinds of measurement may never see."""

    @abstractmethod
    def suspects(self, state: S) -> list[UnobservableDirection]:
        """Return directions that the data may fail to see."""

    @abstractmethod
    def spaces(self) -> list[float]:
        """Return the size [m] of the space in which each measurement was made."""

    def solve(self, start: S, robust: bool) -> NonlinearSolution[S]:
        """Descend; where that fails, name the unidentifiable direction if there is one."""
        problem = self.problem
        self._check_count(start)
        task = NonlinearProblem(problem.evaluate, problem.retract, problem.sizes(UNIT, UNIT)[problem.active], "arm")
        try:
            found = nonlinear_least_squares(task, start, robust=robust, schedule=SCHEDULE)
        except NotConverged as error:
            self.judge(problem.measurements(start, local=True), start, dict.fromkeys(_classes(problem), UNIT))
            check_misfit(problem.measurements(error.best), self.spaces(), error.best)
            raise
        self._check_majority(found)
        return found

    def _check_majority(self, found: NonlinearSolution[S]) -> None:
        """Refuse an arm that most samples contradict: as few of them as there are unknowns always fit exactly."""
        out = int(np.count_nonzero(found.outliers))
        if not out:
            return
        seen = np.unique(np.concatenate([one.sample for one in self.problem.measurements(found.value)]))
        if 2 * out > len(seen):
            raise NotConverged(
                f"Expected most samples to fit one arm, got {out} of {len(seen)} that do not. Check that samples and "
                "joint positions belong together, units, the order of the joints, and that the noise that was given is "
                "not too small.",
                best=found.value,
                history=found.history,
                reason="mismatch",
            )

    def _check_count(self, start: S) -> None:
        """Refuse fewer numbers than unknowns."""
        problem, used = self.problem, self.used
        got, each = sum(kind.numbers for kind in problem.kinds), sum(len(kind.kept) for kind in problem.kinds)
        if self.hold or got > np.count_nonzero(used):
            return
        G, _ = problem.gauge(start, used)
        needed = int(np.count_nonzero(used)) - int(np.linalg.matrix_rank(G[used]))
        data = problem.measurements(start, local=True)
        needed -= sum(never_moves(self.nature(start), data, used))
        needed -= problem.waves  # their prior is enough
        needed += any(kind.cov is None for kind in problem.kinds)
        if got < needed:
            raise NotExcited(
                f"Expected at least {needed} numbers for the unknowns of the arm, got {got}. Measure at least "
                f"{-(-needed // each)} samples, better twice as many.",
                ["everything"],
                [f"{got} of {needed} numbers"],
            )

    def match(self, found: NonlinearSolution[S]) -> list[str]:
        """Return what a report says of the noise that was given, if it was."""
        if any(kind.cov is None for kind in self.problem.kinds) or not found.freedom:
            return []
        return [f"residuals {np.sqrt(2.0 * found.cost / found.freedom):.3g} times the noise that was given"]

    def judge(
        self, data: Sequence[Measurement], state: S, sigma: dict[str, float], outside: np.ndarray = NOBODY
    ) -> Excitation:
        """Return the excitation at a state, or refuse."""
        problem, used = self.problem, self.used
        sigma = {name: max(size, NO_NOISE) for name, size in sigma.items()}
        G, gauge_names = problem.gauge(state, used)
        judgement = Judgement(
            names=[name for name, mine in zip(problem.names, used) if mine],
            units=[unit for unit, mine in zip(problem.units, used) if mine],
            limits=problem.sizes(*self.limits)[used],
            gauge=G[used],
            gauge_names=gauge_names,
            nature=_inside(self.nature(state), used),
            suspects=lambda: _inside(self.suspects(state), used),
            what="arm",
        )
        return judgement.excitation(np.concatenate(list(_whitened(data, sigma, outside)))[:, used], self.hold)

    def covariance(
        self,
        data: Sequence[Measurement],
        state: S,
        sigma: dict[str, float],
        outside: np.ndarray,
        excitation: Excitation,
    ) -> np.ndarray:
        """Return the covariance (p, p) of what is used, zero along gauge and unidentifiable directions."""
        priors, limits = list(self.problem.priors(state, local=True)), self.problem.sizes(*self.limits)[self.used]
        if not priors:
            return spread_covariance(excitation.vectors, excitation.spread, limits)
        rows = np.concatenate(list(_whitened([*data, *priors], sigma, outside)))[:, self.used] * limits
        G = self.problem.gauge(state, self.used)[0][self.used] / limits[:, None]
        whole = np.eye(len(limits)) if not G.shape[1] else np.linalg.svd(G, full_matrices=True)[0][:, G.shape[1] :]
        _, singular, V = np.linalg.svd(np.linalg.qr(rows @ whole, mode="r"))
        seen = singular > 1e-9 * singular[0]
        return spread_covariance(whole @ V[seen].T, 1.0 / singular[seen], limits)


def _classes(problem: Residuals[Any]) -> list[str]:
    return [name for kind in problem.kinds for name in kind.classes]


def _inside(suspects: Sequence[UnobservableDirection], used: np.ndarray) -> list[UnobservableDirection]:
    """Return directions that move something that is used, cut to it."""
    found = [UnobservableDirection(one.name, one.directions[used], one.advice) for one in suspects]
    return [one for one in found if np.abs(one.directions).max(initial=0.0) > 0]


def check_misfit(data: Sequence[Measurement], sizes: Sequence[float], best: Any, outside: np.ndarray = NOBODY) -> None:
    """Refuse samples that do not belong together.

    `sizes` are those of the space [m] in which each was measured; 0 for one that did not move.
    """
    for one, size in zip(data, sizes):
        kept = one.r[_kept(one, outside)]
        for unit, space in (("m", size), ("rad", np.pi)):
            off = kept[:, [name.endswith(f"[{unit}]") for name in one.classes]]
            rms = float(np.sqrt(np.mean(off**2))) if off.size else 0.0
            if rms > MISFIT * space > 0.0 and len(kept) > 3:
                raise NotConverged(
                    f"Expected an arm that fits the measurements, got residuals of {rms:.3g} {unit} in a space of "
                    f"{space:.3g} {unit}. Check units, the order of the joints, and whether samples and joint "
                    "positions belong together.",
                    best=best,
                    reason="mismatch",
                )


def spread_of(points: np.ndarray) -> float:
    """Return the root mean square distance of points (N, 3) from their mean; 0 where that is rounding."""
    if not len(points):
        return 0.0
    spread = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1))))
    return spread if spread > ROUNDING * float(np.abs(points).max()) else 0.0


def never_moves(suspects: Sequence[UnobservableDirection], data: Sequence[Measurement], used: np.ndarray) -> list[bool]:
    """Tell of the first direction of each whether, cut to what is used, it is one that moves nothing measured."""
    if not suspects:
        return []
    V = np.stack([one.directions[:, 0] * used for one in suspects], axis=1)
    moved = [np.abs(one.J.reshape(-1, len(V)) @ V).max(axis=0, initial=0.0) for one in data]
    return (V.any(axis=0) & (np.max(moved, axis=0) < 1e-9)).tolist()


def _kept(one: Measurement, outside: np.ndarray) -> np.ndarray:
    return ~np.isin(one.sample, outside) if len(outside) else np.ones(len(one.r), dtype=bool)


def _whitened(data: Sequence[Measurement], sigma: dict[str, float], outside: np.ndarray) -> Iterator[np.ndarray]:
    """Yield whitened derivatives (m, d) of the samples that are kept."""
    for one in data:
        kept = np.ones(len(one.r), dtype=bool) if one.prior else _kept(one, outside)
        roots, J = one.roots(sigma), one.J[kept]
        white = roots[:, None] * J if roots.ndim == 1 else (roots if roots.ndim == 2 else roots[kept]) @ J
        yield white.reshape(-1, one.J.shape[2])


def check_weak(weak: str) -> None:
    """Refuse a way to treat weak directions that there is not."""
    if weak not in WEAK:
        raise UnknownName.among("way to treat weak directions", weak, WEAK)


def length_angle(value: Any, what: str) -> tuple[float, float]:
    """Return (metres, radians) from one number or two."""
    pair = numbers(value, what, ConfigError)
    if pair.shape not in ((), (2,)) or not np.all(pair > 0) or not np.isfinite(pair).all():
        raise ConfigError(f"Expected {what} as one or two numbers above zero [m, rad], got {value!r}.")
    length, angle = np.broadcast_to(pair, (2,))
    return float(length), float(angle)

"""Solver shared by single-arm and dual-arm calibration: initial guess, descent, identifiability, gauge-free
covariance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Generic, TypeVar

import numpy as np

from armlab._numbers import numbers
from armlab.calibrate.diagnostics import doubts_of
from armlab.calibrate.kinematics.identifiability import IdentifiabilityTest, UnobservableDirection
from armlab.calibrate.kinematics.measurements import Kind
from armlab.calibrate.kinematics.model import Arm, ArmState
from armlab.errors import ConfigError, NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.nonlinear import NonlinearSolution, covariance_of, whiten
from armlab.estimation.residual_tests import ResidualCheck
from armlab.lie import se3, so3
from armlab.models import KinematicCorrection

SCHEDULE = (1000.0, 300.0, 100.0, 30.0, 10.0)
UNIT = 1e-3  # units of the minimum-norm step: 1 mm and 1 mrad
WEAK = ("refuse", "prior")
MISFIT = 0.1  # residual, relative to the workspace size or to half a turn, above which samples are inconsistent
NO_NOISE = 1e-12  # smallest noise [m or rad]
GAUGE = 1e-6  # component along an unidentifiable direction above which a parameter is not identifiable
ROUNDING = 1e-9  # motion, relative to the largest coordinate, that counts as rounding error
NOBODY = np.zeros(0, dtype=int)
FAR = 0.1  # distance [m or rad] from the nominal robot above which the measurement frame is a different frame
MILLIMETRES = 30.0  # length ratio above which a wrong unit is more likely than an arm far from nominal
STILL = 1e-4  # length ratio below which the cause is a stationary tool, not a wrong unit

S = TypeVar("S")
Value = TypeVar("Value")


def start_arm(arm: Arm, kinds: tuple[Kind, ...]) -> tuple[Arm, np.ndarray]:
    """Return the arm, moved to the measurement frame, and an initial guess of the unknown tool points (K, 3)."""
    by_name = {kind.name: kind for kind in kinds}
    T = arm.move(arm.first())[:, -1]
    points = np.zeros((0, 3))
    if "pose" in by_name and by_name["pose"].kept.max() >= 3:
        return _from_poses(arm, T, by_name["pose"]), _points(T, by_name.get("position"))
    if "position" in by_name:
        kind = by_name["position"]
        if kind.values.shape[1] > 1:
            return _from_points(arm, T, kind)
        rows = np.flatnonzero(kind.visible[:, 0])
        return _from_positions(arm, T[rows, :3, 3], kind.values[rows, 0], len(kind.kept) == 3), points
    if "pose" in by_name:
        kind = by_name["pose"]
        rows = np.flatnonzero(kind.visible)
        return _from_positions(arm, T[rows, :3, 3], kind.values[rows, :3, 3], len(kind.kept) == 3), points
    return arm, points


def kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) in ``b = R a + p`` by least squares, for points a and b (N, 3)."""
    U, _, V = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return se3.from_rp(R, b.mean(axis=0) - R @ a.mean(axis=0))


def check_scale(nominal: float, measured: float, what: str) -> None:
    """Raise an error for lengths that appear to be in millimetres."""
    if measured > MILLIMETRES * nominal > 0:
        raise ShapeError(
            f"Expected {what} in metres, got values {measured / nominal:.3g} times as large as those of the nominal "
            "robot. The values seem to be in millimetres: divide them by 1000."
        )
    if nominal > MILLIMETRES * measured > STILL * nominal:
        raise ShapeError(
            f"Expected {what} and the robot in metres, got values {measured / nominal:.3g} times as large as those of "
            "the nominal robot. The robot description, or the initial guess of a fixed point, seems to be in "
            "millimetres."
        )


def size_of(points: np.ndarray) -> float:
    """Return the RMS distance of points (..., 3) from their mean."""
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1)))) if len(points) else 0.0


def _moved(arm: Arm, pose: np.ndarray) -> Arm:
    start = np.array(arm.start)
    start[0] = se3.project(pose @ start[0])[0]
    return replace(arm, start=start)


def _from_positions(arm: Arm, nominal: np.ndarray, measured: np.ndarray, whole: bool) -> Arm:
    if len(nominal) < 3 or not whole:
        return arm
    check_scale(size_of(nominal), size_of(measured), "positions")
    if np.sqrt(np.mean(np.sum((measured - nominal) ** 2, axis=1))) < FAR:
        return arm
    return _moved(arm, kabsch(nominal, measured))


def _from_poses(arm: Arm, T: np.ndarray, kind: Kind) -> Arm:
    rows = np.flatnonzero(kind.visible)
    nominal, measured = T[rows], kind.values[rows]
    if len(rows) < 3:
        return arm
    positions = kind.kept.min() < 3
    if positions:
        check_scale(size_of(nominal[:, :3, 3]), size_of(measured[:, :3, 3]), "positions of poses")
    turn = so3.angle(nominal[:, :3, :3], measured[:, :3, :3])
    away = np.linalg.norm(nominal[:, :3, 3] - measured[:, :3, 3], axis=1) * positions
    if np.sqrt(np.mean(turn**2)) < FAR and np.sqrt(np.mean(away**2)) < FAR:
        return arm
    RX, tX, RY, tY = hand_eye(nominal, measured)
    moved = _moved(arm, se3.from_rp(RY, tY if positions else arm.start[0, :3, 3] - RY @ arm.start[0, :3, 3]))
    start = np.array(moved.start)
    start[-1] = se3.project(start[-1] @ se3.from_rp(RX, tX if positions else np.zeros(3)))[0]
    return replace(moved, start=start)


def hand_eye(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return X and Y in ``B_i = Y A_i X``: rotations from the mean of ``R_A (x) R_B``, positions by least squares."""
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    K = np.einsum("iab,icd->acbd", RA, RB).reshape(9, 9) / len(A)
    U, _, V = np.linalg.svd(K)
    RY, RX = U[:, 0].reshape(3, 3), V[0].reshape(3, 3)
    RY, RX = (so3.project(R * np.sign(np.linalg.det(R)))[0] for R in (RY.T, RX))
    rows = np.concatenate([RY @ RA, np.broadcast_to(np.eye(3), RA.shape)], axis=2).reshape(-1, 6)
    known = (B[:, :3, 3] - A[:, :3, 3] @ RY.T).ravel()
    x = np.linalg.lstsq(rows, known, rcond=None)[0]
    return RX, x[:3], RY, x[3:]


def _points(T: np.ndarray, kind: Kind | None) -> np.ndarray:
    """Return the tool points (K, 3), given nominal tool poses."""
    if kind is None or kind.values.shape[1] == 1:
        return np.zeros((0, 3))
    points = np.zeros((kind.values.shape[1], 3))
    for k in range(len(points)):
        rows = np.flatnonzero(kind.visible[:, k])
        if len(rows):
            away = kind.values[rows, k] - T[rows, :3, 3]
            points[k] = np.mean(np.einsum("iba,ib->ia", T[rows, :3, :3], away), axis=0)
    return points


def _from_points(arm: Arm, T: np.ndarray, kind: Kind) -> tuple[Arm, np.ndarray]:
    """Return the arm and all points s_k from ``R_i s_k + t_i = R' p_ik + t'``; the base moves by the inverse pose."""
    K, blocks, known = kind.values.shape[1], [], []
    at_nominal = _points(T, kind)
    if np.sqrt(np.mean([_misfit(T, kind, k, at_nominal[k]) for k in range(K)])) < FAR**2 or len(kind.kept) < 3:
        return arm, at_nominal
    for k in range(K):
        rows = np.flatnonzero(kind.visible[:, k])
        block = np.zeros((len(rows), 3, 3 * K + 12))
        block[:, :, 3 * k : 3 * k + 3] = T[rows, :3, :3]
        for a in range(3):
            block[:, a, 3 * K + 3 * a : 3 * K + 3 * a + 3] = -kind.values[rows, k]
            block[:, a, 3 * K + 9 + a] = -1.0
        blocks.append(block.reshape(-1, 3 * K + 12))
        known.append(-T[rows, :3, 3].ravel())
    x = np.linalg.lstsq(np.concatenate(blocks), np.concatenate(known), rcond=None)[0]
    R = so3.project(x[3 * K : 3 * K + 9].reshape(3, 3))[0]
    points, wide = x[: 3 * K].reshape(K, 3), kind.values[kind.visible]
    check_scale(size_of(T[:, :3, 3]) + size_of(points), size_of(wide), "positions")
    at = [T[:, :3, :3] @ s + T[:, :3, 3] - p @ R.T for s, p in zip(points, np.moveaxis(kind.values, 1, 0))]
    t = np.mean(np.concatenate([a[seen] for a, seen in zip(at, kind.visible.T)]), axis=0)
    return _moved(arm, se3.inv(se3.from_rp(R, t))), points


def _misfit(T: np.ndarray, kind: Kind, k: int, point: np.ndarray) -> float:
    rows = np.flatnonzero(kind.visible[:, k])
    away = kind.values[rows, k] - T[rows, :3, 3] - T[rows, :3, :3] @ point
    return float(np.mean(np.sum(away**2, axis=1))) if len(rows) else 0.0


@dataclass(frozen=True, eq=False)
class KinematicEstimation(ABC, Generic[S]):
    """Estimation problem: descent, identifiability and covariance."""

    problem: Any  # `KinematicProblem` or `DualProblem`: residuals with named unknowns
    used: np.ndarray  # (d,) mask of the used unknowns, including the gauge
    limits: tuple[float, float]  # largest accepted standard deviations (metres, radians)
    hold: bool  # whether a prior holds weak directions
    start: Any  # initial state

    @abstractmethod
    def nature(self, state: S) -> list[UnobservableDirection]:
        """Return the directions that measurements of these kinds can never determine."""

    @abstractmethod
    def candidates(self, state: S) -> list[UnobservableDirection]:
        """Return the directions that the data may not determine."""

    @abstractmethod
    def spaces(self) -> list[float]:
        """Return the size [m] of the workspace of each measurement."""

    @abstractmethod
    def rigid(self) -> np.ndarray:
        """Return the mask (d,) of unknowns other than links and joint errors: bases, tools, points."""

    def solve(self, robust: bool) -> NonlinearSolution[S]:
        """Return the solution; if the descent fails, the error names an unidentifiable direction, if any."""
        problem, start = self.problem, self.start
        self._check_count(start)
        task = NonlinearProblem(problem.evaluate, problem.retract, problem.sizes(UNIT, UNIT)[problem.active], "arm")
        try:
            found = nonlinear_least_squares(task, start, robust=robust, schedule=SCHEDULE)
        except NotConverged as error:
            check_misfit(problem.measurements(error.best), self.spaces(), error.best)
            self.judge(problem.measurements(start, local=True), start, self._instrument())
            raise
        self._check_majority(found)
        return found

    def _check_majority(self, found: NonlinearSolution[S]) -> None:
        out = int(np.count_nonzero(found.outliers))
        if not out:
            return
        seen = np.unique(np.concatenate([one.sample for one in self.problem.measurements(found.value)]))
        if 2 * out > len(seen):
            raise NotConverged(
                f"Expected most samples to fit one arm, got {out} outliers among {len(seen)}. Check the units, the "
                "joint order, the pairing of samples and joint positions, and whether the given noise is too small.",
                best=found.value,
                history=found.history,
                reason="mismatch",
            )

    def _check_count(self, start: S) -> None:
        problem, used = self.problem, self.used
        got, each = sum(kind.numbers for kind in problem.kinds), sum(len(kind.kept) for kind in problem.kinds)
        if self.hold or got > np.count_nonzero(used):
            return
        G, _ = problem.gauge(start, used)
        needed = int(np.count_nonzero(used)) - int(np.linalg.matrix_rank(G[used]))
        data = problem.measurements(start, local=True)
        needed -= sum(never_moves(self.nature(start), data, used))
        needed -= problem.waves  # the harmonics have a prior
        needed += any(kind.cov is None for kind in problem.kinds)
        if got < needed:
            raise NotExcited(
                f"Expected at least {needed} values to determine the arm, got {got}. Measure at least "
                f"{-(-needed // each)} samples, preferably twice as many.",
                ["everything"],
                [f"{got} values ({needed} required)"],
            )

    def result(
        self, found: NonlinearSolution[S], state: S, value: Callable[[S, np.ndarray], Value], notes: Sequence[str]
    ) -> Fit[Value]:
        """Return the fit, evaluated at a state equivalent to the solution; `value` computes the fitted value from the
        state and its covariance."""
        problem, used = self.problem, self.used
        outside = np.flatnonzero(found.outliers)
        data = problem.measurements(state, local=True)
        check_misfit(data, self.spaces(), found.value, outside)
        excitation = self._judge_fit(data, state, found)
        cov, formal, check = self.covariance(data, state, found, excitation)
        whole = np.zeros((problem.size, problem.size))
        whole[np.ix_(used, used)] = cov
        size = np.sqrt(2.0 * found.cost / found.freedom) if found.freedom and not found.estimated else None
        match = [] if size is None else [f"residuals {size:.3g} times the given noise"]
        doubts, lines = doubts_of(check, [*notes, *match, *self.doubts(state)])
        accuracy = cache(partial(self._accuracy, data, found))  # used only in the report
        shown = ~np.any(np.abs(excitation.null_space) > GAUGE, axis=1)
        return Fit(
            value=value(state, whole),
            names=tuple(name for name, mine in zip(problem.names, used) if mine),
            units=tuple(unit for unit, mine in zip(problem.units, used) if mine),
            parameters=problem.values(state)[used],
            cov=cov,
            sigma=found.sigma,
            residuals=_table(data, problem.rows),
            n=problem.n,
            excitation=excitation,
            summary=lambda fit: "\n".join([*accuracy(), *lines, fit.table(shown)]),
            outliers=found.outliers,
            classes=found.classes,
            formal_cov=formal,
            doubts=doubts,
        )

    @abstractmethod
    def doubts(self, state: S) -> list[str]:
        """Return remarks on links that differ implausibly from their description."""

    def judge(
        self, data: Sequence[Measurement], state: S, sigma: dict[str, float], outside: np.ndarray = NOBODY
    ) -> Excitation:
        """Return the excitation at a state; raise an error for weak directions that no prior constrains."""
        problem, used = self.problem, self.used
        sigma = {name: max(size, NO_NOISE) for name, size in sigma.items()}
        G, gauge_names = problem.gauge(state, used)
        test = IdentifiabilityTest(
            names=[name for name, mine in zip(problem.names, used) if mine],
            units=[unit for unit, mine in zip(problem.units, used) if mine], limits=problem.sizes(*self.limits)[used],
            gauge=G[used], gauge_names=gauge_names, nature=_cut_to(self.nature(state), used),
            candidates=lambda: _cut_to(self.candidates(state), used), what="arm",
        )  # fmt: skip
        return test.excitation(np.concatenate(list(_whitened(data, sigma, outside)))[:, used], self.hold)

    def _accuracy(self, data: Sequence[Measurement], found: NonlinearSolution[S]) -> list[str]:
        """Return report lines with the RMS residuals before and after the fit, and for held-out samples."""
        kept = [_kept(one, np.flatnonzero(found.outliers)) for one in data]
        sizes = [_sizes(data, [one.r for one in data], kept)]
        sizes.append(_sizes(data, self._left_out(data, found), kept))
        active = self.problem.active & self.rigid()
        nominal = replace(self.problem, active=active)
        task = NonlinearProblem(nominal.evaluate, nominal.retract, nominal.sizes(UNIT, UNIT)[active], "base and tool")
        try:
            value = nonlinear_least_squares(task, self.start).value
            sizes.insert(0, _sizes(data, [one.r for one in self.problem.measurements(value)], kept))
        except (NotConverged, NotExcited):
            sizes.insert(0, dict.fromkeys(sizes[0], np.nan))
        return [
            f"{name}: {before:.3g} before (nominal links, base and tool fitted), {after:.3g} after, {out:.3g} held out "
            "(leave-one-out)"
            for name, before, after, out in ((name, *(one[name] for one in sizes)) for name in sizes[0])
        ]

    def _left_out(self, data: Sequence[Measurement], found: NonlinearSolution[S]) -> list[np.ndarray]:
        """Return the leave-one-out residuals of each sample, ``(1 - U U^T)^-1 r`` to first order."""
        sigma = {name: max(size, NO_NOISE) for name, size in zip(found.classes, found.sigma.tolist())}
        R = np.linalg.qr(found.rows.J, mode="r")
        _, singular, V = np.linalg.svd(R)
        basis = V[singular > ROUNDING * singular[0]].T / singular[singular > ROUNDING * singular[0]]
        left = []
        for one in data:
            root = one.roots(sigma)
            root = np.diag(root) if root.ndim == 1 else root
            U = root @ one.J[:, :, self.problem.active] @ basis
            rest = np.eye(one.r.shape[1]) * (1.0 + ROUNDING) - U @ U.transpose(0, 2, 1)
            left.append(np.linalg.solve(root, np.linalg.solve(rest, (root @ one.r[:, :, None])))[:, :, 0])
        return left

    def _instrument(self) -> dict[str, float]:
        """Return the noise of a typical instrument for each measurement class."""
        return dict.fromkeys([name for kind in self.problem.kinds for name in kind.classes], UNIT)

    def _judge_fit(self, data: Sequence[Measurement], state: S, found: NonlinearSolution[S]) -> Excitation:
        """Return the excitation at the solution; raise a misfit error if only large residuals make directions weak."""
        sigma, outside = dict(zip(found.classes, found.sigma.tolist())), np.flatnonzero(found.outliers)
        try:
            return self.judge(data, state, sigma, outside)
        except NotExcited:
            if all(kind.cov is not None for kind in self.problem.kinds):
                raise
            self.judge(data, state, self._instrument(), outside)
            sizes = ", ".join(f"{size:.3g} in {name}" for name, size in sigma.items())
            raise NotConverged(
                f"Expected a kinematic model that fits the measurements, got residuals of {sizes} "
                "(RMS). Residuals this large leave some directions undetermined; an "
                "instrument accurate to 1 mm would determine them. Detect outliers with "
                "robust=True, and check the joint order and the pairing of samples and joint positions.",
                best=found.value,
                reason="mismatch",
            ) from None

    def covariance(
        self, data: Sequence[Measurement], state: S, found: NonlinearSolution[S], excitation: Excitation
    ) -> tuple[np.ndarray, np.ndarray | None, ResidualCheck]:
        """Return the covariance (p, p) of the used unknowns, which is zero along unidentifiable directions."""
        limits = self.problem.sizes(*self.limits)[self.used]
        priors = list(self.problem.priors(state, local=True))
        sigma = {name: max(size, NO_NOISE) for name, size in zip(found.classes, found.sigma.tolist())}
        every = [*data, *priors]
        rows = whiten(every, [one.roots(sigma) for one in every]).times(1.0 - found.outliers)
        J = rows.J[:, self.used]
        if priors:
            G = self.problem.gauge(state, self.used)[0][self.used] / limits[:, None]
            whole = np.eye(len(limits)) if not G.shape[1] else np.linalg.svd(G, full_matrices=True)[0][:, G.shape[1] :]
            _, singular, V = np.linalg.svd(np.linalg.qr(J * limits @ whole, mode="r"))
            seen = singular > 1e-9 * singular[0]
            basis = limits[:, None] * (whole @ V[seen].T) / singular[seen]
        else:
            seen = np.isfinite(excitation.spread)
            basis = limits[:, None] * excitation.vectors[:, seen] * excitation.spread[seen]
        return covariance_of(rows, basis, J @ basis, found.estimated, found.robust)


def _cut_to(candidates: Sequence[UnobservableDirection], used: np.ndarray) -> list[UnobservableDirection]:
    """Return the directions restricted to the used unknowns, without zero directions."""
    found = [UnobservableDirection(one.name, one.directions[used], one.advice) for one in candidates]
    return [one for one in found if np.abs(one.directions).max(initial=0.0) > 0]


def check_misfit(data: Sequence[Measurement], sizes: Sequence[float], best: Any, outside: np.ndarray = NOBODY) -> None:
    """Raise an error for inconsistent samples; `sizes` are the sizes of the workspaces [m], or 0 for an arm at rest."""
    for one, size in zip(data, sizes):
        kept = one.r[_kept(one, outside)]
        for unit, space in (("m", size), ("rad", np.pi)):
            off = kept[:, [name.endswith(f"[{unit}]") for name in one.classes]]
            rms = float(np.sqrt(np.mean(off**2))) if off.size else 0.0
            if rms > MISFIT * space > 0.0 and len(kept) > 3:
                raise NotConverged(
                    f"Expected a kinematic model that fits the measurements, got residuals of {rms:.3g} {unit} in a "
                    f"workspace of {space:.3g} {unit}. Check the units, the joint order, and the pairing of "
                    "samples and joint positions.",
                    best=best,
                    reason="mismatch",
                )


def spread_of(points: np.ndarray) -> float:
    """Return the RMS distance of points (N, 3) from their mean; 0 if it is within rounding error."""
    spread = size_of(points)
    return spread if spread > ROUNDING * float(np.abs(points).max(initial=0.0)) else 0.0


def corrected_arm(arm: Arm, state: ArmState, cov: np.ndarray, **more: Any) -> KinematicCorrection:
    return KinematicCorrection(
        robot=arm.corrected(state.frames), robot_name=arm.robot.name, robot_hash=arm.robot.hash, harmonics=arm.orders,
        amplitudes=state.amplitudes, coefficients=state.coefficients, cov=cov, **more,
    )  # fmt: skip


def never_moves(
    candidates: Sequence[UnobservableDirection], data: Sequence[Measurement], used: np.ndarray
) -> list[bool]:
    """Return, for each candidate, whether its first direction has no effect on any measurement."""
    if not candidates:
        return []
    V = np.stack([one.directions[:, 0] * used for one in candidates], axis=1)
    moved = [np.abs(one.J.reshape(-1, len(V)) @ V).max(axis=0, initial=0.0) for one in data]
    return (V.any(axis=0) & (np.max(moved, axis=0) < 1e-9)).tolist()


def _kept(one: Measurement, outside: np.ndarray) -> np.ndarray:
    return ~np.isin(one.sample, outside) if len(outside) else np.ones(len(one.r), dtype=bool)


def _whitened(data: Sequence[Measurement], sigma: dict[str, float], outside: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the whitened derivatives (m, d) of the included samples."""
    for one in data:
        kept = np.ones(len(one.r), dtype=bool) if one.prior else _kept(one, outside)
        roots, J = one.roots(sigma), one.J[kept]
        white = roots[:, None] * J if roots.ndim == 1 else (roots if roots.ndim == 2 else roots[kept]) @ J
        yield white.reshape(-1, one.J.shape[2])


def check_weak(weak: str) -> None:
    if weak not in WEAK:
        raise UnknownName.among("treatment of weak directions", weak, WEAK)


def length_angle(value: Any, what: str) -> tuple[float, float]:
    """Return a pair (metres, radians) from one or two positive numbers."""
    pair = numbers(value, what, ConfigError)
    if pair.shape not in ((), (2,)) or not np.all(pair > 0) or not np.isfinite(pair).all():
        raise ConfigError(f"Expected {what} to be one or two positive numbers [m, rad], got {value!r}.")
    length, angle = np.broadcast_to(pair, (2,))
    return float(length), float(angle)


def _sizes(data: Sequence[Measurement], r: Sequence[np.ndarray], kept: Sequence[np.ndarray]) -> dict[str, float]:
    """Return the RMS norm of each kind of residual, in mm or mrad."""
    found = {}
    for one, values, mine in zip(data, r, kept):
        for unit, small in (("[m]", "mm"), ("[rad]", "mrad")):
            part = [name for name in one.classes if name.endswith(unit)]
            if part and mine.any():
                off = values[mine][:, [name.endswith(unit) for name in one.classes]]
                found[f"{part[0].replace(unit, small)} (RMS)"] = 1e3 * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return found


def _table(data: Sequence[Measurement], rows: int) -> np.ndarray:
    """Return the residuals, one row per sample, then one row per pair; NaN for missing measurements."""
    table = np.full((rows, sum(one.r.shape[1] for one in data)), np.nan)
    first = 0
    for one in data:
        table[one.sample, first : first + one.r.shape[1]] = one.r
        first += one.r.shape[1]
    return table

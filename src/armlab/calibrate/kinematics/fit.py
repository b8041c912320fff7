"""Kinematic calibration of an arm, including base and tool, from external measurements.

    T(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n,        E_j <- E_j Exp(x_j)

Every frame may be displaced by a twist, so arms with parallel axes need no special treatment. The estimate maximises
the joint likelihood of all measurements; `excitation` names the unobservable directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate.kinematics.identifiability import UnobservableDirection, far_links, may_be_missing, never_seen
from armlab.calibrate.kinematics.measurements import check_harmonics, check_joints, check_terms, measured_kinds
from armlab.calibrate.kinematics.model import Arm, KinematicProblem, State
from armlab.calibrate.kinematics.solve import (
    KinematicEstimation,
    check_scale,
    check_weak,
    corrected_arm,
    length_angle,
    never_moves,
    spread_of,
    start_arm,
)
from armlab.errors import ConfigError, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.models import KinematicCorrection
from armlab.robots import Robot

LIMITS = (0.05, 0.05)  # largest accepted standard deviation along any direction [m, rad]
MODELS, CHOICES = ("local_poe", "poe"), ("all", "offsets", "base_tool")


def fit_kinematics(
    robot: Robot,
    q: ArrayLike,
    *,
    pose: ArrayLike | None = None,
    position: ArrayLike | None = None,
    distance: ArrayLike | None = None,
    pair_distance: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    anchor: ArrayLike | None = None,
    length_offset: bool = False,
    length_scale: bool = False,
    visible: ArrayLike | Mapping[str, ArrayLike] | None = None,
    noise: Any = None,
    model: str = "local_poe",
    free: str | ArrayLike = "all",
    harmonics: Sequence[int] = (),
    joint_terms: ArrayLike | None = None,
    prior: float | tuple[float, float] = 0.1,
    weak: str = "refuse",
    robust: bool = False,
    limits: tuple[float, float] = LIMITS,
) -> Fit[KinematicCorrection]:
    """Calibrate the base, links, joint offsets, tool and, optionally, joint errors of an arm.

    Parameters
    ----------
    robot : nominal arm, used as initial guess. A measurement frame far from the nominal base is located first.
    q : (N, n) joint positions [rad or m].
    pose : (N, 4, 4) measured tool poses.
    position : (N, 3) measured positions of the tool point [m], or (N, K, 3) of K points at unknown positions on the
        tool.
    distance : (N,) measured distances of the tool point from `anchor`, a fixed, approximately known point [m].
    pair_distance : (i, j, d): indices i and j (M,) of two samples, and the distance d (M,) between their tool points
        [m].
    anchor : (3,) initial guess of the fixed point in the measurement frame [m].
    length_offset, length_scale : estimate offset and scale of distances, ``measured = scale * true + offset``.
    visible : (N,) or (N, K) mask, False for missing measurements; {"position": mask} for a separate mask per kind.
    noise : standard deviations: for poses a pair ([m], [rad]) or 6 values; for positions 1 or 3 values [m]; for
        distances 1 value [m]. Alternatively, covariances (k, k) or (N, k, k). An infinite standard deviation excludes a
        component. For several kinds of measurement: {"pose": ..., "distance": ...}. By default, and for omitted kinds,
        the noise is estimated.
    model : "local_poe": steps of the frames; "poe": steps of the base-frame screws and the home pose. Both models give
        the same result.
    free : "all"; "offsets": joint offsets, base and tool; "base_tool"; or a mask (n+1, 6) of the twists [v; w] of the
        frames. Joint j + 1 moves about or along the z axis of frame j.
    harmonics : orders k of ``a_jk cos k q_j + b_jk sin k q_j`` added to q, with a prior of 0.1 deg on the amplitudes.
    joint_terms : phi (N, n, L), for example gravity torques; ``sum_l c_l phi_l`` is added to q.
    prior : standard deviation of the links [m and rad], one value or a pair, for `weak="prior"`; base and tool have no
        prior.
    weak : "refuse": directions beyond `limits` raise an error; "prior": the prior determines these directions.
    robust : detect and exclude outliers among the samples.
    limits : largest accepted standard deviation along any direction [m, rad].

    Returns
    -------
    Fit of a `models.KinematicCorrection`
        The parameters are the twists of the frames relative to the start (with minimum norm along the gauge), then
        amplitudes, coefficients, points, anchor, length offset and length scale, if used. `residuals` and `outliers`
        have one row per sample, then one row per pair; residuals of missing measurements are NaN.

    Raises
    ------
    NotExcited : unidentifiable directions (named in the message).
    NotConverged : inconsistent samples.
    ShapeError : wrong shapes, unmasked NaN, invalid rotations, lengths in millimetres, angles in degrees.
    ConfigError, UnknownName : invalid options.

    References
    ----------
    Okamura and Park (1996); Chen, Yang, Tan and Yeo (2001); He et al. (2010); Hollerbach and Wampler (1996).
    """
    q = check_joints(robot, q)
    if len(q) == 0:
        raise NotExcited("Expected samples, got an empty q. Measure the arm.", ["everything"], ["no samples"])
    _check_options(model, free, weak)
    orders, terms = check_harmonics(harmonics), check_terms(joint_terms, q.shape)
    given = {"pose": pose, "position": position, "distance": distance, "pair_distance": pair_distance}
    kinds, notes = measured_kinds(len(q), given, visible, noise)
    arm, points = start_arm(Arm.of(robot, q, orders, terms, model), tuple(kinds))
    held = length_angle(prior, "prior") if weak == "prior" else None
    problem = KinematicProblem(arm, tuple(kinds), np.zeros(0, dtype=bool), len(points), held)
    start = State(arm.first(), points, _anchor(anchor, distance is not None), np.array([0.0, 1.0]))
    _check_lengths(problem, start, length_offset)
    used = _used(problem, free, distance is not None, (length_offset, length_scale))
    reduced = isinstance(free, str) and free == "all" and held is None
    active = used & _with_rest(arm.unbound, problem.size) if reduced else used
    if reduced and not problem.points and not any(kind.name == "pose" for kind in problem.kinds):
        active[6 * arm.n + 3 : 6 * arm.n + 6] = False  # one point does not determine the tool rotation
    problem = KinematicProblem(arm, tuple(kinds), active, len(points), held)
    estimation = ArmEstimation(problem, used, length_angle(limits, "limits"), weak == "prior", start)
    solution = estimation.solve(robust)
    return estimation.fit(solution, isinstance(free, str) and free == "all", notes)


def _check_options(model: str, free: Any, weak: str) -> None:
    check_weak(weak)
    if model not in MODELS:
        raise UnknownName.among("model", model, MODELS)
    if isinstance(free, str) and free not in CHOICES:
        raise UnknownName.among("choice of free frames", free, CHOICES)
    if model == "poe" and not (isinstance(free, str) and free == "all"):
        raise ConfigError(f"Expected free='all' with model='poe', got {free!r}. Use model='local_poe'.")


def _anchor(anchor: ArrayLike | None, needed: bool) -> np.ndarray:
    if anchor is None:
        if needed:
            raise ConfigError(
                "Expected an initial guess of the fixed point for distances, got no anchor. Pass anchor=(x, y, z)."
            )
        return np.zeros(3)
    found = numbers(anchor, "anchor", ShapeError)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ShapeError(f"Expected anchor to be three finite numbers [m], got {anchor!r}.")
    return found


def _check_lengths(problem: KinematicProblem, start: State, length_offset: bool) -> None:
    """Raise an error for negative distances and for distances in millimetres."""
    lengths = [kind for kind in problem.kinds if "distance" in kind.name]
    if not lengths:
        return
    nominal = [one for one in problem.measurements(start) if one.classes[0] in ("distance [m]", "pair distance [m]")]
    for kind, one in zip(lengths, nominal):
        measured = kind.values[kind.visible]
        if len(measured) and not length_offset and measured.min() < 0:
            raise ShapeError(
                f"Expected {kind.name} >= 0, got {measured.min():.4g} m. Pass length_offset=True if the instrument has "
                "an offset."
            )
        if len(measured):
            check_scale(float(np.mean(np.abs(measured - one.r[:, 0]))), float(np.mean(measured)), kind.name)


def _used(problem: KinematicProblem, free: Any, anchored: bool, length: tuple[bool, bool]) -> np.ndarray:
    """Return the mask (d,) of used unknowns, including the gauge."""
    arm = problem.arm
    frames = _free_frames(arm, free)
    if problem.tool_held:
        frames[-1] = False
    rest = [np.ones(3 * problem.points, dtype=bool), np.full(3, anchored), np.array(length, dtype=bool)]
    mask = np.concatenate([frames.ravel(), np.ones(arm.size - frames.size, dtype=bool), *rest])
    return mask & _with_rest(arm.existing, problem.size)


def _with_rest(mask: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([mask, np.ones(size - len(mask), dtype=bool)])


def _free_frames(arm: Arm, free: Any) -> np.ndarray:
    """Return the mask (n+1, 6) of free components."""
    mask = np.ones((arm.n + 1, 6), dtype=bool)
    if not isinstance(free, str):
        mask = np.asarray(free)
        if mask.dtype != bool or mask.shape != (arm.n + 1, 6):
            raise ShapeError(f"Expected free as Booleans of shape ({arm.n + 1}, 6), got {mask.shape}.")
        return mask.copy()
    if free != "all":
        mask[1:-1] = False
    if free == "offsets":
        mask[np.arange(arm.n), np.where(arm.robot.prismatic, 2, 5)] = True
    return mask


@dataclass(frozen=True, eq=False)
class ArmEstimation(KinematicEstimation[State]):
    """Estimation of the kinematics of one arm."""

    problem: KinematicProblem

    def nature(self, state: State) -> list[UnobservableDirection]:
        return never_seen(self.problem, state)

    def candidates(self, state: State) -> list[UnobservableDirection]:
        return may_be_missing(self.problem, state)

    def fit(self, found: NonlinearSolution[State], smallest: bool, notes: Sequence[str]) -> Fit[KinematicCorrection]:
        """Return the fit; if `smallest`, return it at the equivalent state nearest to the start."""
        state = self._smallest(found.value) if smallest else found.value
        return self.result(found, state, self._value, notes)

    def rigid(self) -> np.ndarray:
        mask, arm = np.ones(self.problem.size, dtype=bool), self.problem.arm
        mask[6 : 6 * arm.n] = False
        mask[6 * arm.n + 6 : arm.size] = False
        return mask

    def doubts(self, state: State) -> list[str]:
        return far_links(self.problem.arm, state.arm.frames)

    def _smallest(self, state: State) -> State:
        """Return the equivalent state nearest to the start."""
        problem, base, tool = self.problem, [], []
        if not any(kind.name == "pose" and len(kind.kept) == 6 for kind in problem.kinds):
            data = problem.measurements(state, local=True)
            unseen = never_moves(self.nature(state), data, self.used)
            base, tool = unseen[:6], [False] * 3 + unseen[6:9] * (not problem.points)
        base_steps, tool_steps = (np.eye(6)[:, np.flatnonzero(unseen)] for unseen in (base, tool))
        frames, move = problem.arm.smallest(state.arm.frames, base_steps, tool_steps)
        anchor = move[:3, :3] @ state.anchor + move[:3, 3]
        return state._replace(arm=state.arm._replace(frames=frames), anchor=anchor)

    def spaces(self) -> list[float]:
        sizes = []
        for kind in self.problem.kinds:
            seen = kind.values[kind.visible]
            if kind.name == "position":
                sizes += [spread_of(seen)] * kind.values.shape[1]
            else:
                sizes.append(spread_of(seen[:, :3, 3]) if kind.name == "pose" else float(np.mean(seen)))
        return sizes

    def _value(self, state: State, whole: np.ndarray) -> KinematicCorrection:
        arm, problem = self.problem.arm, self.problem
        anchored = bool(self.used[arm.size + 3 * problem.points : -2].any())
        offset, scale = state.length.tolist()
        return corrected_arm(
            arm, state.arm, whole[: arm.size, : arm.size], points=state.points,
            anchor=state.anchor if anchored else None, length_offset=offset, length_scale=scale,
        )  # fmt: skip

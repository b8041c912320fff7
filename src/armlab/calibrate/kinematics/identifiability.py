"""Identifiability of the parameters of an arm: gauge, directions that the measurements never determine, joints at rest.

The components of a direction are expressed relative to the limits of their parameters. There are three classes of
unobservable directions:

gauge           motion that can be moved from one frame to the next without effect
structural      a tool point does not determine the tool orientation, and a distance does not determine the base
data-dependent  a joint at rest, a tool point on the last axis, or an unknown scale

The fit raises NotExcited for data-dependent directions, and for directions whose standard deviation exceeds its limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.calibrate.kinematics.model import Arm, ArmState, KinematicProblem, State
from armlab.errors import NotExcited
from armlab.estimation import Excitation
from armlab.lie import se3, so3

NULL = 1e-9  # relative singular value below which a direction is unobservable
SEEN = 1e-8  # the same limit for candidate directions, which contain rounding errors
SAME = 0.9  # cosine above which a direction matches a named direction
PART = 0.3  # fraction of the largest component above which a component is named
LITTLE, STILL = 0.35, 1e-3  # motion [rad or m] below which a joint is named as a cause, or counts as at rest
TURNED, SHIFTED = 0.5, 0.3  # implausible deviations of a link: [rad], and fraction of the reach


@dataclass(frozen=True, eq=False)
class UnobservableDirection:
    """Possibly unobservable directions (d, k), with a common name and advice."""

    name: str
    directions: np.ndarray
    advice: str = ""


@dataclass(frozen=True, eq=False)
class IdentifiabilityTest:
    """Unknowns, and the directions in which the data may fail to determine them."""

    names: Sequence[str]  # names of the d unknowns
    units: Sequence[str]  # units of the d unknowns
    limits: np.ndarray  # (d,) largest accepted standard deviations
    gauge: np.ndarray  # (d, g) directions of the gauge
    gauge_names: Sequence[str]
    nature: Sequence[UnobservableDirection]  # structurally unobservable directions
    candidates: Callable[[], Sequence[UnobservableDirection]]  # data-dependent directions; called only if some are weak
    what: str  # name of the fitted quantity

    def excitation(self, J: np.ndarray, hold: bool) -> Excitation:
        """Return the excitation of the whitened Jacobian (m, d); weak directions raise an error unless `hold` is
        set."""
        A = np.asarray(np.linalg.qr(J, mode="r")) * self.limits if len(J) > J.shape[1] else J * self.limits
        fixed, names = _independent(self.gauge / self.limits[:, None]), [f"gauge: {name}" for name in self.gauge_names]
        largest = float(np.linalg.norm(A))
        for candidate in self.nature:
            for v in (candidate.directions / self.limits[:, None]).T:
                v = v - fixed @ (fixed.T @ v)
                length = np.linalg.norm(v)
                if length > SEEN and np.linalg.norm(A @ v) <= SEEN * largest * length:
                    v = v / length
                    fixed = np.column_stack([fixed, v - fixed @ (fixed.T @ v)])
                    names.append(f"missing: {candidate.name}")
        whole = np.linalg.svd(fixed, full_matrices=True)[0] if fixed.shape[1] else np.eye(len(self.limits))
        rest = whole[:, fixed.shape[1] :]
        _, found, rows = np.linalg.svd(A @ rest, full_matrices=len(A) < rest.shape[1])
        singular = np.zeros(rest.shape[1])
        singular[: len(found)] = found
        vectors, unseen = rest @ rows.T, singular <= NULL * max(largest, np.finfo(float).tiny)
        spread = np.divide(1.0, singular, out=np.full_like(singular, np.inf), where=~unseen)
        weak = _Named.of(vectors[:, spread > 1.0], spread[spread > 1.0], self, fixed)
        if weak.words and not hold:
            raise NotExcited(weak.sentence(self.what), weak.words, weak.spreads)
        missing = _Named.of(vectors[:, unseen], spread[unseen], self, fixed)
        return Excitation(
            rank=int(np.count_nonzero(~unseen)), expected=len(singular), singular_values=singular,
            weakest=self.words(vectors[:, -1], spread[-1]) if len(singular) else "none", scale=1.0 / self.limits,
            vectors=vectors, held=tuple(weak.words), null_space=np.column_stack([fixed, missing.vectors]),
            null_names=(*names, *(f"missing: {name}" for name in missing.each)), spread=spread,
        )  # fmt: skip

    def words(self, v: np.ndarray, spread: float) -> str:
        """Return the names of a direction's largest components, with the standard deviation of the largest."""
        order = [int(i) for i in np.argsort(-np.abs(v))[:3]]
        kept = [i for i in order if abs(v[i]) > PART * abs(v[order[0]])]
        text, i = " and ".join(self.names[i] for i in kept), order[0]
        if not np.isfinite(spread):
            return text
        return f"{text} ({self.names[i]} to {abs(v[i]) * spread * self.limits[i]:.2g} {self.units[i]})"


@dataclass(frozen=True, eq=False)
class _Named:
    """Weak directions: `words` contains one name per cause; `each` and `vectors` (d, w) contain one entry per
    direction."""

    words: list[str]
    spreads: list[str]
    advice: list[str]
    each: list[str]
    vectors: np.ndarray

    @classmethod
    def of(cls, W: np.ndarray, spread: np.ndarray, test: IdentifiabilityTest, fixed: np.ndarray) -> _Named:
        words, spreads, advice, each = [], [], [], []
        if not W.shape[1]:
            return cls(words, spreads, advice, each, W)
        parts, left, worst = [], W, float(np.max(spread))
        for candidate in test.candidates():
            D = candidate.directions / test.limits[:, None]
            known = np.column_stack([fixed, *parts])
            Q = _independent(D - known @ (known.T @ D))
            if not Q.shape[1] or not left.shape[1]:
                continue
            _, cosine, turn = np.linalg.svd(Q.T @ left, full_matrices=True)
            k = int(np.count_nonzero(cosine > SAME))
            if k:
                parts.append(left @ turn[:k].T)
                left = left @ turn[k:].T
                words.append(candidate.name)
                spreads.append(_spread_text(worst))
                advice.append(candidate.advice)
                each += [candidate.name] * k
        for v in left.T:
            near = spread[np.argmax(np.abs(W.T @ v))]
            words.append(test.words(v, near))
            spreads.append(_spread_text(near))
            each.append(words[-1])
        return cls(words, spreads, advice, each, np.column_stack([*parts, left]))

    def sentence(self, what: str) -> str:
        todo = " ".join(dict.fromkeys(text for text in self.advice if text))
        return (
            f"Expected measurements that determine every direction of the {what}, got {len(self.words)} undetermined "
            f"or beyond the limit: {'; '.join(self.words)}. "
            f"{todo or 'Measure at more positions, with more variation of all joints.'} "
            "With weak='prior', the fit holds these directions near their nominal values."
        )


def _spread_text(spread: float) -> str:
    return f"{spread:.2g} times the limit" if np.isfinite(spread) else "unobservable"


def _independent(D: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the columns; its order follows the columns if they are independent."""
    if not D.shape[1]:
        return D
    lengths = np.linalg.norm(D, axis=0)
    Q, R = np.linalg.qr(D / np.where(lengths > 0, lengths, 1.0))
    kept = np.abs(np.diag(R)) > SEEN
    if kept.all():
        return Q
    U, singular, _ = np.linalg.svd(D / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
    return U[:, singular > SEEN]


def far_links(arm: Arm, frames: np.ndarray, whose: str = "") -> list[str]:
    """Return a remark on the link that differs most from its description, if the difference is implausible."""
    twists = arm.corrections(frames)[1:-1]
    if not len(twists):
        return []
    shift, turn = np.linalg.norm(twists[:, :3], axis=1), np.linalg.norm(twists[:, 3:], axis=1)
    reach = float(np.linalg.norm(arm.start[1:, :3, 3], axis=1).sum()) or 1.0
    share = np.maximum(turn / TURNED, shift / (SHIFTED * reach))
    j = int(np.argmax(share))
    if share[j] < 1.0:
        return []
    return [
        f"link {j + 1}{whose} deviates by {shift[j]:.2g} m and {turn[j]:.2g} rad from its description: possible causes "
        "are a reversed joint, a joint offset, left-handed measurements or a different arm"
    ]


def joints_at_rest(arm: Arm, frames: np.ndarray, at: int, size: int, whose: str = "") -> list[UnobservableDirection]:
    """Return, for each joint with little motion, the directions in which the steps of its two adjacent frames
    cancel."""
    found = []
    reach = np.ptp(arm.q, axis=0)
    for j in np.flatnonzero(reach < LITTLE):
        Z, middle = np.eye(4), float(np.mean(arm.q[:, j]))
        if arm.robot.prismatic[j]:
            Z[2, 3] = middle
        else:
            Z[:3, :3] = so3.exp([0.0, 0.0, middle])
        D = np.zeros((size, 6))
        D[at + 6 * j : at + 6 * j + 6] = np.eye(6)
        D[at + 6 * j + 6 : at + 6 * j + 12] = -se3.adjoint_inv(Z @ frames[j + 1])
        unit = "mm" if arm.robot.prismatic[j] else "deg"
        moved = reach[j] * 1000.0 if arm.robot.prismatic[j] else np.degrees(reach[j])
        name = f"joint {j + 1}{whose} " + ("did not move" if reach[j] < STILL else f"moved by only {moved:.2g} {unit}")
        found.append(UnobservableDirection(name, D, f"Move joint {j + 1}{whose} over its range."))
    return found


def arm_scale(arm: Arm, frames: np.ndarray) -> np.ndarray:
    """Return the direction (d,) that scales all lengths of the arm."""
    direction = np.zeros(arm.size)
    direction[: 6 * len(frames)].reshape(-1, 6)[:, :3] = np.einsum("jba,jb->ja", frames[:, :3, :3], frames[:, :3, 3])
    return direction


def never_seen(problem: KinematicProblem, state: State) -> list[UnobservableDirection]:
    """Return the structurally unobservable directions: base pose, tool orientation, and all positions."""
    arm, size = problem.arm, problem.size
    frames, b = state.arm.frames, arm.size + 3 * problem.points
    shifts = np.zeros((size, 6))
    shifts[:6] = se3.adjoint_inv(frames[0])
    shifts[b : b + 3] = np.hstack([np.eye(3), -so3.hat(state.anchor)])  # the anchor moves with the base
    found = [
        UnobservableDirection(f"measurement frame, {verb} {letter}", shifts[:, [k]])
        for k, (verb, letter) in enumerate((verb, letter) for verb in ("shift along", "turn about") for letter in "xyz")
    ]
    if not problem.points:
        turns = np.zeros((size, 3))
        turns[6 * arm.n + 3 : 6 * arm.n + 6] = np.eye(3)
        found += [UnobservableDirection(f"tool orientation about {'xyz'[k]}", turns[:, [k]]) for k in range(3)]
    places = arm.names
    if all(kind.name == "pose" and kind.kept.min() >= 3 for kind in problem.kinds):
        for j in range(arm.n + 1):
            for k in range(3):
                column = np.zeros((size, 1))
                column[6 * j + k] = 1.0
                found.append(UnobservableDirection(f"{places[6 * j + k]} (only orientation is measured)", column))
    return found


def may_be_missing(problem: KinematicProblem, state: State) -> list[UnobservableDirection]:
    arm, size = problem.arm, problem.size
    a, b = arm.size, arm.size + 3 * problem.points
    found = joints_at_rest(arm, state.arm.frames, 0, size)
    if not problem.points and not arm.robot.prismatic[-1]:
        found.append(_on_last_axis(arm, state.arm, size))
    scale = np.zeros((size, 1))
    scale[:a, 0] = arm_scale(arm, state.arm.frames)
    scale[a:b, 0] = state.points.ravel()
    if problem.points and problem.tool_held:
        scale[6 * arm.n : 6 * arm.n + 6] = 0.0
        scale[a:b, 0] += np.tile(state.arm.frames[-1, :3, :3].T @ state.arm.frames[-1, :3, 3], problem.points)
    scale[b : b + 3, 0] = state.anchor
    scale[-1] = -state.length[1]
    advice = "Measure one known length, or pass the scale of the instrument."
    return [*found, UnobservableDirection("overall scale", scale, advice)]


def _on_last_axis(arm: Arm, state: ArmState, size: int) -> UnobservableDirection:
    """Return the tilts of the last axis about the tool point."""
    D = np.zeros((size, 2))
    D[6 * arm.n - 6 : 6 * arm.n - 3] = so3.hat([0.0, 0.0, state.frames[-1, 2, 3]])[:, :2]
    D[6 * arm.n - 3 : 6 * arm.n] = np.eye(3)[:, :2]
    name = f"tool point lies on the axis of joint {arm.n}"
    return UnobservableDirection(name, D, f"Mount the target away from the axis of joint {arm.n}.")

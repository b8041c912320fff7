"""Diagnostics of gravity calibrations: unidentifiable directions, and likely causes of misfit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import hypot

import numpy as np

from armlab.calibrate.diagnostics import MUCH_BETTER, ROBOT, UNSEEN, axis_text, readings
from armlab.calibrate.gravity_load.model import Load, Turn, WeightEquation
from armlab.errors import NotConverged, NotExcited
from armlab.lie import so3

MISREAD, MISREAD_FAR = 1e-3, 0.1  # relative force residuals above which other conventions are tried
WIDE = 0.4  # variation of gravity in tool axes above which a wrong convention leaves large residuals
STILL = 1e-6  # variation of gravity in tool axes that counts as zero
HAND = 20.0  # minimum Delta for deciding the handedness
RICH = 0.1  # variation of gravity in two directions above which the readings must follow it
UNEXPLAINED = 0.5  # largest accepted fraction of the variation that a load does not explain
ROUGH = 5.0  # ratio to the given noise above which noise does not explain the residuals
FIRST_ORDER = 0.05  # rad; larger standard deviations are only first-order approximations
FAR, ABSURD = 1.0, 10.0  # centre-of-mass distances [m] above which the unit is possibly, or certainly, wrong
OTHER_UNIT = 2.0  # factor above which a wrong unit is more likely than an error in weight or gravity
HEAVY, LIGHT = 500.0, 1e-3  # masses [kg] beyond the range of arms and sensors
LOW_GRAVITY = 1.5  # m/s^2, less than the gravity of the Moon
MANY = 1.0 / 3.0  # fraction of outliers above which the left-handed solution is tried
STANDARD = 9.80665  # standard gravity [m/s^2]


@dataclass(frozen=True, eq=False)
class LoadUnknowns:
    """Names, units and limits of the unknowns, and descriptions of directions for `check_spread`."""

    equation: WeightEquation
    load: Load  # estimated load
    limits: tuple[float, float, float]  # (angle [rad], fraction of the weight, length [m])
    scale: str = "mass"  # name of the mass parameter: "mass" [kg], or "scale" of an accelerometer

    @property
    def names(self) -> tuple[str, ...]:
        return _labels(tuple(self.equation.widths.items()), self.scale)[0]

    @property
    def units(self) -> tuple[str, ...]:
        return _labels(tuple(self.equation.widths.items()), self.scale)[1]

    @cached_property
    def widths(self) -> np.ndarray:
        angle, share, length = self.limits
        weight, pull = hypot(*self.load.gamma.tolist()), self.equation.pull
        mass = share * (weight if pull is None else weight / hypot(*pull.tolist()))
        one = {"rotation": angle, "mass": mass, "centre": length, "torque bias": length * weight}
        return np.array([one.get(kind, share * weight) for kind, n in self.equation.widths.items() for _ in range(n)])

    def parameters(self) -> np.ndarray:
        load, pull = self.load, self.equation.pull
        mass = load.gamma if pull is None else np.array([load.gamma @ pull / (pull @ pull)])
        parts = {"rotation": so3.log(load.R), "mass": mass, "force bias": load.bias[:3], "centre": load.centre}
        parts["torque bias"] = load.bias[3:]
        return np.concatenate([parts[kind] for kind in self.equation.widths])

    def __call__(self, step: np.ndarray) -> str:
        """Return a description such as "rotation about tool axis z, bias along it, 0.4 rad"."""
        parts = {kind: step[at] for kind, at in self.equation.places.items()}
        sizes = {kind: np.linalg.norm(step[at] / self.widths[at]) for kind, at in self.equation.places.items()}
        first = next(kind for kind in parts if sizes[kind] > 0.5 * max(sizes.values()))
        part = parts[first]
        unit = dict(zip(self.names, self.units))[self.names[self.equation.places[first].start]]
        if first == "rotation":
            text = f"rotation about {axis_text(self.load.R @ part, 'tool')}{_along(self.equation)}"
        elif len(part) == 1:
            text = self.scale
        else:
            axes = "base" if first == "mass" else "sensor"
            kind = {"mass": "weight", "centre": "centre of mass", "torque bias": "bias of torque"}.get(first, "bias")
            text = f"{kind} along {axis_text(part, axes)}"
        if abs(np.linalg.norm(step / self.widths) - 1.0) < UNSEEN:
            return text
        return f"{text}, {np.linalg.norm(part):.2g} {unit}".rstrip()


def _along(equation: WeightEquation) -> str:
    """Return the message suffix for a rotation: the unknowns that are unidentifiable along the rotation axis."""
    return (", bias" + " and centre of mass" * equation.torque + " along it") * equation.bias


@cache
def _labels(widths: tuple[tuple[str, int], ...], scale: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    names, units = [], []
    quantity, weight, single = ("acceleration", "m/s^2", "") if scale == "scale" else ("force", "N", "kg")
    for kind, count in widths:
        label = {"rotation": "R_tool_sensor r", "mass": "weight ", "centre": "centre "}.get(kind, "")
        label = label or f"{kind.replace('force', quantity)} "
        unit = {"rotation": "rad", "centre": "m", "torque bias": "N m"}.get(kind, weight)
        names += [scale] if count == 1 else [f"{label}{axis}" for axis in "xyz"]
        units += [single] if count == 1 else [unit] * count
    return tuple(names), tuple(units)


def require_motion(equation: WeightEquation) -> float:
    """Raise an error if there are too few samples or gravity varies too little; return the variation of gravity along
    its second principal direction."""
    needed = (2 + equation.bias) if equation.pull is not None else (4 + equation.bias)
    if needed > equation.N:
        raise NotExcited(
            f"Expected at least {needed} samples to fit the {equation.what}, got {equation.N}. Rotate the tool about "
            "two horizontal axes and measure again.",
            [f"everything: {equation.N} samples"],
            [f"{equation.N} samples (at least {needed} required)"],
        )
    if equation.pull is None:
        M = equation.RA.mean(axis=0)
        squares, axes = np.linalg.eigh(np.eye(3) - M.T @ M)
        moved, u = np.sqrt(np.maximum(squares[[2, 0]], 0.0)), axes[:, 0]
        still = "the tool orientation does not change"
        line = f"rotation about {axis_text(u, 'tool')}, weight and bias along it"
    else:
        moved = equation.turn.moved[:0:-1]  # in descending order
        u = np.linalg.eigh(equation.turn.H)[1][:, 2]
        still = "gravity in tool axes is constant (rotations about the vertical only)"
        line = f"rotation about {axis_text(u, 'tool')}{_along(equation)}"
    if moved[1] > STILL:
        return float(moved[1])
    direction = still if moved[0] <= STILL else line
    raise NotExcited(
        "Expected orientations that vary gravity in tool axes in two directions, got too little variation: "
        f"{direction}. Rotate the tool about a second horizontal axis.",
        [direction],
        [f"relative variation of gravity {moved[1]:.1e}"],
    )


def require_match(equation: WeightEquation, load: Load, r: np.ndarray, kept: np.ndarray, moved: float) -> None:
    """Raise an error if the readings are inconsistent with gravity although gravity in tool axes varies enough."""
    count = np.count_nonzero(kept)
    power = float(equation.weights[kept] @ np.einsum("ij,ij->i", r[kept, :3], r[kept, :3]))
    if moved < RICH or 2 * count < 3 or (equation.noise is not None and power < 3 * count * ROUGH**2):
        return
    share = _unexplained(equation, load, kept)
    if share < UNEXPLAINED:
        return
    raise NotConverged(
        f"Expected readings that follow gravity as the tool rotates, got {min(share, 1.0):.0%} of their variation "
        f"unexplained. {_cause(equation, kept)}",
        best=load,
        reason="mismatch",
    )


def _unexplained(equation: WeightEquation, load: Load, kept: np.ndarray) -> float:
    """Return the fraction of the force variation that a load does not explain."""
    w = equation.weights[kept] / equation.weights[kept].sum()
    f = equation.y[kept, :3]
    r = f - load.gamma @ (equation.RA[kept] @ load.R)
    if equation.bias:
        f, r = f - w @ f, r - w @ r
    return float(np.sum(w[:, None] * r * r) / max(float(np.sum(w[:, None] * f * f)), np.finfo(float).tiny))


def _cause(equation: WeightEquation, kept: np.ndarray) -> str:
    """Return the likely cause of a misfit, such as a wrong unit."""
    if equation.mass is not None and equation.pull is not None:
        turn = Turn.of(replace(equation, mass=None), kept)
        free = Load(turn.R, turn.m * equation.pull, np.zeros(3), np.zeros(3))
        times = turn.m / equation.mass
        if _unexplained(equation, free, kept) < UNEXPLAINED and abs(np.log(max(times, 1e-300))) > np.log(OTHER_UNIT):
            return f"The readings are {times:.3g} times as large as expected; check the units."
    return "Check that sample i was taken at the same time in both records, and that the poses are tool poses."


def require_right_hand(equation: WeightEquation, kept: np.ndarray) -> str:
    """Raise an error for a mirrored axis or a reversed sign; return a remark if the handedness is undecided."""
    if equation.pull is None:
        return ""
    turn = equation.turn if kept.all() else Turn.of(equation, kept)
    if turn.difference >= HAND:
        return ""
    if turn.difference > -HAND:
        return (
            f"handedness and sign of the sensor are undecided (Delta {turn.difference:.1f}, at least {HAND:.0f} "
            "required): rotate the tool further"
        )
    error = mirrored(equation, turn)
    if _unexplained(equation, error.best, kept) > UNEXPLAINED:
        return ""  # neither handedness explains the readings
    raise error


def require_lever(equation: WeightEquation, load: Load, sd: np.ndarray) -> None:
    """Raise an error for torques in newton millimetres, which give an impossible centre of mass."""
    if not equation.torque:
        return
    away, unsure = np.linalg.norm(load.centre), np.linalg.norm(sd[equation.places["centre"]])
    if away > max(ABSURD, 3.0 * unsure):
        raise NotConverged(
            f"Expected a centre of mass within {ABSURD:.0f} m of the sensor, got {away:.3g} m. Torques seem to be in "
            "N mm: divide them by 1000.",
            best=load,
            reason="units",
        )


def mirrored(equation: WeightEquation, turn: Turn) -> NotConverged:
    """Return the error for a left-handed sensor, with the fit attached."""
    pull = np.zeros(3) if equation.pull is None else equation.pull
    gamma, R = turn.other_m * pull, turn.mirrored
    bias = np.mean(equation.y[:, :3] - gamma @ (equation.RA @ R), axis=0) * equation.bias
    return NotConverged(
        "Expected readings in right-handed axes with the given sign, got the opposite. An axis is mirrored or the "
        f"sign is reversed (Delta {turn.difference:.3g}); the data cannot distinguish the two. Correct the reversed "
        "axis according to the sensor manual, or pass the other sign.",
        best=Load(R, gamma, bias, np.full(3, np.nan)),
        reason="left_handed",
    )


def remarks(words: LoadUnknowns, sd: np.ndarray, squares: float | None, moved: float) -> list[str]:
    equation, load, away = words.equation, words.load, float(np.linalg.norm(words.load.centre))
    lines = [f"relative variation of gravity in tool axes, along its second principal direction: {moved:.2g}"]
    if squares is not None:
        lines.append(f"residuals {np.sqrt(squares):.3g} times the given noise")
    if equation.pull is None:
        lines.append(
            "gravity is unknown: the sign of the sensor is not identifiable and was kept as given; a mirrored axis "
            "with reversed weight would fit equally well"
        )
    if equation.torque and away > FAR:
        lines.append(f"centre of mass {away:.3g} m away: are torques in N mm instead of N m?")
    if equation.pull is not None and equation.mass is None:
        lines += _odd_scale(float(load.gamma @ equation.pull / (equation.pull @ equation.pull)), words)
    if sd[:3].max() > FIRST_ORDER:
        lines.append("standard deviations of the rotation exceed 3 degrees and are only first-order approximations")
    return lines


def _odd_scale(m: float, words: LoadUnknowns) -> list[str]:
    """Return a remark on the units if the mass or the scale is implausible."""
    pull = words.equation.pull
    g = 0.0 if pull is None else float(np.linalg.norm(pull))
    if words.scale == "scale":
        odd = abs(np.log(max(m, 1e-300))) > np.log(OTHER_UNIT)
        return [f"scale of {m:.3g}: are readings or gravity in a unit other than m/s^2?"] if odd else []
    if g < LOW_GRAVITY:
        return [f"gravity of {g:.3g} m/s^2: is it given in units of g?"]
    return [] if LIGHT < m < HEAVY else [f"mass of {m:.3g} kg: are forces in a unit other than N?"]


def require_order_of_tool(equation: WeightEquation, kept: np.ndarray) -> None:
    """Raise an error if another orientation convention explains the forces much better."""
    if equation.pull is None:
        return
    now = equation.turn if kept.all() else Turn.of(equation, kept)
    if now.power < (MISREAD_FAR if now.moved[1] > WIDE else MISREAD) * now.signal:
        return
    for one in readings(equation.RA, np.zeros((equation.N, 3))):
        other = Turn.of(replace(equation, RA=np.ascontiguousarray(one.R)), kept)
        if other.power < MUCH_BETTER * now.power and other.m > 0.0:
            raise NotConverged(
                f"Expected readings that follow gravity as the tool rotates, got {now.power / now.signal:.2g} of their "
                f"variation unexplained. {one.text.format(ROBOT)}",
                best=other,
                reason="mismatch",
            )

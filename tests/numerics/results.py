"""What the kernels make of the inputs in `tables`: `python results.py FILE` writes the results."""

from __future__ import annotations

import json
import sys
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from calls import FAMILIES

FOLDER = Path(__file__).with_name("tables")
UNIT = 2.0**-53  # the largest relative error of one rounding
BOUND = 8.0  # in these units, but for
BOUNDS = {  # the largest found on any instruction set, and half as much to twice as much again
    "jacobian_derivative tool": (32.0, "what turns with the tool is taken off, and is larger than what is left"),
    "rnea": (32.0, "torques of velocity and acceleration, which cancel in part"),
    "SignalOperator lowpass": (64.0, "the lag behind a line through two samples, seven times the signal"),
    "SignalOperator slope": (64.0, "the same"),
    "SignalOperator notch": (64.0, "the same"),
    "presliding": (16.0, "twenty steps one after the other"),
    "solve_wrench map 0": (1600.0, "the condition of the covariance of torque errors, up to 6500"),
    "solve_wrench bounded 0 few joints": (2500.0, "the condition of the information, 4900"),
    "solve_wrench bounded 0 uneven": (250.0, "the condition of the information, 7e6"),
    "solve_wrench bounded 0 singular": (80.0, "the condition of the information, 1200"),
    "solve_wrench bounded 1": (1000.0, "the condition of the information, up to 7e6"),
    "solve_wrench interval 1": (100.0, "the same, 30000"),
    "solve_wrench ls 0 uneven": (6400.0, "the condition of the information, 7800"),
    "solve_wrench ls 1 uneven": (4000.0, "the same"),
    "solve_wrench ls": (128.0, "the same, up to 160"),
    "solve_wrench lund": (64.0, "the condition of its sum, up to 400"),
    "solve_wrench clip": (80.0, "the condition of the information, up to 170"),
    "PrimitiveStepper time ydd": (40.0, "accelerations of spring and force, which cancel in part"),
    "PrimitiveStepper time around ydd": (64.0, "the same, and what guards the clearance"),
    "PrimitiveStepper time": (12.0, "sums of what springs and forces add over the steps"),
    "PrimitiveStepper position ydd": (16.0, "accelerations of spring and force, which cancel in part"),
    "PrimitiveStepper position around ydd": (20.0, "the same, and what guards the clearance"),
    "PrimitiveStepper canonical ydd": (20.0, "accelerations of spring and force, which cancel in part"),
    "momentum_step wandered 1.01": (16.0, "a closed form whose terms cancel in part"),
    "momentum_step 1": (80.0, "the condition of the measured momentum's covariance, 34"),
    "MomentumEstimator observer": (25.0, "changes of momentum that are differences in 4 ms"),
    "MomentumEstimator filter P": (1300.0, "the condition of the filter's covariance; the NumPy oracle errs by 550"),
    "MomentumEstimator filter point P": (800.0, "the same"),
    "MomentumEstimator biased filter point P": (500.0, "the same"),
    "MomentumEstimator": (250.0, "the same, and displacements that are differences of positions"),
    "WrenchEstimator interval": (4e7, "as of wrench_interval"),
    "WrenchEstimator bounded point F": (320.0, "the condition of the information, up to 8800"),
    "WrenchEstimator bounded": (8000.0, "the condition of the information, up to 10000"),
    "WrenchEstimator lund": (400.0, "the condition of its sum, 400"),
    "WrenchEstimator": (
        64.0,
        "accelerations and displacements that are differences in 4 ms, and the condition of the Jacobian",
    ),
    "Obstacles space distance": (64.0, "a gap less a radius, of which a fortieth is left"),
    "Obstacles space": (32.0, "what guards the clearance grows as speed over distance, which is a small difference"),
    "Obstacles plane potential": (12.0, "the same"),
    "Obstacles arm distance": (32.0, "a gap between points that joints carry, less radii"),
    "Obstacles arm": (512.0, "both"),
    "Obstacles rail distance": (128.0, "a gap between points that joints carry, less radii"),
    "Obstacles rail": (128.0, "both"),
    "Obstacles straight potential": (24.0, "the angle to the middle, a difference of two directions"),
    "wrench_interval": (4e7, "the ends move out by up to 2e-10 of the box, which settles ties, and never in"),
    "rotation_rollout time w": (200.0, "between the samples the speed is thirty times what is left at them"),
}
TABLED = {  # tables of kernels that are not called as these are
    "Drive.torque": "Drive",
    "MomentumEstimator.step": "MomentumEstimator",
    "MomentumEstimator.tare": "MomentumEstimator biased filter",
    "Obstacles.add": "Obstacles arm steering",
    "Obstacles.distance": "Obstacles arm distance",
    "PrimitiveStepper.change_goal": "PrimitiveStepper",
    "PrimitiveStepper.change_tau": "PrimitiveStepper",
    "PrimitiveStepper.start": "PrimitiveStepper",
    "PrimitiveStepper.step": "PrimitiveStepper",
    "RotationStepper.change_goal": "RotationStepper",
    "RotationStepper.change_tau": "RotationStepper",
    "RotationStepper.outputs": "RotationStepper",
    "RotationStepper.start": "RotationStepper",
    "RotationStepper.step": "RotationStepper",
    "SignalOperator.run": "SignalOperator",
    "TwoDof.advance": "TwoDof time advance",
    "TwoDof.reference": "TwoDof time reference",
    "TwoDof.slopes": "TwoDof time slopes",
    "TwoDof.time_constant": "TwoDof time time_constant",
    "WrenchEstimator.run": "WrenchEstimator",
}
BYTES = "bytes and texts, no numbers are computed: tests/kernels holds what comes out to what was put in"
LEFT_OUT = {  # kernels without a table, and what holds them instead
    "Chain.forward_jacobian": "gives what forward and jacobian give, to the bit (tests/kernels/test_chain.py)",
    "Datagrams": BYTES,
    "EgmMessages": BYTES,
    "InverseSolver": "a search: tests/numerics/test_tables.py holds the errors it tells to exact poses",
    "MessageCopier": BYTES,
    "MomentumEstimator.reset": "forgets, and computes nothing",
    "MomentumEstimator.run": "the samples of step, one after the other",
    "Obstacles.advance": "one product and one sum",
    "Obstacles.place": "takes what it is given",
    "Primitive.design": "values of basis times factors, in their places",
    "PrimitiveStepper.follow": "the steps of step, one after the other",
    "PrimitiveStepper.outputs": "what step returns",
    "RowEncoder": BYTES,
    "RowPacker": BYTES,
    "SignalOperator.reset": "forgets, and computes nothing",
    "SignalOperator.step": "the samples of run, one after the other",
    "TwoDof.follow": "advance, then reference",
    "WrenchEstimator.reset": "forgets, and computes nothing",
    "WrenchEstimator.step": "the samples of run, one after the other",
    "follow_path": "the same, row by row",
    "poses": "refuses what is no pose, and returns the rest as it came",
    "rotations": "refuses what is no rotation, and returns the rest as it came",
}
MANY = 1000  # random samples, for what differs seldom
DRAWN = ("chains", "filters", "groups")  # topics whose inputs may be any numbers


def unpacked(topic: dict[str, Any], value: Any, *place: str) -> Any:
    """Return an array, or those of a part; the name of an earlier table stands for what it has in that place."""
    if isinstance(value, dict):
        return {key: unpacked(topic, inside, *place, key) for key, inside in value.items()}
    if isinstance(value, str):
        return reduce(getitem, place, topic[value])
    shape, digits = value
    return np.frombuffer(bytes.fromhex(digits), dtype=">f8").astype(float).reshape(shape)


def tables(folder: Path = FOLDER) -> dict[str, dict[str, Any]]:
    """Return inputs and exact results by topic and name."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.glob("*.json")):
        topic: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for name, table in topic.items():
            topic[name] = {part: unpacked(topic, value, part) for part, value in table.items()}
            found[f"{path.stem}/{name}"] = topic[name]
    return found


def result(module: Any, key: str, table: dict[str, Any]) -> np.ndarray:
    """Return what a module makes of the inputs of a table, in the shape of its exact results."""
    topic, _, name = key.partition("/")
    found = FAMILIES[topic](module, name, table["given"], table.get("fixed", {}))
    return np.reshape(found, table["wanted"].shape)


def bound(key: str) -> float:
    """Return how large the error of a table may be."""
    return next((limit for name, (limit, _) in BOUNDS.items() if key.partition("/")[2].startswith(name)), BOUND)


def error(table: dict[str, Any], found: np.ndarray) -> float:
    """Return the worst error of a sample by its largest entry, in units of one rounding.

    An angle beyond 1 rad is a double that is rounded by itself: there the unit grows as the angle.
    """
    wanted, given = table["wanted"], table["given"]
    off, size = (np.abs(a).reshape(len(wanted), -1).max(axis=1) for a in (found - wanted, wanted))
    angles = next((given[key] for key in ("w", "xi", "q", "x") if key in given), np.zeros(1))
    angles = angles[:, -3:] if "xi" in given else angles
    turns = np.abs(angles.reshape(len(angles), -1)).max(axis=1) if len(angles) == len(wanted) else 1.0
    return float(np.max(off / np.where(off == 0, 1.0, size * np.maximum(turns, 1.0))) / UNIT)


def drawn(key: str, name: str, like: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random samples of one input, made with sums, products and roots alone: the same on every machine."""
    if like.shape[1:] not in ((3, 3), (4, 4)) and "quaternion" not in key:
        return rng.uniform(0.0 if name == "s" else -3.0, 1.0 if name == "s" else 3.0, (MANY, *like.shape[1:]))
    if name == "s":
        return rng.uniform(0.0, 1.0, (MANY, 1))
    w, x, y, z = quaternion = rng.uniform(-1.0, 1.0, (4, MANY))
    w, x, y, z = quaternion = quaternion / np.sqrt(w * w + x * x + y * y + z * z)
    if like.ndim == 2:
        return np.ascontiguousarray(quaternion.T)
    M = np.tile(np.eye(like.shape[1]), (MANY, 1, 1))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    M[:, :3, :3] = np.moveaxis(np.array(rows), -1, 0)
    if like.shape[1] == 4:
        M[:, :3, 3] = rng.uniform(-1.0, 1.0, (MANY, 3))
    return M


def many() -> dict[str, dict[str, Any]]:
    """Return the tables with random samples instead of theirs, where a kernel takes samples; without exact results."""
    rng, found = np.random.default_rng(3), {}
    for key, table in tables().items():
        count = len(table["wanted"])
        if count > 1 and key.partition("/")[0] in DRAWN:
            of_samples = {k for k, v in table["given"].items() if v.shape[:1] == (count,) and k != "pi"}
            given = {k: drawn(key, k, v, rng) if k in of_samples else v for k, v in table["given"].items()}
            found[key] = {**table, "given": given, "wanted": np.zeros((MANY, *table["wanted"].shape[1:]))}
    return found


if __name__ == "__main__":
    from armlab import kernels

    found = {key: result(kernels, key, table) for key, table in tables().items()}
    found |= {f"many {key}": result(kernels, key, table) for key, table in many().items()}
    np.savez(sys.argv[1], **{key.replace("/", ":"): values for key, values in found.items()})

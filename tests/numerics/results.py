"""Results of the kernels for the inputs in `tables`: `python results.py FILE` writes them."""

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
BOUND = 8.0  # in these units, except for
BOUNDS = {  # the largest found on any instruction set, plus 50 to 200 %
    "jacobian_derivative tool": (32.0, "the subtracted rotation term is larger than the result"),
    "rnea": (32.0, "velocity and acceleration torques partly cancel"),
    "SignalOperator lowpass": (64.0, "lag relative to linear interpolation, seven times the signal"),
    "SignalOperator slope": (64.0, "lag relative to linear interpolation, seven times the signal"),
    "SignalOperator notch": (64.0, "lag relative to linear interpolation, seven times the signal"),
    "presliding": (16.0, "twenty successive steps"),
    "solve_wrench map 0": (2800.0, "condition number of the torque error covariance, up to 6500"),
    "solve_wrench bounded 0 few joints": (2500.0, "condition number of the information matrix, 4900"),
    "solve_wrench bounded 0 uneven": (250.0, "condition number of the information matrix, 7e6"),
    "solve_wrench bounded 0 singular": (80.0, "condition number of the information matrix, 1200"),
    "solve_wrench bounded 1": (1000.0, "condition number of the information matrix, up to 7e6"),
    "solve_wrench interval 1": (100.0, "condition number of the information matrix, 30000"),
    "solve_wrench ls 0 uneven": (6400.0, "condition number of the information matrix, 7800"),
    "solve_wrench ls 1 uneven": (4000.0, "condition number of the information matrix, 7800"),
    "solve_wrench ls": (128.0, "condition number of the information matrix, up to 160"),
    "solve_wrench lund": (64.0, "condition number of its sum, up to 400"),
    "solve_wrench clip": (80.0, "condition number of the information matrix, up to 170"),
    "PrimitiveStepper time ydd": (40.0, "spring and forcing accelerations partly cancel"),
    "PrimitiveStepper time around ydd": (64.0, "spring and forcing accelerations partly cancel; clearance guard"),
    "PrimitiveStepper time": (12.0, "accumulated spring and forcing terms"),
    "PrimitiveStepper position ydd": (16.0, "spring and forcing accelerations partly cancel"),
    "PrimitiveStepper position around ydd": (20.0, "spring and forcing accelerations partly cancel; clearance guard"),
    "PrimitiveStepper canonical ydd": (20.0, "spring and forcing accelerations partly cancel"),
    "momentum_step wandered 1.01": (16.0, "terms of a closed form partly cancel"),
    "momentum_step 1": (80.0, "condition number of the momentum covariance, 34"),
    "MomentumEstimator observer": (25.0, "momentum differences over 4 ms"),
    "MomentumEstimator filter P": (
        1300.0,
        "condition number of the filter covariance; the NumPy oracle has an error of 550",
    ),
    "MomentumEstimator filter point P": (800.0, "condition number of the filter covariance"),
    "MomentumEstimator biased filter point P": (500.0, "condition number of the filter covariance"),
    "MomentumEstimator biased filter point F": (700.0, "condition number of the filter covariance"),
    "MomentumEstimator filter F": (600.0, "condition number of the filter covariance"),
    "MomentumEstimator": (
        250.0,
        "condition number of the filter covariance, and displacements as position differences",
    ),
    "WrenchEstimator interval": (4e7, "see wrench_interval"),
    "WrenchEstimator bounded point F": (320.0, "condition number of the information matrix, up to 8800"),
    "WrenchEstimator bounded": (8000.0, "condition number of the information matrix, up to 10000"),
    "WrenchEstimator lund": (400.0, "condition number of its sum, 400"),
    "WrenchEstimator": (
        64.0,
        "accelerations and displacements as differences over 4 ms, and condition number of the Jacobian",
    ),
    "Obstacles space distance": (64.0, "difference of a gap and a radius, a fortieth of either"),
    "Obstacles space": (32.0, "guard term: speed over a small difference of distances"),
    "Obstacles plane potential": (12.0, "guard term: speed over a small difference of distances"),
    "Obstacles arm distance": (32.0, "gap between points on links, less radii"),
    "Obstacles arm": (512.0, "guard term and gap between points on links"),
    "Obstacles rail distance": (128.0, "gap between points on links, less radii"),
    "Obstacles rail": (128.0, "guard term and gap between points on links"),
    "Obstacles straight potential": (24.0, "angle to the centre, a difference of two directions"),
    "wrench_interval": (4e7, "to break ties, limits move outwards by up to 2e-10 of the box, never inwards"),
    "rotation_rollout time w": (200.0, "the speed between samples is thirty times that at the samples"),
}
_STEPPING = ("change_goal", "change_tau", "start", "step")
TABLED = {  # kernels whose tables have another name
    "Drive.torque": "Drive",
    "MomentumEstimator.step": "MomentumEstimator",
    "MomentumEstimator.tare": "MomentumEstimator biased filter",
    "Obstacles.add": "Obstacles arm steering",
    "Obstacles.distance": "Obstacles arm distance",
    **{f"PrimitiveStepper.{name}": "PrimitiveStepper" for name in _STEPPING},
    **{f"RotationStepper.{name}": "RotationStepper" for name in (*_STEPPING, "outputs")},
    "SignalOperator.run": "SignalOperator",
    **{f"TwoDof.{name}": f"TwoDof time {name}" for name in ("advance", "reference", "slopes", "time_constant")},
    "WrenchEstimator.run": "WrenchEstimator",
}
BY_PINOCCHIO = "by Pinocchio to 1e-12, derivatives to 1e-9 (tests/dynamics), and parts of rnea and mass_matrix"
BYTES = "bytes and texts only: tests/kernels compares output with input"
LEFT_OUT = {  # kernels without a table, with their other tests
    "Chain.forward_jacobian": "bit-identical to forward and jacobian (tests/kernels/test_chain.py)",
    "Datagrams": BYTES,
    "EgmMessages": BYTES,
    "await_datagram": "waits; no arithmetic",
    "filled": "stores its arguments",
    **dict.fromkeys(
        ("filtered_velocity", "following_error", "implausible"),
        "by an oracle (tests/kernels/test_limits.py)",
    ),
    "InverseSolver": "a search; tests/numerics/test_tables.py compares its reported errors with exact poses",
    "MessageCopier": BYTES,
    "MomentumEstimator.reset": "resets the state without computation",
    "MomentumEstimator.run": "successive samples of step",
    "Obstacles.advance": "one product and one sum",
    "Obstacles.place": "stores its arguments",
    "Primitive.design": "products of basis values and factors",
    "PrimitiveStepper.follow": "successive calls of step",
    "PrimitiveStepper.outputs": "the result of step",
    **{
        f"RigidBody.{name}": BY_PINOCCHIO
        for name in (
            "coriolis_matrix",
            "coriolis_torque",
            "energy",
            "forward_dynamics",
            "forward_dynamics_derivatives",
            "gravity_torque",
            "rnea_derivatives",
        )
    },
    "RowEncoder": BYTES,
    "RowPacker": BYTES,
    "SignalOperator.reset": "resets the state without computation",
    "SignalOperator.step": "successive samples of run",
    "TwoDof.follow": "advance, then reference",
    "WrenchEstimator.reset": "resets the state without computation",
    "WrenchEstimator.step": "successive samples of run",
    "follow_path": "see InverseSolver, row by row",
    "poses": "validates poses and returns them unchanged",
    "rotations": "validates rotations and returns them unchanged",
}
MANY = 1000  # random samples, for rare differences
DRAWN = ("chains", "filters", "groups")  # topics whose inputs may be any numbers


def unpacked(topic: dict[str, Any], value: Any, *place: str) -> Any:
    """Return an array, or those of a part; the name of an earlier table stands for its entry in that place."""
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
    """Return the results of a module for the inputs of a table, in the shape of its exact results."""
    topic, _, name = key.partition("/")
    found = FAMILIES[topic](module, name, table["given"], table.get("fixed", {}))
    return np.reshape(found, table["wanted"].shape)


def bound(key: str) -> float:
    """Return the largest allowed error of a table."""
    return next((limit for name, (limit, _) in BOUNDS.items() if key.partition("/")[2].startswith(name)), BOUND)


def error(table: dict[str, Any], found: np.ndarray) -> float:
    """Return the worst error of a sample relative to its largest entry, in units of one rounding.

    An angle beyond 1 rad is itself a rounded double, so there the unit grows with the angle.
    """
    wanted, given = table["wanted"], table["given"]
    off, size = (np.abs(a).reshape(len(wanted), -1).max(axis=1) for a in (found - wanted, wanted))
    angles = next((given[key] for key in ("w", "xi", "q", "x") if key in given), np.zeros(1))
    angles = angles[:, -3:] if "xi" in given else angles
    turns = np.abs(angles.reshape(len(angles), -1)).max(axis=1) if len(angles) == len(wanted) else 1.0
    return float(np.max(off / np.where(off == 0, 1.0, size * np.maximum(turns, 1.0))) / UNIT)


def drawn(key: str, name: str, like: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random samples of one input, made only with sums, products and roots: the same on every machine."""
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
    """Return the tables of kernels that take samples, with random samples and without exact results."""
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

"""The file of a torque model: what its tables hold, made to be read by people, and back."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from armlab.errors import ConfigError, ModelMismatchError, UnknownName
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.quality import Quality
from armlab.models.registry import decode, encode, provenance
from armlab.models.torque import SIGN, TorqueModel
from armlab.models.training import Training
from armlab.models.velocity_covariance import VelocityCovariance

__all__ = ["KIND", "read_torque_model", "torque_tables"]

KIND = "torque_model"
FORMAT = 5
FRICTION = tuple(entry.name for entry in fields(Friction))
RIPPLE = ("cycles", "cosine", "sine")
BOUND = ("torque", "speed", "floor")
PARTS = ("lines", "friction_map", "warm_up", "momentum", "coupled")  # where there are any
QUALITY = ("torque_sd", "rms", "rms_cv", "coverage")
LIMITS = ("q_min", "q_max", "qd_peak", "speed_share")  # of the training
UNITS = {
    "link_parameters": "kg, kg m, kg m^2; order m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz; link frames",
    "rotor": "kg m^2",
    "friction": "N m, rad, s",
    "ripple": "N m; cycles in rad/rad",
    "lines": "N m; cycles per revolution; speeds in rad/s",
    "friction_map": "N m, rad, rad/s",
    "warm_up": "s, W",
    "momentum": "s, rad/s",
    "coupled": "kg m^2, N m, rad, s",
    "ctau": "(N m)^2, s/rad",
    "bound": "N m, rad/s",
    "limits": "rad, rad/s, s; ranges of the training data",
    "validation": "N m, s",
}


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A table of the file: unknown keys are errors."""


class _Meta(_Strict):
    kind: str
    format: int
    armlab: str
    command: str
    created: str
    sources: list[str]
    robot: str
    robot_hash: str
    sign: str
    units: dict[str, str]


class _RobotPart(_Strict):
    frames: list[list[list[float]]]
    prismatic: list[bool]
    gravity: list[float]


class _Dynamics(_Strict):
    link_parameters: list[list[float]]
    rotor: list[float]
    base_names: list[str]
    base_values: list[float]
    base_cov_lower: list[float]
    gains: list[float]
    gain_cov: list[list[float]]
    quasi_static: bool = False


class _Covariance(_Strict):
    kind: str
    C0: list[float]
    Cinf: list[float]
    shape: list[float]
    alpha2: float
    cutoff: float


class _Validation(_Strict):
    torque_sd: list[float]
    rms: list[float]
    rms_cv: list[float]
    coverage: list[float]
    seconds: float


class _Limits(_Strict):
    q_min: list[float]
    q_max: list[float]
    qd_peak: list[float]
    speed_share: list[list[float]]
    rest_share: float
    longest_rest: float


class _File(_Strict):
    meta: _Meta
    robot: _RobotPart
    dynamics: _Dynamics
    friction: dict[str, dict[str, float]]
    ripple: dict[str, dict[str, float]]
    ctau: _Covariance
    bound: dict[str, dict[str, float]]
    limits: _Limits
    validation: _Validation
    lines: dict[str, Any] | None = None
    friction_map: dict[str, Any] | None = None
    warm_up: dict[str, Any] | None = None
    momentum: dict[str, Any] | None = None
    coupled: dict[str, Any] | None = None
    fit: dict[str, Any] | None = None


def torque_tables(model: TorqueModel) -> dict[str, Any]:
    """Return the tables of the file of a torque model.

    Parameters
    ----------
    model : to save.
    """
    lower = np.tril_indices(len(model.base_names))
    c, q = model.covariance, model.quality
    return {
        "meta": {**provenance(KIND, model), "format": FORMAT, "sign": SIGN, "units": UNITS},
        "robot": {
            "frames": model.frames.tolist(),
            "prismatic": [bool(p) for p in model.prismatic],
            "gravity": model.gravity.tolist(),
        },
        "dynamics": {
            "link_parameters": model.link_parameters.tolist(),
            "rotor": model.rotor.tolist(),
            "quasi_static": model.quasi_static,
            "base_names": list(model.base_names),
            "base_values": model.base_values.tolist(),
            "base_cov_lower": model.base_cov[lower].tolist(),
            "gains": model.gains.tolist(),
            "gain_cov": model.gain_cov.tolist(),
        },
        "friction": _by_joint(model.friction, FRICTION),
        "ripple": _by_joint(model.ripple, RIPPLE),
        "ctau": {
            "kind": c.kind,
            "C0": c.C0.tolist(),
            "Cinf": c.Cinf.tolist(),
            "shape": c.shape.tolist(),
            "alpha2": c.alpha2,
            "cutoff": model.cutoff,
        },
        "bound": _by_joint(model.bound, BOUND),
        "limits": {
            **{name: getattr(model.training, name).tolist() for name in LIMITS},
            "rest_share": model.training.rest_share,
            "longest_rest": model.training.longest_rest,
        },
        "validation": {**{name: getattr(q, name).tolist() for name in QUALITY}, "seconds": q.seconds},
        **{name: encode(part) for name in PARTS if (part := getattr(model, name)) is not None},
    }


def _by_joint(part: Friction | FrictionBound | Ripple, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    count = len(getattr(part, names[0]))
    return {f"joint{i + 1}": {name: float(getattr(part, name)[i]) for name in names} for i in range(count)}


def _joined(tables: dict[str, dict[str, float]], names: tuple[str, ...], path: Path) -> dict[str, np.ndarray]:
    try:
        return {name: np.array([tables[f"joint{i + 1}"][name] for i in range(len(tables))]) for name in names}
    except KeyError as error:
        raise ConfigError(f"Expected {error} for every joint in {path}, got none. Identify again.") from None


def read_torque_model(raw: dict[str, Any], path: Path) -> TorqueModel:
    """Return the model of the tables of a file.

    Parameters
    ----------
    raw : tables, with [meta]. path : of the file, for messages.

    Raises
    ------
    ConfigError : tables that are damaged or unknown. ModelMismatchError : another kind, format or sign convention.
    """
    meta = raw["meta"]
    found = tuple(meta.get(key) for key in ("kind", "format", "sign"))
    if found != (KIND, FORMAT, SIGN):
        raise ModelMismatchError(
            f"Expected kind, format and sign {(KIND, FORMAT, SIGN)} in {path}, got {found}. "
            "Identify again with this version of armlab."
        )
    try:
        return _model(msgspec.convert(raw, _File), path)
    except ConfigError:
        raise
    except (msgspec.ValidationError, UnknownName, KeyError, TypeError, ValueError) as error:
        what = str(error).rstrip(".")
        raise ConfigError(f"Expected a complete model file at {path}, got: {what}. Identify again.") from None


def _model(file: _File, path: Path) -> TorqueModel:
    d = file.dynamics
    p = len(d.base_names)
    if len(d.base_values) != p or len(d.base_cov_lower) != p * (p + 1) // 2:
        raise ConfigError(f"Expected {p} base values with covariance in {path}, got other lengths. Identify again.")
    cov = np.zeros((p, p))
    cov[np.tril_indices(p)] = d.base_cov_lower
    cov = cov + np.tril(cov, -1).T
    c, validation = file.ctau, file.validation
    return TorqueModel(
        robot_name=file.meta.robot,
        robot_hash=file.meta.robot_hash,
        frames=np.array(file.robot.frames),
        prismatic=np.array(file.robot.prismatic),
        gravity=np.array(file.robot.gravity),
        link_parameters=np.array(d.link_parameters),
        rotor=np.array(d.rotor),
        quasi_static=d.quasi_static,
        friction=Friction(**_joined(file.friction, FRICTION, path)),
        ripple=Ripple(**_joined(file.ripple, RIPPLE, path)),
        covariance=VelocityCovariance(c.kind, np.array(c.C0), np.array(c.Cinf), np.array(c.shape), c.alpha2),
        bound=FrictionBound(**_joined(file.bound, BOUND, path)),
        cutoff=c.cutoff,
        base_names=tuple(d.base_names),
        base_values=np.array(d.base_values),
        base_cov=cov,
        gains=np.array(d.gains),
        gain_cov=np.array(d.gain_cov),
        quality=Quality(**{name: np.array(getattr(validation, name)) for name in QUALITY}, seconds=validation.seconds),
        training=Training(
            **{name: np.array(getattr(file.limits, name)) for name in LIMITS},
            rest_share=file.limits.rest_share,
            longest_rest=file.limits.longest_rest,
        ),
        sources=tuple(file.meta.sources),
        **{name: decode(part) for name in PARTS if (part := getattr(file, name)) is not None},
    )

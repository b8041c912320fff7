"""Model files: TOML with provenance, exact to the last digit, bound to one robot.

A file begins with ``[meta]``: kind, format, armlab version, command line, UTC time, sources with their SHA-256, robot
name and hash, and the sign convention of the wrench. A loader refuses another kind, format or sign. The torque model
has tables that are made to be read by people; other values are written by `armlab.models.files`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

import armlab
from armlab._toml import TomlError, parsed
from armlab._whole_files import whole_file
from armlab.errors import ConfigError, ModelMismatchError, UnknownName
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.torque import SIGN, Quality, TorqueModel, Training, VelocityCovariance

# Values that have a file format: any frozen dataclass of numbers, texts and arrays, once it is registered.
#
#     [meta]   kind, package of its class, format, armlab version, command line, UTC time, sources, robot name and hash
#     [value]  the fields of the value
#     [fit]    what the fit knew of them: names, units, covariance, noise, outliers
#
# Numbers are written with 17 digits and arrays row by row, so that what is read is bit-equal to what was written. A
# class anywhere in the package registers itself by `register`; `models.save` and `models.load` do the rest.


FORMAT = 1

_CLASSES: dict[str, type] = {}


def register(kind: str, cls: type) -> None:
    """Give a frozen dataclass a file format.

    Parameters
    ----------
    kind : name of the format, written into the file; for example "hand_eye".
    cls : its fields are numbers, texts, arrays, tuples and dicts of these, None, or other registered values. Its
        constructor must take what its fields hold.
    """
    if not is_dataclass(cls) or _CLASSES.setdefault(kind, cls) is not cls:
        raise ConfigError(f"Expected a dataclass and a kind of its own, got {cls.__name__} and {kind!r}.")


def kind_of(value: object) -> str:
    """Return the kind of a registered value."""
    for kind, cls in _CLASSES.items():
        if type(value) is cls:
            return kind
    raise ConfigError(
        f"Expected a value with a file format, got {type(value).__name__}. "
        f"These have one: {', '.join(sorted(c.__name__ for c in _CLASSES.values())) or 'none'} and TorqueModel."
    )


def provenance(kind: str, value: object) -> dict[str, Any]:
    """Return the table [meta] of a file that is written now."""
    return {
        "kind": kind,
        "format": FORMAT,
        "armlab": armlab.__version__,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "created": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "sources": list(getattr(value, "sources", ())),
        "robot": getattr(value, "robot_name", ""),
        "robot_hash": getattr(value, "robot_hash", ""),
    }


def value_file(value: object) -> dict[str, Any]:
    """Return the tables [meta] and [value] of a registered value, with the UNITS of its fields where it has them."""
    kind = kind_of(value)
    meta, units = provenance(kind, value), _units(value)
    meta["package"] = type(value).__module__.rpartition(".")[0]
    if units:
        meta["units"] = units
    return {"meta": meta, "value": encode(value)["fields"]}


def _units(value: Any, prefix: str = "") -> dict[str, str]:
    """Return the UNITS of a value and, by "part.field", those of the values that are its fields."""
    found = {prefix + name: unit for name, unit in getattr(type(value), "UNITS", {}).items()}
    for field in fields(value):
        part = getattr(value, field.name)
        if type(part) in _CLASSES.values():
            found |= _units(part, f"{prefix}{field.name}.")
    return found


def _check_units(written: Any, known: Mapping[str, str]) -> None:
    """Refuse units in a file that are not those in which its numbers are read."""
    for name, unit in written.items() if isinstance(written, dict) else ():
        if known.get(name) != unit:
            raise ConfigError(
                f"Expected [meta.units] to say {known.get(name)!r} for {name}, got {unit!r}. No number is "
                "converted: write them in the first."
            )


def _check_texts(value: Any, path: Path) -> None:
    """Refuse a value whose sources and robot could not be named again in [meta]."""
    known = provenance("", value)
    texts = [*(("sources", one) for one in known["sources"]), *((k, known[k]) for k in ("robot", "robot_hash"))]
    for name, text in texts:
        if not isinstance(text, str):
            raise ConfigError(f"Expected texts for {name} at {path}, got {text!r}. Make the file again.")


def read_value(raw: Mapping[str, Any], path: Path) -> Any:
    """Return the value of a file's tables."""
    meta = raw["meta"]
    kind, version, package = str(meta.get("kind")), meta.get("format"), str(meta.get("package", "")) or "the package"
    owner = package.removeprefix("armlab.")
    if kind not in _CLASSES and owner in armlab.__all__:
        getattr(armlab, owner)  # is imported by that, and its kinds are registered
    if kind not in _CLASSES or version != FORMAT:
        raise ModelMismatchError(
            f"Expected a file of format {FORMAT} and a kind of {sorted({*_CLASSES, 'torque_model'})} at {path}, got "
            f"{kind!r} in format {version}. Import {package} that made it, or make it again."
        )
    with _readable(f"the fields of a {kind} at {path}", "Make the file again."):
        value = decode({"kind": kind, "fields": raw["value"]})
        _check_units(meta.get("units", {}), _units(value))
        _check_texts(value, path)
        return value


@contextmanager
def _readable(wanted: str, advice: str) -> Iterator[None]:
    """Refuse what a file holds in a sentence, whatever its numbers and texts make of it."""
    try:
        yield
    except ConfigError:
        raise
    except (msgspec.ValidationError, UnknownName, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"Expected {wanted}, got: {str(error).rstrip('.')}. {advice}") from None


def encode(item: Any) -> Any:
    """Return numbers, texts, lists and tables that TOML can hold; None becomes an empty table."""
    if isinstance(item, np.ndarray):
        return {"shape": list(item.shape), "array": item.tolist()} if not item.size else {"array": item.tolist()}
    if item is None:
        return {}
    if isinstance(item, (bool, int, float, str)):
        return item
    if isinstance(item, np.generic):
        return item.item()
    if isinstance(item, (tuple, list)):
        return {"tuple": [encode(part) for part in item]}
    if isinstance(item, Mapping):
        return {"table": {str(key): encode(part) for key, part in item.items()}}
    return {"kind": kind_of(item), "fields": {f.name: encode(getattr(item, f.name)) for f in fields(item)}}


def decode(item: Any) -> Any:
    """Return the field that `encode` has turned into tables."""
    if not isinstance(item, dict):
        return item
    if "array" in item:
        values = np.array(item["array"])
        return values.reshape(item["shape"]).astype(float) if "shape" in item else values
    if "tuple" in item:
        return tuple(decode(part) for part in item["tuple"])
    if "table" in item:
        return {key: decode(part) for key, part in item["table"].items()}
    if "kind" in item:
        return _CLASSES[item["kind"]](**{name: decode(part) for name, part in item["fields"].items()})
    if item:
        raise ConfigError(
            "Expected a table with array, tuple, table or kind, or an empty one, got one with "
            f"{sorted(item)[0][:60]!r}. Make the file again."
        )
    return None


# The file of a torque model: what its tables hold, made to be read by people, and back.


KIND = "torque_model"
TORQUE_FORMAT = 6
FRICTION = tuple(entry.name for entry in fields(Friction))
RIPPLE = tuple(entry.name for entry in fields(Ripple))
BOUND = tuple(entry.name for entry in fields(FrictionBound))
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


ROBOT = ("frames", "prismatic", "gravity")
DYNAMICS = ("link_parameters", "rotor", "base_values", "gains", "gain_cov", "load_sd")  # arrays among them
COVARIANCE = ("C0", "Cinf", "shape")


def _strict(name: str, *optional: str, **types: Any) -> type[msgspec.Struct]:
    """Return the type of a table of the file; unknown keys are errors."""
    given = [(key, of) for key, of in types.items() if key not in optional]
    return msgspec.defstruct(name, [*given, *((key, types[key], None) for key in optional)], forbid_unknown_fields=True)


_Row, _Rows, _ByJoint, _Part = list[float], list[list[float]], dict[str, dict[str, float]], dict[str, Any] | None
_Meta = _strict(
    "Meta", kind=str, format=int, armlab=str, command=str, created=str, sources=list[str], robot=str, robot_hash=str,
    sign=str, units=dict[str, str],
)  # fmt: skip
_Dynamics = _strict(
    "Dynamics", "quasi_static", link_parameters=_Rows, rotor=_Row, base_names=list[str], base_values=_Row,
    base_cov_lower=_Row, gains=_Row, gain_cov=_Rows, load_sd=_Row,
    quasi_static=bool | None,
)  # fmt: skip
_ModelFile = _strict(
    "ModelFile", *PARTS, "fit", meta=_Meta,
    robot=_strict("RobotPart", frames=list[_Rows], prismatic=list[bool], gravity=_Row), dynamics=_Dynamics,
    friction=_ByJoint, ripple=_ByJoint, bound=_ByJoint,
    ctau=_strict("Covariance", kind=str, alpha2=float, cutoff=float, **dict.fromkeys(COVARIANCE, _Row)),
    limits=_strict(
        "Ranges", q_min=_Row, q_max=_Row, qd_peak=_Row, speed_share=_Rows, rest_share=float, longest_rest=float
    ),
    validation=_strict("Validation", seconds=float, **dict.fromkeys(QUALITY, _Row)),
    **dict.fromkeys((*PARTS, "fit"), _Part),
)  # fmt: skip


def torque_tables(model: TorqueModel) -> dict[str, Any]:
    """Return the tables of the file of a torque model."""
    lower = np.tril_indices(len(model.base_names))
    c, training, quality = model.covariance, model.training, model.quality
    rest = {"rest_share": training.rest_share, "longest_rest": training.longest_rest}
    return {
        "meta": {**provenance(KIND, model), "format": TORQUE_FORMAT, "sign": SIGN, "units": UNITS},
        "robot": _lists(model, ROBOT),
        "dynamics": {
            **_lists(model, DYNAMICS[:2]),
            "quasi_static": model.quasi_static,
            "base_names": list(model.base_names),
            **_lists(model, DYNAMICS[2:3]),
            "base_cov_lower": model.base_cov[lower].tolist(),
            **_lists(model, DYNAMICS[3:]),
        },
        "friction": _by_joint(model.friction, FRICTION),
        "ripple": _by_joint(model.ripple, RIPPLE),
        "ctau": {"kind": c.kind, **_lists(c, COVARIANCE), "alpha2": c.alpha2, "cutoff": model.cutoff},
        "bound": _by_joint(model.bound, BOUND),
        "limits": {**_lists(training, LIMITS), **rest},
        "validation": {**_lists(quality, QUALITY), "seconds": quality.seconds},
        **{name: encode(part) for name in PARTS if (part := getattr(model, name)) is not None},
    }


def _lists(part: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(part, name).tolist() for name in names}


def _arrays(table: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: np.array(getattr(table, name)) for name in names}


def _by_joint(part: Friction | FrictionBound | Ripple, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    count = len(getattr(part, names[0]))
    return {f"joint{i + 1}": {name: float(getattr(part, name)[i]) for name in names} for i in range(count)}


def _joined(tables: dict[str, dict[str, float]], names: tuple[str, ...], path: Path) -> dict[str, np.ndarray]:
    try:
        return {name: np.array([tables[f"joint{i + 1}"][name] for i in range(len(tables))]) for name in names}
    except KeyError as error:
        raise ConfigError(f"Expected {error} for every joint in {path}, got none. Identify again.") from None


def read_torque_model(raw: dict[str, Any], path: Path) -> TorqueModel:
    """Return the model of the tables of a file."""
    meta = raw["meta"]
    found = tuple(meta.get(key) for key in ("kind", "format", "sign"))
    if found != (KIND, TORQUE_FORMAT, SIGN):
        raise ModelMismatchError(
            f"Expected kind, format and sign {(KIND, TORQUE_FORMAT, SIGN)} in {path}, got {found}. "
            "Identify again with this version of armlab."
        )
    with _readable(f"a complete model file at {path}", "Identify again."):
        return _model(msgspec.convert(raw, _ModelFile), path)


def _model(file: Any, path: Path) -> TorqueModel:
    d, c, limits = file.dynamics, file.ctau, file.limits
    p = len(d.base_names)
    if len(d.base_values) != p or len(d.base_cov_lower) != p * (p + 1) // 2:
        raise ConfigError(f"Expected {p} base values with covariance in {path}, got other lengths. Identify again.")
    cov = np.zeros((p, p))
    cov[np.tril_indices(p)] = d.base_cov_lower
    return TorqueModel(
        robot_name=file.meta.robot,
        robot_hash=file.meta.robot_hash,
        **_arrays(file.robot, ROBOT),
        **_arrays(d, DYNAMICS),
        quasi_static=bool(d.quasi_static),
        friction=Friction(**_joined(file.friction, FRICTION, path)),
        ripple=Ripple(**_joined(file.ripple, RIPPLE, path)),
        covariance=VelocityCovariance(c.kind, **_arrays(c, COVARIANCE), alpha2=c.alpha2),
        bound=FrictionBound(**_joined(file.bound, BOUND, path)),
        cutoff=c.cutoff,
        base_names=tuple(d.base_names),
        base_cov=cov + np.tril(cov, -1).T,
        quality=Quality(**_arrays(file.validation, QUALITY), seconds=file.validation.seconds),
        training=Training(**_arrays(limits, LIMITS), rest_share=limits.rest_share, longest_rest=limits.longest_rest),
        sources=tuple(file.meta.sources),
        **{name: decode(part) for name in PARTS if (part := getattr(file, name)) is not None},
    )


def save(
    value: Any, path: str | Path, statistics: Mapping[str, Any] | None = None, sources: Sequence[str] = ()
) -> Path:
    """Write a model file and return its path; an existing file is replaced in one step or not at all.

    Parameters
    ----------
    value : a `TorqueModel`, or an instance of a class that `registry.register` knows.
    path : ends in ``.toml``.
    statistics : what a fit knew of the value, kept in the table [fit].
    sources : names of files that it comes from, with their SHA-256, besides those that the value knows.

    Raises
    ------
    ConfigError : another ending, or a value whose class has no file format. OSError : it cannot be written.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise ConfigError(f"Expected a model file name that ends in .toml, got {path}. Add the ending.")
    content = torque_tables(value) if isinstance(value, TorqueModel) else value_file(value)
    content["meta"]["sources"] = [*content["meta"]["sources"], *sources]
    if statistics is not None:
        content["fit"] = {name: encode(part) for name, part in statistics.items()}
    with whole_file(path) as part:
        part.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


def load(path: str | Path, kind: str | None = None) -> Any:
    """Read the value of a model file: a `TorqueModel`, or whatever was saved.

    Parameters
    ----------
    path : file written by `save`.
    kind : refuse files of another kind, for example "torque_model".

    Raises
    ------
    ConfigError : when the file is missing, damaged or has unknown fields; one line with the place.
    ModelMismatchError : when it is of another kind, format or sign convention.
    """
    path = Path(path)
    raw = _tables(path)
    meta = raw["meta"]
    if kind is not None and meta.get("kind") != kind:
        raise ModelMismatchError(
            f"Expected a file of kind {kind!r} at {path}, got {meta.get('kind')!r}. Name the right file."
        )
    return read_torque_model(raw, path) if meta.get("kind") == KIND else read_value(raw, path)


def load_statistics(path: str | Path) -> dict[str, Any]:
    """Read the table [fit] of a model file; empty where the value was saved without its fit."""
    fit = _tables(Path(path)).get("fit", {})
    with _readable(f"the tables of a fit in [fit] at {path}", "Make the file again."):
        return {name: decode(part) for name, part in fit.items()}


def _tables(path: Path) -> dict[str, Any]:
    """Read a TOML file that begins with [meta]."""
    try:
        raw = parsed(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"Expected a model file at {path}, got: {error.strerror}. Check the name.") from None
    except (TomlError, UnicodeDecodeError) as error:
        raise ConfigError(f"Expected a TOML model file, got something else in {path}: {error}.") from None
    if not isinstance(raw.get("meta"), dict):
        raise ModelMismatchError(
            f"Expected a model file with kind, format and sign in [meta] at {path}, got none. Identify again."
        )
    return raw

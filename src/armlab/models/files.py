"""Model files: TOML with provenance and full precision, bound to one robot.

A file begins with ``[meta]``: kind, format, armlab version, command line, UTC time, sources with SHA-256 hashes, robot
name and hash, and the sign convention of the wrench. Loading rejects a file with a different kind, format or
sign. Torque models have human-readable tables; other values use the generic format.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

import msgspec
import numpy as np
import tomli_w

import armlab
from armlab._files import TomlError, parsed, whole_file
from armlab.errors import ConfigError, ModelMismatchError, UnknownName
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.torque import SIGN, Quality, TorqueModel, Training
from armlab.models.uncertainty import VelocityCovariance

# Generic format: any registered frozen dataclass of numbers, strings and arrays.
#
#     [meta]   kind, package of its class, format, armlab version, command line, UTC time, sources, robot name and hash
#     [value]  the fields of the value
#     [fit]    statistics of the fit: names, units, covariance, noise, outliers
#
# Numbers have 17 digits and arrays are written row by row, so reading is bit-exact. After a call to `register`, a class
# works with `models.save` and `models.load`.


FORMAT = 1
Value = TypeVar("Value")

_CLASSES: dict[str, type] = {}


def register(kind: str, cls: type) -> None:
    """Register a file format for a frozen dataclass.

    Parameters
    ----------
    kind : name of the format, written into the file; for example "hand_eye".
    cls : class whose fields are numbers, strings, arrays, tuples and dicts of these, None, or other registered values.
        The constructor of the class must accept the field values.
    """
    if not is_dataclass(cls) or _CLASSES.setdefault(kind, cls) is not cls:
        raise ConfigError(f"Expected a dataclass and a unique kind, got {cls.__name__} and {kind!r}.")


def kind_of(value: object) -> str:
    """Return the kind of a registered value or class."""
    own = value if isinstance(value, type) else type(value)
    for kind, cls in _CLASSES.items():
        if own is cls:
            return kind
    raise ConfigError(
        f"Expected a value with a file format, got {own.__name__}. "
        f"Available: {', '.join(sorted(c.__name__ for c in _CLASSES.values())) or 'none'} and TorqueModel."
    )


def provenance(kind: str, value: object) -> dict[str, Any]:
    """Return the table [meta] for a new file."""
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
    """Return the tables [meta] and [value] of a registered value, with the UNITS of its fields if defined."""
    kind = kind_of(value)
    meta, units = provenance(kind, value), _units(value)
    meta["package"] = type(value).__module__.rpartition(".")[0]
    if units:
        meta["units"] = units
    return {"meta": meta, "value": encode(value)["fields"]}


def _units(value: Any, prefix: str = "") -> dict[str, str]:
    """Return the UNITS of a value and, as "part.field", the UNITS of its fields."""
    found = {prefix + name: unit for name, unit in getattr(type(value), "UNITS", {}).items()}
    for field in fields(value):
        part = getattr(value, field.name)
        if type(part) in _CLASSES.values():
            found |= _units(part, f"{prefix}{field.name}.")
    return found


def _check_units(written: Any, known: Mapping[str, str]) -> None:
    """Reject units in a file that differ from the units in which the numbers are read."""
    for name, unit in written.items() if isinstance(written, dict) else ():
        if known.get(name) != unit:
            raise ConfigError(
                f"Expected [meta.units] to give {known.get(name)!r} for {name}, got {unit!r}. Numbers are not "
                "converted, so write them in the expected unit."
            )


def _check_texts(value: Any, path: Path) -> None:
    """Reject a value whose sources or robot name are not strings, because [meta] requires strings."""
    known = provenance("", value)
    texts = [*(("sources", one) for one in known["sources"]), *((k, known[k]) for k in ("robot", "robot_hash"))]
    for name, text in texts:
        if not isinstance(text, str):
            raise ConfigError(f"Expected strings for {name} at {path}, got {text!r}. Save the file again.")


def read_value(raw: Mapping[str, Any], path: Path) -> Any:
    """Return the value described by a file's tables."""
    meta = raw["meta"]
    kind, version, package = str(meta.get("kind")), meta.get("format"), str(meta.get("package", "")) or "the package"
    owner = package.removeprefix("armlab.")
    if kind not in _CLASSES and owner in armlab.__all__:
        getattr(armlab, owner)  # the import registers its kinds
    if kind not in _CLASSES or version != FORMAT:
        raise ModelMismatchError(
            f"Expected a file of format {FORMAT} and a kind among {sorted({*_CLASSES, 'torque_model'})} at {path}, got "
            f"{kind!r} in format {version}. Import {package}, which wrote the file, or save the file again."
        )
    with _readable(f"the fields of a {kind} at {path}", "Save the file again."):
        value = decode({"kind": kind, "fields": raw["value"]})
        _check_units(meta.get("units", {}), _units(value))
        _check_texts(value, path)
        return value


@contextmanager
def _readable(wanted: str, advice: str) -> Iterator[None]:
    """Convert any error about file contents to a one-sentence error."""
    try:
        yield
    except ConfigError:
        raise
    except (msgspec.ValidationError, UnknownName, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"Expected {wanted}, got: {str(error).rstrip('.')}. {advice}") from None


def encode(item: Any) -> Any:
    """Convert a field to numbers, strings, lists and tables for TOML; None becomes an empty table."""
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
    """Decode a field that was encoded by `encode`."""
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
            "Expected a table with array, tuple, table or kind, or an empty table, got a table with "
            f"{sorted(item)[0][:60]!r}. Save the file again."
        )
    return None


# Torque model files: human-readable tables.


KIND = "torque_model"
TORQUE_FORMAT = 6
FRICTION_FIELDS = tuple(entry.name for entry in fields(Friction))
RIPPLE = tuple(entry.name for entry in fields(Ripple))
BOUND = tuple(entry.name for entry in fields(FrictionBound))
PARTS = ("lines", "friction_map", "warm_up", "momentum", "coupled", "parameters")  # optional tables
QUALITY = ("torque_sd", "rms", "rms_cv", "coverage")
LIMITS = ("q_min", "q_max", "qd_peak", "speed_share")  # fields of the training data
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
    "parameters": "covariance in units of the links, rotors and friction",
    "ctau": "(N m)^2, s/rad",
    "bound": "N m, rad/s",
    "limits": "rad, rad/s, s; ranges of the training data",
    "validation": "N m, s",
}


ROBOT = ("frames", "prismatic", "gravity")
DYNAMICS = ("link_parameters", "rotor", "base_values", "gains", "gain_cov", "load_sd")  # array fields
COVARIANCE = ("C0", "Cinf", "shape")


def _strict(name: str, *optional: str, **types: Any) -> type[msgspec.Struct]:
    """Return the type of a table; unknown keys are errors."""
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
    """Return the tables of a torque model file."""
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
        "friction": _by_joint(model.friction, FRICTION_FIELDS),
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
        raise ConfigError(
            f"Expected {error} for every joint in {path}, but it is missing. Identify the model again."
        ) from None


def read_torque_model(raw: dict[str, Any], path: Path) -> TorqueModel:
    """Return the model from the tables of a file."""
    meta = raw["meta"]
    found = tuple(meta.get(key) for key in ("kind", "format", "sign"))
    if found != (KIND, TORQUE_FORMAT, SIGN):
        raise ModelMismatchError(
            f"Expected kind, format and sign {(KIND, TORQUE_FORMAT, SIGN)} in {path}, got {found}. "
            "Repeat the identification with this version of armlab."
        )
    with _readable(f"a complete model file at {path}", "Identify the model again."):
        return _model(msgspec.convert(raw, _ModelFile), path)


def _model(file: Any, path: Path) -> TorqueModel:
    d, c, limits = file.dynamics, file.ctau, file.limits
    p = len(d.base_names)
    if len(d.base_values) != p or len(d.base_cov_lower) != p * (p + 1) // 2:
        raise ConfigError(
            f"Expected {p} base values with covariance in {path}, got other array lengths. Identify the model again."
        )
    cov = np.zeros((p, p))
    cov[np.tril_indices(p)] = d.base_cov_lower
    return TorqueModel(
        robot_name=file.meta.robot,
        robot_hash=file.meta.robot_hash,
        **_arrays(file.robot, ROBOT),
        **_arrays(d, DYNAMICS),
        quasi_static=bool(d.quasi_static),
        friction=Friction(**_joined(file.friction, FRICTION_FIELDS, path)),
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
    """Write a model file atomically and return its path.

    Parameters
    ----------
    value : a `TorqueModel`, an instance of a registered class, or a fit of either, which is saved with its statistics,
        as by `Fit.save`.
    path : file name ending in ``.toml``.
    statistics : statistics of the fit, written to the table [fit].
    sources : names of additional source files, stored with their SHA-256.

    Raises
    ------
    ConfigError : wrong extension, or a value whose class has no file format.
    OSError : the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise ConfigError(f"Expected a model file name that ends in .toml, got {path}. Add the extension.")
    if statistics is None and hasattr(value, "value") and hasattr(value, "save"):  # a Fit (defined in a higher layer)
        return value.save(path, sources)
    content = torque_tables(value) if isinstance(value, TorqueModel) else value_file(value)
    content["meta"]["sources"] = [*content["meta"]["sources"], *sources]
    if statistics is not None:
        content["fit"] = {name: encode(part) for name, part in statistics.items()}
    with whole_file(path) as part:
        part.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


@overload
def load(path: str | Path, kind: type[Value]) -> Value: ...
@overload
def load(path: str | Path, kind: Literal["torque_model"]) -> TorqueModel: ...
@overload
def load(path: str | Path, kind: str | None = None) -> Any: ...
def load(path: str | Path, kind: type[Any] | str | None = None) -> Any:
    """Load the value of a model file: a `TorqueModel`, or any other saved value.

    Parameters
    ----------
    path : file written by `save`.
    kind : expected class of the value, for example ``TorqueModel``, or its name in the file, "torque_model"; files of
        another kind are rejected.

    Raises
    ------
    ConfigError : if the file is missing or corrupted, or has unknown fields; the message states the location in one
    line.
    ModelMismatchError : if the file has a different kind, format or sign convention.
    """
    path = Path(path)
    if isinstance(kind, type):
        kind = KIND if kind is TorqueModel else kind_of(kind)
    raw = _tables(path)
    meta = raw["meta"]
    if kind is not None and meta.get("kind") != kind:
        raise ModelMismatchError(
            f"Expected a file of kind {kind!r} at {path}, got {meta.get('kind')!r}. Pass the correct file."
        )
    return read_torque_model(raw, path) if meta.get("kind") == KIND else read_value(raw, path)


def load_statistics(path: str | Path) -> dict[str, Any]:
    """Load the table [fit] of a model file; empty if the value was saved without a fit."""
    fit = _tables(Path(path)).get("fit", {})
    with _readable(f"the tables of a fit in [fit] at {path}", "Save the file again."):
        return {name: decode(part) for name, part in fit.items()}


def sources_of(path: str | Path) -> tuple[str, ...]:
    """Return the sources named in a model file."""
    return tuple(map(str, _tables(Path(path))["meta"].get("sources", ())))


def _tables(path: Path) -> dict[str, Any]:
    """Read a TOML file that begins with [meta]."""
    try:
        raw = parsed(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"Expected a model file at {path}, got: {error.strerror}. Check the path.") from None
    except (TomlError, UnicodeDecodeError) as error:
        raise ConfigError(f"Expected a TOML model file, got other content in {path}: {error}.") from None
    if not isinstance(raw.get("meta"), dict):
        raise ModelMismatchError(
            f"Expected a model file with kind, format and sign in [meta] at {path}, but [meta] is missing. Identify "
            "again."
        )
    return raw

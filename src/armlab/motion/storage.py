"""Frozen fields, exact equality and TOML files for movement primitives."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from armlab import models
from armlab._display import Shown
from armlab._numbers import numbers
from armlab.errors import ShapeError


@dataclass(frozen=True, eq=False, repr=False)
class Saved(Shown):
    """Frozen dataclass with its own file kind: ``class Dmp(Saved, kind="dmp")``."""

    KIND: ClassVar[str]

    def __init_subclass__(cls, *, kind: str) -> None:
        """Register the file kind of the class."""
        cls.KIND = kind
        models.register(kind, cls)

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are bit-identical."""
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the fields only; compiled kernels are rebuilt, and arrays become read-only again."""
        return type(self), tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def save(self, path: str | Path) -> Path:
        """Write a TOML file that restores every field bit for bit, and return its path.

        Parameters
        ----------
        path : file name with the extension ``.toml``.
        """
        return models.save(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `save`.

        Parameters
        ----------
        path : path of the file.

        Raises
        ------
        ConfigError : a damaged file or unknown fields.
        ModelMismatchError : the file contains a different kind of model.
        """
        return models.load(path, cls.KIND)


def freeze_arrays(value: Any, *names: str) -> None:
    """Replace fields of a frozen dataclass with read-only arrays of finite numbers, in ``__post_init__``."""
    arrays = {name: np.array(numbers(getattr(value, name), name, ShapeError)) for name in names}
    if not np.isfinite(np.concatenate([array.ravel() for array in arrays.values()])).all():
        name = next(name for name in names if not np.isfinite(arrays[name]).all())
        raise ShapeError(
            f"Expected finite {name} in a {type(value).__name__}, got NaN or Inf. Fit the primitive again."
        )
    for name, array in arrays.items():
        array.flags.writeable = False
        object.__setattr__(value, name, array)


def _same(a: Any, b: Any) -> bool:
    return np.array_equal(a, b) if isinstance(a, np.ndarray) and isinstance(b, np.ndarray) else bool(a == b)

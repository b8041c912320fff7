"""Frozen fields, equality to the last bit and a TOML file, for every movement primitive."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from armlab import models
from armlab._numbers import numbers
from armlab.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Saved:
    """A frozen dataclass with a file of its own kind: ``class Dmp(Saved, kind="dmp")``."""

    KIND: ClassVar[str]

    def __init_subclass__(cls, *, kind: str) -> None:
        """Give the class its file format."""
        cls.KIND = kind
        models.register(kind, cls)

    def __eq__(self, other: object) -> bool:
        """Tell whether every field is the same, to the last bit."""
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the fields alone: compiled kernels are made again, arrays are frozen again."""
        return type(self), tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def save(self, path: str | Path) -> Path:
        """Write a TOML file that comes back bit for bit, and return its path.

        Parameters
        ----------
        path : ends in ``.toml``.
        """
        return models.save(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Parameters
        ----------
        path : of the file.

        Raises
        ------
        ConfigError : damaged or with unknown fields. ModelMismatchError : of another kind.
        """
        return models.load(path, cls.KIND)


def freeze_arrays(value: Any, *names: str) -> None:
    """Replace fields of a frozen dataclass by read-only arrays of finite numbers, while it is made."""
    arrays = {name: np.array(numbers(getattr(value, name), name, ShapeError)) for name in names}
    if not np.isfinite(np.concatenate([array.ravel() for array in arrays.values()])).all():
        name = next(name for name in names if not np.isfinite(arrays[name]).all())
        raise ShapeError(f"Expected finite {name} of a {type(value).__name__}, got NaN or Inf. Fit it again.")
    for name, array in arrays.items():
        array.flags.writeable = False
        object.__setattr__(value, name, array)


def _same(a: Any, b: Any) -> bool:
    return np.array_equal(a, b) if isinstance(a, np.ndarray) and isinstance(b, np.ndarray) else bool(a == b)

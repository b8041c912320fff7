"""Arguments of the reference kernels: the checks of `native/arrays.h`, with the same sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from armlab.errors import ConfigError, ShapeError

__all__ = ["check_threads", "elements", "not_negative", "positive", "read", "result", "results", "same_shape"]

MAX_THREADS = 256


def read(value: Any, name: str, tail: tuple[int, ...], exact: bool = False) -> np.ndarray:
    """Return `value` as a float64 array whose shape ends with `tail`.

    Parameters
    ----------
    value : array-like of real numbers.
    name : how error messages call it.
    tail : the last axes that are required.
    exact : refuse leading axes too.

    Raises
    ------
    ShapeError
        When it does not convert or has another shape.
    """
    array = _numbers(value, name)
    leading = array.ndim - len(tail)
    if leading < 0 or (exact and leading) or array.shape[leading:] != tail:
        wanted = str(tail) if exact else f"(..., {', '.join(map(str, tail))})"
        advice = "" if exact else " Put the joints on the last axis, batches before it."
        raise ShapeError(f"Expected {name} of shape {wanted}, got {array.shape}.{advice}")
    return array.astype(np.float64, copy=False)


def elements(value: Any, name: str, tail: tuple[int, ...]) -> np.ndarray:
    """Return `value` as a float64 array of elements of shape `tail`, whatever they are.

    Parameters
    ----------
    value : array-like of real numbers.
    name : how error messages call it.
    tail : the last axes that are required.

    Raises
    ------
    ShapeError
        When it does not convert or has another shape.
    """
    array = _numbers(value, name)
    if array.shape[max(array.ndim - len(tail), 0) :] != tail:
        raise ShapeError(f"Expected {name} of shape ({', '.join(['...', *map(str, tail)])}), got {array.shape}.")
    return np.asarray(array, dtype=np.float64, order="C")


def positive(values: np.ndarray, name: str) -> None:
    """Refuse numbers that are not finite or not above zero.

    Raises
    ------
    ShapeError
        When one is not.
    """
    _refuse(values, np.isfinite(values) & (values > 0), f"{name} above zero")


def not_negative(values: np.ndarray, name: str) -> None:
    """Refuse numbers that are not finite or below zero.

    Raises
    ------
    ShapeError
        When one is.
    """
    _refuse(values, np.isfinite(values) & (values >= 0), f"{name} not below zero")


def same_shape(array: np.ndarray, name: str, other: np.ndarray, other_name: str) -> None:
    """Refuse `array` unless it has the shape of `other`.

    Raises
    ------
    ShapeError
        When the shapes differ.
    """
    if array.shape != other.shape:
        raise ShapeError(
            f"Expected {name} of the same shape as {other_name}, {other.shape}, got {array.shape}. "
            "Broadcast them first with numpy.broadcast_arrays."
        )


def result(
    value: np.ndarray, out: Any, name: str = "out", apart: Mapping[str, Any] | None = None, **samples: Any
) -> np.ndarray:
    """Return `value`, written into `out` when that is given.

    Parameters
    ----------
    name : how error messages call `out`.
    apart : inputs that are no samples, by name. **samples : those that are.

    Raises
    ------
    ShapeError
        When `out` is not a writable C-contiguous float64 array of the shape of `value`, or shares memory with an input,
        which the compiled kernels would overwrite before they have read it.
    """
    if out is None:
        return value
    plain = type(out) is np.ndarray and out.dtype == np.float64 and out.flags.carray
    shared = next((f"one that shares memory with {key}" for key, x in samples.items() if _overlap(out, x)), "")
    if not plain or out.shape != value.shape or shared:
        came = "an object that is not" if not plain else shared if out.shape == value.shape else f"shape {out.shape}"
        raise ShapeError(
            f"Expected {name} to be a writable C-contiguous float64 array of shape {value.shape}, got {came}. "
            "Make it with numpy.empty, or leave it out."
        )
    for key, x in (apart or {}).items():
        if _overlap(out, x):
            raise ShapeError(
                f"Expected {name} to be apart from {key}, got arrays that share memory. Make it with numpy.empty, or "
                "leave it out."
            )
    out[...] = value
    return out


def results(
    values: tuple[np.ndarray, np.ndarray], out: Any, names: str, apart: Mapping[str, Any] | None = None, **samples: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return two `values`, written into the pair `out` when that is given.

    Parameters
    ----------
    names : how the error message calls the two, like ``(T, J)``.
    apart, **samples : inputs, as in `result`.

    Raises
    ------
    ShapeError
        When `out` is not a pair of arrays that `result` accepts, apart from each other.
    """
    if out is None:
        return values
    if not isinstance(out, tuple) or len(out) != 2:
        raise ShapeError(
            f"Expected out to be a pair of arrays {names}, got something else. Give a tuple of two arrays."
        )
    if _overlap(*out):
        raise ShapeError(
            "Expected out[1] and out[0] to be apart, got arrays that share memory. Make each with numpy.empty, or "
            "leave them out."
        )
    first = result(values[0], out[0], "out[0]", apart, **samples)
    return first, result(values[1], out[1], "out[1]", apart, **samples)


def check_threads(threads: Any) -> None:
    """Refuse a number of threads that is not an integer from 1 to 256.

    Raises
    ------
    ConfigError
        When it is not.
    """
    if not isinstance(threads, int | np.integer) or isinstance(threads, bool) or not 1 <= threads <= MAX_THREADS:
        raise ConfigError(f"Expected threads to be an integer from 1 to {MAX_THREADS}, got {threads!r}.")


def _refuse(values: np.ndarray, allowed: np.ndarray, what: str) -> None:
    others = np.flatnonzero(~allowed)
    if len(others):
        raise ShapeError(f"Expected finite {what}, got another at number {others[0]}. Correct it.")


def _overlap(out: Any, x: Any) -> bool:
    """Tell whether two arrays share memory; what is no C-contiguous float64 array is converted, and so apart."""
    plain = all(type(a) is np.ndarray and a.dtype == np.float64 and a.flags.c_contiguous for a in (out, x))
    return plain and np.may_share_memory(out, x)


def _numbers(value: Any, name: str) -> np.ndarray:
    """Return `value` as an array, refusing what does not convert to float64 without loss of kind."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        array = None
    if array is None or not np.can_cast(array.dtype, np.float64, "safe"):
        raise ShapeError(
            f"Expected {name} to be an array of real numbers, got {type(value).__name__} that does not convert to "
            "float64. Give a NumPy array or nested lists of equal length."
        )
    return array

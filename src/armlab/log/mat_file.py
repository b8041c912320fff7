"""Arrays from MATLAB files: v5 to v7.2 by SciPy, v7.3, which is HDF5, by h5py. Arrays come as MATLAB shows them.

HDF5 keeps MATLAB's columns as rows: every array of a v7.3 file is transposed on reading.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import LogError, MissingExtra, UnknownName

__all__ = ["read_mat"]

OFFSETS = (0, 512)  # of the signature of HDF5: MATLAB puts 512 bytes of text before it
SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_mat(path: str | Path, name: str | None = None) -> dict[str, np.ndarray]:
    """Read the real numerical arrays of a ``.mat`` file, by name.

    Text, cells, structs and complex numbers are left out.

    Parameters
    ----------
    path : of the file, v5 to v7.3.
    name : read only this variable.

    Raises
    ------
    LogError : no MAT file, a truncated one, or one without arrays. UnknownName : it has no such array.
    MissingExtra : v7.3 without h5py.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(1024)
    except OSError as error:
        raise LogError(f"Expected a MAT file at {path}, got: {error.strerror}.") from None
    if any(head[a : a + 8] == SIGNATURE for a in OFFSETS):
        found = _hdf5(path)
    elif head.startswith(b"MATLAB 5.0"):
        found = _version_5(path)
    else:
        raise LogError(
            f"Expected a MAT file at {path}, got one that begins with {head[:10]!r}. Save it from MATLAB with save."
        )
    if name is not None and name not in found:
        raise UnknownName.among("variable", name, found)
    if not found:
        raise LogError(f"Expected arrays in {path}, got none. Text, cells and structs are not read.")
    return found if name is None else {name: found[name]}


def _version_5(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a damaged file is told by an error, or reads as another one
            found: dict[str, Any] = loadmat(path)
    except Exception as error:  # SciPy raises what its parser happens to meet in a damaged file
        raise _damaged(path, error) from None
    return {name: array for name, value in found.items() if (array := _real(value)) is not None}


def _hdf5(path: Path) -> dict[str, np.ndarray]:
    try:
        import h5py
    except ImportError:
        raise MissingExtra(
            f"Expected h5py to read {path}, a MAT file of version 7.3, got none. "
            "Install it by `pip install armlab[data]`, or save again with save(..., '-v7')."
        ) from None
    found: dict[str, np.ndarray] = {}
    try:
        with h5py.File(path, "r") as file:
            for name, item in file.items():
                if isinstance(item, h5py.Dataset) and "MATLAB_empty" not in item.attrs:
                    array = _real(item[()])
                    if array is not None and item.attrs.get("MATLAB_class", b"double") != b"char":
                        found[name] = array.T.copy()
    except Exception as error:  # h5py raises OSError, RuntimeError, KeyError and more on damaged files
        raise _damaged(path, error) from None
    return found


def _real(value: Any) -> np.ndarray | None:
    array = value if isinstance(value, np.ndarray) else np.array(None)
    return array.astype(np.float64) if array.dtype.kind in "biuf" else None


def _damaged(path: Path, error: Exception) -> LogError:
    what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return LogError(f"Expected a whole MAT file at {path}, got a damaged or truncated one: {what[:200]}.")

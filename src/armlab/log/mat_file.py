"""Arrays from MATLAB files: v5 to v7.2 by `mat5`, v7.3, which is HDF5, by h5py. Arrays come as MATLAB shows them.

HDF5 keeps MATLAB's columns as rows: every array of a v7.3 file is transposed on reading.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import LogError, UnknownName
from armlab.log.extras import needed
from armlab.log.hdf5_file import stored_size
from armlab.log.mat5 import variables_in
from armlab.log.unpacked_size import check_unpacked_size

__all__ = ["read_mat", "read_variables"]

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
    variables, _ = read_variables(path)
    found = {key: array.astype(np.float64) for key, array in variables.items() if array.dtype.kind != "U"}
    if name is not None and name not in found:
        raise UnknownName.among("variable", name, found)
    if not found:
        raise LogError(f"Expected arrays in {path}, got none. Text, cells and structs are not read.")
    return found if name is None else {name: found[name]}


def read_variables(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the arrays of real numbers and of text in a MAT file by name, and the names of what else it has.

    Parameters
    ----------
    path : of the file, v5 to v7.3. A text is an array (1, 1); of v7.3 no cells of text are read.

    Raises
    ------
    LogError : no MAT file, or a truncated one. MissingExtra : v7.3 without h5py.
    """
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
    return {k: v for k, v in found.items() if v is not None}, [k for k, v in found.items() if v is None]


def _version_5(path: Path) -> dict[str, np.ndarray | None]:
    try:
        found = variables_in(path.read_bytes())
    except (LogError, ValueError, OverflowError) as error:  # sizes that do not fit each other, letters that are none
        raise _damaged(path, error) from None
    return {name: value for name, value in found.items() if name and not name.startswith("__")}


def _hdf5(path: Path) -> dict[str, np.ndarray | None]:
    h5py = needed("h5py", f"to read {path}, a MAT file of version 7.3", "or save again with save(..., '-v7')")
    try:
        with h5py.File(path, "r") as file:
            check_unpacked_size(path, stored_size(h5py, file))
            return {name: _dataset(item, h5py) for name, item in file.items() if not name.startswith("#")}
    except LogError:
        raise
    except Exception as error:  # h5py raises OSError, RuntimeError, KeyError and more on damaged files
        raise _damaged(path, error) from None


def _dataset(item: Any, h5py: Any) -> np.ndarray | None:
    """Return an array of version 7.3 as MATLAB shows it."""
    if not isinstance(item, h5py.Dataset) or "MATLAB_empty" in item.attrs:
        return None
    array = item[()]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        return None
    if item.attrs.get("MATLAB_class", b"double") == b"char":
        codes = array.T.astype("<u2")
        return np.array([[codes.tobytes().decode("utf-16-le")]]) if len(codes) == 1 else None
    return array.T.copy()


def _damaged(path: Path, error: Exception) -> LogError:
    what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return LogError(f"Expected a whole MAT file at {path}, got a damaged or truncated one: {what[:200]}.")

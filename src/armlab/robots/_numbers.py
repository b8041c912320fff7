"""From what a user gives to an array of real numbers, or one sentence."""

from __future__ import annotations

from reprlib import repr as shortened

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ArmlabError, RobotError

__all__ = ["numbers"]


def numbers(value: ArrayLike, what: str, error: type[ArmlabError] = RobotError) -> np.ndarray:
    """Return real numbers as float64, without a copy where they are.

    NumPy itself would read a text of digits, and drop imaginary parts.

    Parameters
    ----------
    value : numbers, of any shape.
    what : their name, for the message.
    error : what to raise.

    Raises
    ------
    ArmlabError : when they are text, complex, None, objects or rows of different length.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different length
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise error(f"Expected {what} to be real numbers, got {shortened(value)}.")
    return array.astype(np.float64, copy=False)

"""Whether samples agree with a fit at all: most of them must."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import NotConverged


def require_most(outliers: np.ndarray, what: str, best: Any) -> None:
    """Refuse a fit that leaves out half of the samples or more: it agrees with some by chance.

    Parameters
    ----------
    outliers : (N,) samples left out. what : "readings", for the message. best : for the error.
    """
    left, total = int(np.count_nonzero(outliers)), len(outliers)
    if 2 * left < total or not left:
        return
    raise NotConverged(
        f"Expected {what} most of which agree with each other, got {left} of {total} samples left out. Check that "
        "sample i of all records is the same moment, units and frames, and noise if it was given.",
        best=best,
        reason="mismatch",
    )

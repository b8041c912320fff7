"""The compiled core: kernels that run per sample or per million samples.

`backend` says which implementation is in use: "native", the C++ extension, or "reference", the same mathematics in
NumPy. The environment variable ``ARMLAB_KERNELS`` chooses one; without it the extension is used when it is there.
Both offer the same names, and a contract test holds one to the other.
"""

from __future__ import annotations

import os
import warnings
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.kernels._reference import Chain, WrenchEstimator, limit_reference, presliding

__all__ = ["Chain", "WrenchEstimator", "backend", "limit_reference", "presliding"]


def _fall_back(reason: str) -> tuple[str, ModuleType]:
    warnings.warn(
        f"armlab runs its NumPy reference kernels, ten to a thousand times slower: {reason}.",
        RuntimeWarning,
        stacklevel=3,
    )
    return "reference", import_module("armlab.kernels._reference")


def _choose() -> tuple[str, ModuleType]:
    wanted = os.environ.get("ARMLAB_KERNELS", "")
    if wanted not in ("", "native", "reference"):
        raise ConfigError(f"Expected ARMLAB_KERNELS to be native or reference, got {wanted!r}. Correct it or unset it.")
    if wanted == "reference":
        return _fall_back("ARMLAB_KERNELS=reference asks for them")
    try:
        return "native", import_module("armlab.kernels._native")
    except ImportError as error:
        if wanted == "native":
            raise
        return _fall_back(f"the extension cannot be imported ({error})")


backend, _module = _choose()
if not TYPE_CHECKING:
    Chain = _module.Chain
    WrenchEstimator = _module.WrenchEstimator
    limit_reference = _module.limit_reference
    presliding = _module.presliding

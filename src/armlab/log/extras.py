"""Packages that not every installation has."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from armlab.errors import MissingExtra

__all__ = ["needed"]


def needed(module: str, purpose: str, otherwise: str = "") -> Any:
    """Return a module of the extra `data`.

    Parameters
    ----------
    module : its name. purpose : what it is needed for. otherwise : what else can be done, from "or".

    Raises
    ------
    MissingExtra : it is not installed; says how to.
    """
    try:
        return import_module(module)
    except ImportError:
        package, rest = module.partition(".")[0], f", {otherwise}" if otherwise else ""
        raise MissingExtra(
            f"Expected {package} {purpose}, got none. Install it: pip install 'armlab[data]'{rest}."
        ) from None

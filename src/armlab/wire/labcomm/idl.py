"""Declarations that come with armlab: the rows of its bridge, and the signals of ABB's ExtCtrl."""

from __future__ import annotations

import pkgutil
from functools import cache

from armlab.errors import UnknownName
from armlab.wire.labcomm.lc import parse_lc
from armlab.wire.labcomm.types import SampleType

__all__ = ["FILES", "samples", "text"]

FILES = ("armlab", "extctrl")
"""Names of the files, without their ending."""


@cache
def text(name: str) -> str:
    """Return a file that comes with armlab, to give to a LabComm compiler for instance.

    Parameters
    ----------
    name : one of `FILES`.

    Raises
    ------
    UnknownName : there is no such file.
    """
    data = pkgutil.get_data("armlab.wire.labcomm", f"idl/{name}.lc") if name in FILES else None
    if data is None:
        raise UnknownName.among("file of LabComm declarations", name, FILES)
    return data.decode()


@cache
def samples(name: str) -> dict[str, SampleType]:
    """Return the samples of a file that comes with armlab, by name.

    Parameters
    ----------
    name : one of `FILES`.

    Raises
    ------
    UnknownName : there is no such file.
    """
    return {one.name: one for one in parse_lc(text(name)) if isinstance(one, SampleType)}

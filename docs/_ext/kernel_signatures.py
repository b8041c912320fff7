"""Sphinx extension: document the compiled kernels from their stub."""

from __future__ import annotations

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

from sphinx.application import Sphinx

from armlab import kernels


def setup(app: Sphinx) -> dict[str, bool]:
    """Replace the extension module by its stub; other modules import from `armlab.kernels`."""
    loader = SourceFileLoader("armlab.kernels._native", str(Path(kernels.__file__).with_name("_native.pyi")))
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    stub = module_from_spec(spec)
    loader.exec_module(stub)
    sys.modules[loader.name] = stub
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""Records made of values by the compiled kernel and by the reference."""

from __future__ import annotations

import gc
import sys
from dataclasses import FrozenInstanceError, dataclass
from importlib.util import find_spec
from typing import Any

import pytest

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native


@dataclass(frozen=True, slots=True)
class Kind:
    a: Any
    b: Any = 2
    c: Any = 3


@pytest.mark.parametrize("backend", [_native, _reference])
def test_a_record_is_as_if_made_by_its_class(backend: Any) -> None:
    maker = backend.RecordMaker(Kind, ("c", "a", "b"))
    text = "".join(["te", "xt"])
    before = sys.getrefcount(text)
    made = maker.make((text, None, [1]))
    assert made == Kind(None, [1], "text")
    assert type(made) is Kind
    assert sys.getrefcount(text) == before + 1
    assert gc.is_tracked(made)
    with pytest.raises(FrozenInstanceError):
        made.a = 1
    del made
    assert sys.getrefcount(text) == before
    assert not hasattr(backend.RecordMaker(Kind, ("a",)).make((1,)), "b")


@pytest.mark.parametrize("backend", [_native, _reference])
def test_what_does_not_fit_is_refused(backend: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected slots of the class, got d\.$"):
        backend.RecordMaker(Kind, ("a", "d"))
    with pytest.raises(ShapeError, match=r"^Expected one value for each of 1 slots, got 2\.$"):
        backend.RecordMaker(Kind, ("a",)).make((1, 2))

"""What was given to options: above zero and finite, or a sentence that names the option."""

from __future__ import annotations

import math

import pytest

from armlab.cli.support.options import as_given, require_positive
from armlab.errors import ConfigError, LogError, ShapeError


def test_what_was_not_given_or_is_positive_passes() -> None:
    for value in (None, 1e-300, 1, 1e300):
        require_positive("noise", value)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, -math.inf])
def test_others_are_named(value: float) -> None:
    with pytest.raises(ConfigError, match=rf"^Expected --seconds above 0 s and finite, got {value:g}\.$"):
        require_positive("seconds", value, "s")


def test_what_the_library_refuses_of_the_words_is_wrong_use() -> None:
    with pytest.raises(ConfigError, match=r"^Expected a goal\.$"), as_given():
        raise ShapeError("Expected a goal.")
    with pytest.raises(LogError), as_given():
        raise LogError("Expected a log.")

"""One line of the doctor."""

from __future__ import annotations

from typing import get_args

from armlab.bridge.doctor.findings import Finding, Verdict


def test_advice_belongs_to_what_is_wrong() -> None:
    assert Finding.judged("a", "failure", True, "v", "do") == Finding("a", "failure", "v", "do")
    assert Finding.judged("a", "failure", False, "v", "do") == Finding("a", "ok", "v", "")
    assert get_args(Verdict) == ("ok", "warning", "failure")

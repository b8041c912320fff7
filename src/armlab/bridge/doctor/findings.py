"""`Finding`: one line of `armlab doctor`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Finding", "Verdict"]

Verdict = Literal["ok", "warning", "failure"]
"""How good a finding is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found.

    Attributes
    ----------
    name : of the check. verdict : "ok", "warning" (it works, with a risk) or "failure".
    value : what was found, in words. advice : what to do, "" when nothing is.
    """

    name: str
    verdict: Verdict
    value: str
    advice: str = ""

    @classmethod
    def judged(cls, name: str, problem: Verdict, is_bad: bool, value: str, advice: str) -> Finding:
        """Return a finding that is `problem` with its advice when it is bad, else "ok" without.

        Parameters
        ----------
        name, value : see `Finding`. problem : verdict when bad. is_bad : the outcome. advice : what to do when bad.
        """
        return cls(name, problem, value, advice) if is_bad else cls(name, "ok", value)

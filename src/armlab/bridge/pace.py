"""`Pace`: which rows a reader gets that wants so many a second."""

from __future__ import annotations

from collections.abc import Hashable, Iterable

__all__ = ["Pace"]


class Pace:
    """Takes a row when one of the arms that it is fresh for is due, so that no arm keeps another from its rows.

    Parameters
    ----------
    every : s between two rows of an arm; 0 takes all.
    """

    def __init__(self, every: float) -> None:
        self._every = every
        self._due: dict[Hashable, float] = {}

    def takes(self, arms: Iterable[Hashable], now: float) -> bool:
        """Return whether a row is taken.

        Parameters
        ----------
        arms : for which it is fresh. now : s, of a clock that never goes back.
        """
        due = [arm for arm in arms if now >= self._due.get(arm, now)]
        for arm in due:
            self._due[arm] = max(self._due.get(arm, now) + self._every, now)
        return bool(due)

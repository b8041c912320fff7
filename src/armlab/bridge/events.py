"""How the parts of a run tell what a user should know: `Tell`, and `nobody`, who does not listen."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Tell", "nobody"]


class Tell(Protocol):
    """Takes sentences."""

    def __call__(self, text: str, warn: bool = False) -> None:
        """Take one sentence; `warn` when something is wrong."""
        ...


def nobody(text: str, warn: bool = False) -> None:
    """Ignore a sentence.

    Parameters
    ----------
    text : the sentence. warn : something is wrong.
    """

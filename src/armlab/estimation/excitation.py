"""What the data can tell: rank, condition and the weakest directions in words.

The test is on the column-scaled, whitened design matrix A (each column divided by its norm): its singular values are
free of units, and its condition number c says how many digits of the answer the noise of the data can eat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import NotExcited

__all__ = ["Excitation", "check_excitation"]

MAX_CONDITION = 1e4  # beyond it a direction is called not excited
WARN_CONDITION = 300.0


@dataclass(frozen=True, eq=False)
class Excitation:
    """What the data could tell.

    Attributes
    ----------
    rank, expected : rank found and rank needed.
    singular_values : of the column-scaled, whitened design matrix, descending.
    weakest : the least excited direction in words.
    """

    rank: int
    expected: int
    singular_values: np.ndarray
    weakest: str

    @classmethod
    def of(cls, gram: np.ndarray, names: Sequence[str]) -> Excitation:
        """Measure the excitation behind a normal matrix of full column norms, without judging it.

        Parameters
        ----------
        gram : (d, d) whitened normal matrix A^T A, diagonal positive.
        names : of the d parameters.
        """
        singular, vectors = _spectrum(gram)
        rank = int(np.count_nonzero(singular * MAX_CONDITION >= singular[0]))
        return cls(rank, len(names), singular, _in_words(vectors[:, -1], names))

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        smallest = self.singular_values[-1]
        return float(self.singular_values[0] / smallest) if smallest > 0 else float("inf")

    def text(self) -> str:
        """Return one line for a report."""
        verdict = "good" if self.condition < WARN_CONDITION else "weak: log a longer or richer motion"
        found = f"rank {self.rank} of {self.expected}, condition {self.condition:.0f}"
        return f"excitation {verdict}: {found}; weakest: {self.weakest}"


def check_excitation(gram: np.ndarray, names: Sequence[str], what: str) -> Excitation:
    """Judge whether data determine all parameters.

    Parameters
    ----------
    gram : (d, d) whitened normal matrix A^T A.
    names : of the d parameters.
    what : what is fitted, for the message.

    Returns
    -------
    Excitation with the singular values of the column-scaled A.

    Raises
    ------
    NotExcited : when the condition number exceeds 1e4, with every direction beyond it by the names of its parameters.
    """
    norms = np.sqrt(np.diag(gram))
    dead = [name for name, norm in zip(names, norms) if not norm > 0]
    if dead:
        raise NotExcited(
            f"Expected motion that excites every parameter of the {what}, got none at all for: {', '.join(dead)}. "
            "Record a log in which these joints move.",
            dead,
            ["no signal"] * len(dead),
        )
    found = Excitation.of(gram, names)
    if found.rank < found.expected:
        singular, vectors = _spectrum(gram)
        weak = range(found.expected - 1, found.rank - 1, -1)  # the weakest first
        directions = [_in_words(vectors[:, i], names) for i in weak]
        raise NotExcited(
            f"Expected motion that excites every direction of the {what} (condition below {MAX_CONDITION:.0e}), got "
            f"{len(directions)} that it does not tell apart: {'; '.join(directions)}. "
            "Record a log that moves these joints together and apart, at several speeds and poses.",
            directions,
            [f"{singular[i] / singular[0]:.1e} of the strongest direction" for i in weak],
        )
    return found


def _spectrum(gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return singular values of the column-scaled A, descending, and their directions as columns."""
    norms = np.sqrt(np.diag(gram))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(norms, norms))
    return np.sqrt(np.maximum(eigenvalues, 0.0))[::-1], vectors[:, ::-1]


def _in_words(vector: np.ndarray, names: Sequence[str]) -> str:
    """Name the parameters that carry most of a direction."""
    order = np.argsort(-np.abs(vector))[:3]
    kept = [i for i in order if abs(vector[i]) > 0.3 * abs(vector[order[0]])]
    return " and ".join(str(names[int(i)]) for i in kept)

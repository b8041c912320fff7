"""What the data can tell: rank, condition and the weakest directions in words.

The test is on the column-scaled, whitened design matrix A (each column divided by its norm): its singular values are
free of units, and its condition number c says how many digits of the answer the noise of the data can eat. They are
those of the triangle R of ``A = Q R``; the normal matrix, which squares c, is never formed.

Where the unknowns have a natural limit (0.2 rad, 50 mm, 30 % of a mass) the question is another one: does the standard
deviation along some direction exceed it? `check_spread` scales the columns by the limits, so that a singular value
below 1 says yes; a rank test alone fails as soon as the data are noisy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from armlab._numbers import numbers, still
from armlab.errors import NotExcited, ShapeError
from armlab.estimation.tsqr import triangle

MAX_CONDITION = 1e4  # beyond it a direction is called not excited
WARN_CONDITION = 300.0
NULL = 1e-9  # relative singular value below which a direction is not weak but unseen
NAMED = 0.3  # share of the largest component above which a component is named

Describe = Callable[[np.ndarray], str]


@dataclass(frozen=True, eq=False)
class Prior:
    """Independent prior knowledge of parameters.

    Attributes
    ----------
    values : array, shape (p,), units of the parameters
        Prior values.
    sd : array, shape (p,), units of the parameters
        Standard deviations of the prior values.
    """

    values: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False)
class Excitation:
    """What the data could tell.

    Attributes
    ----------
    rank, expected : rank found and rank needed.
    singular_values : of the column-scaled, whitened design matrix, descending.
    weakest : the least excited direction in words.
    scale : (p,) norms of the columns; 1 where a column is zero.
    vectors : (p, p) right singular vectors of the scaled matrix as columns, strongest first.
    held : directions that the data do not tell and a prior holds, in words.
    null_space : (p, m) orthonormal directions, in units of the limits, that the data do not see.
    null_names : of them, in words; those that no data could tell begin with "gauge: ".
    spread : (p,) standard deviations, in units of the limits, along the directions `vectors`; empty where there are no
        limits.
    """

    rank: int
    expected: int
    singular_values: np.ndarray
    weakest: str
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    vectors: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    held: tuple[str, ...] = ()
    null_space: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    null_names: tuple[str, ...] = ()
    spread: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)

    def __post_init__(self) -> None:
        for name in ("singular_values", "scale", "vectors", "null_space", "spread"):
            values = still(getattr(self, name), f"{name} of an excitation")
            object.__setattr__(self, name, values)

    @classmethod
    def of(cls, A: np.ndarray, names: Sequence[str], max_condition: float = MAX_CONDITION) -> Excitation:
        """Measure the excitation of a design matrix without judging it.

        Parameters
        ----------
        A : (m, p) whitened design matrix, or its triangle R (p, p).
        names : of the p parameters.
        max_condition : a direction weaker than the strongest by more than this does not count in the rank.
        """
        A = numbers(A, "a design matrix", ShapeError)
        if A.ndim != 2 or A.shape[1] != len(names) or not np.isfinite(A).all():
            raise ShapeError(
                f"Expected a finite design matrix with {len(names)} columns, got shape {A.shape}. Name every column."
            )
        norms = np.linalg.norm(A, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        scaled = A / scale
        if len(A) > A.shape[1]:
            scaled = np.linalg.qr(scaled, mode="r")
        _, found, rows = np.linalg.svd(scaled, full_matrices=True)
        singular = np.zeros(len(names))
        singular[: len(found)] = found
        rank = int(np.count_nonzero((singular >= singular[0] / max_condition) & (singular > 0)))
        return cls(rank, len(names), singular, _in_words(rows[-1], names), scale, rows.T)

    @classmethod
    def of_covariance(cls, cov: np.ndarray, names: Sequence[str]) -> Excitation:
        """Measure the excitation behind an estimate that comes with its covariance and no design matrix.

        Parameters
        ----------
        cov : (p, p) of full rank. names : of the p parameters; there may be none.
        """
        cov = numbers(cov, "a covariance", ShapeError)
        if cov.shape != (len(names), len(names)):
            raise ShapeError(f"Expected a covariance of {len(names)} parameters, got shape {cov.shape}.")
        if not len(names):
            return cls(0, 0, np.zeros(0), "nothing was fitted")
        sd = np.sqrt(np.diag(cov))
        return cls.of(np.linalg.inv(np.linalg.cholesky(cov / np.outer(sd, sd))) / sd, names)

    @property
    def condition(self) -> float:
        """Largest over smallest singular value; 1 where there are no parameters."""
        if not self.singular_values.size:
            return 1.0
        smallest = self.singular_values[-1]
        return float(self.singular_values[0] / smallest) if smallest > 0 else float("inf")

    def text(self) -> str:
        """Return one line for a report, and one for each direction that a prior holds."""
        good = self.spread.max() < 1.0 if self.spread.size else self.condition < WARN_CONDITION
        verdict = "good" if good else "weak: log a longer or richer motion"
        found = f"rank {self.rank} of {self.expected}, condition {self.condition:.0f}"
        lines = [f"excitation {verdict}: {found}; weakest: {self.weakest}"]
        lines += [f"not seen: {direction}" for direction in self.null_names]
        return "\n".join([*lines, *(f"held by the prior: {direction}" for direction in self.held)])


def check_excitation(
    A: np.ndarray, names: Sequence[str], what: str, prior: Prior | None = None, max_condition: float = MAX_CONDITION
) -> Excitation:
    """Judge whether data determine all parameters.

    `A`: (m, p) whitened design matrix, or its triangle R (p, p). `prior`: when given, directions that the data do not
    tell keep its values, and are listed in `held`; without one they are refused. `max_condition`: strongest over
    weakest singular value of the column-scaled A that is accepted. Returns: Excitation with the singular values of the
    column-scaled A.
    """
    A = numbers(A, "a design matrix", ShapeError)
    found = Excitation.of(A, names, max_condition)
    weak = range(found.expected - 1, found.rank - 1, -1)  # the weakest first
    directions = tuple(_in_words(found.vectors[:, i], names) for i in weak)
    if prior is not None:
        _check_prior(prior, len(names))
        known = (found.scale, found.vectors, directions)
        return Excitation(found.rank, found.expected, found.singular_values, found.weakest, *known)
    dead = [name for name, column in zip(names, A.T) if not column.any()]
    if dead:
        raise NotExcited(
            f"Expected motion that excites every parameter of the {what}, got none at all for: {', '.join(dead)}. "
            "Record a log in which these joints move.",
            dead,
            ["no signal"] * len(dead),
        )
    if directions:
        strongest = found.singular_values[0]
        raise NotExcited(
            f"Expected motion that excites every direction of the {what} (condition below {max_condition:.0e}), got "
            f"{len(directions)} that it does not tell apart: {'; '.join(directions)}. "
            "Record a log that moves these joints together and apart, at several speeds and poses.",
            directions,
            [f"{found.singular_values[i] / strongest:.1e} of the strongest direction" for i in weak],
        )
    return found


def check_spread(
    J: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    limits: np.ndarray,
    what: str,
    gauge: np.ndarray | None = None,
    describe: Describe | None = None,
    hold: bool = False,
) -> Excitation:
    """Judge whether data determine every direction better than a limit.

    The standard deviation along the direction v (in units of the limits) is ``1 / |J diag(limits) v|``.

    `J`: (m, p) whitened Jacobian of the data without priors, or its triangle. `limits`: (p,) standard deviation of each
    parameter that is the most accepted. `gauge`: (p, g) directions, in units of the limits, that no data of this kind
    tell; they are not judged. `describe`: puts a direction (p,) of the parameters into words: one standard deviation
    long, or as long as the limits where nothing is seen. The names of the largest components otherwise. `hold`: list
    what exceeds its limit in `held`, because a prior holds it, and do not refuse it.
    """
    p, J, limits = len(names), numbers(J, "a Jacobian", ShapeError), numbers(limits, "limits", ShapeError)
    if J.ndim != 2 or J.shape[1] != p or limits.shape != (p,) or not np.all(limits > 0) or not np.isfinite(J).all():
        raise ShapeError(
            f"Expected a finite Jacobian (m, {p}) and {p} limits above zero, got shapes {J.shape} and {limits.shape}."
            " Give one name, unit and limit per parameter."
        )
    scaled = (triangle(J) if len(J) > p else J) * limits
    fixed, rest = np.zeros((p, 0)), None
    if gauge is not None:
        fixed = np.linalg.qr(gauge)[0]
        rest = np.linalg.svd(np.eye(p) - fixed @ fixed.T)[0][:, : p - fixed.shape[1]]
    _, found, rows = np.linalg.svd(scaled if rest is None else scaled @ rest, full_matrices=True)
    singular = np.zeros(p - fixed.shape[1])
    singular[: len(found)] = found
    vectors = rows.T if rest is None else rest @ rows.T
    unseen = singular <= NULL * singular.max(initial=0.0)
    spread = np.divide(1.0, singular, out=np.full_like(singular, np.inf), where=~unseen)

    def words(i: int) -> str:
        reach = limits * vectors[:, i] * (1.0 if unseen[i] else spread[i])
        if describe is not None:
            return describe(reach)
        k = int(np.argmax(np.abs(vectors[:, i])))
        return _in_words(vectors[:, i], names) + ("" if unseen[i] else f" ({abs(reach[k]):.2g} {units[k]})")

    missing = np.flatnonzero(unseen)
    null = np.hstack([fixed, vectors[:, missing]])
    null_names = [f"gauge: {_in_words(v, names)}" for v in fixed.T] + [words(int(i)) for i in missing]
    weak = [words(int(i)) for i in np.flatnonzero(spread > 1.0)[::-1]]
    if weak and not hold:
        raise NotExcited(
            f"Expected data that determine every direction of the {what}, got {len(weak)} whose standard deviation "
            f"exceeds its limit: {'; '.join(weak)}. Measure at poses that differ more along these directions.",
            weak,
            ["unseen" if not np.isfinite(s) else f"{s:.2g} times the limit" for s in spread[spread > 1.0][::-1]],
        )
    rank = int(np.count_nonzero(~unseen))
    weakest = words(len(singular) - 1) if len(singular) else "none"
    known = (1.0 / limits, vectors, tuple(weak), null, tuple(null_names), spread)
    return Excitation(rank, p - fixed.shape[1], singular, weakest, *known)


def _check_prior(prior: Prior, size: int) -> None:
    values, sd = np.asarray(prior.values), np.asarray(prior.sd)
    if values.shape != (size,) or sd.shape != (size,) or not np.isfinite(values).all() or not np.all(sd > 0):
        raise ShapeError(
            f"Expected a prior of {size} finite values with positive deviations, got shapes {values.shape} and "
            f"{sd.shape}. Give one of each for every parameter."
        )


def _in_words(vector: np.ndarray, names: Sequence[str]) -> str:
    """Name the parameters that carry most of a direction."""
    order = np.argsort(-np.abs(vector))[:3]
    kept = [i for i in order if abs(vector[i]) > NAMED * abs(vector[order[0]])]
    return " and ".join(str(names[int(i)]) for i in kept)

"""What measurements of an arm cannot see, by name: gauge, what a kind of measurement never sees, what was not moved.

Directions are in units of the limits. Three sorts of them are not seen. Gauge: what can go from one frame to the next.
Missing by nature: a tool point says nothing of the tool's orientation, a distance nothing of where the base stands.
Missing by the data: a joint that did not move, a tool point on the last axis, an unknown scale; these are refused, and
so is every direction that the data tell worse than the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import NotExcited
from armlab.estimation import Excitation

NULL = 1e-9  # relative singular value below which nothing is seen
SEEN = 1e-8  # the same of a direction that is given, whose digits are rounded
SAME = 0.9  # cosine above which a direction is the one that has a name
PART = 0.3  # share of the largest component above which a component is named
UNSEEN = np.inf


@dataclass(frozen=True, eq=False)
class Suspect:
    """Directions (d, k) that may be unseen, what they are called, and what to do then."""

    name: str
    directions: np.ndarray
    advice: str = ""


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is judged.

    Attributes
    ----------
    names, units : of the d unknowns. limits : (d,) the largest deviation that is accepted.
    gauge : (d, g) directions that nothing sees, with their names. nature : what this kind of data may never see.
    suspects : returns what data may fail to see; asked where something is weak.
    what : is fitted.
    """

    names: Sequence[str]
    units: Sequence[str]
    limits: np.ndarray
    gauge: np.ndarray
    gauge_names: Sequence[str]
    nature: Sequence[Suspect]
    suspects: Callable[[], Sequence[Suspect]]
    what: str

    def excitation(self, J: np.ndarray, hold: bool) -> Excitation:
        """Judge the whitened Jacobian (m, d) of the data.

        Raises
        ------
        NotExcited : a direction that is missing by the data, unless a prior holds it.
        """
        A = np.asarray(np.linalg.qr(J, mode="r")) * self.limits if len(J) > J.shape[1] else J * self.limits
        fixed, names = _independent(self.gauge / self.limits[:, None]), [f"gauge: {name}" for name in self.gauge_names]
        largest = float(np.linalg.norm(A))
        for suspect in self.nature if self._may_be_dark(A, fixed, largest) else ():
            for v in (suspect.directions / self.limits[:, None]).T:
                v = v - fixed @ (fixed.T @ v)
                length = np.linalg.norm(v)
                if length > SEEN and np.linalg.norm(A @ v) <= SEEN * largest * length:
                    v = v / length
                    fixed = np.column_stack([fixed, v - fixed @ (fixed.T @ v)])
                    names.append(f"missing: {suspect.name}")
        whole = np.linalg.svd(fixed, full_matrices=True)[0] if fixed.shape[1] else np.eye(len(self.limits))
        rest = whole[:, fixed.shape[1] :]
        _, found, rows = np.linalg.svd(A @ rest, full_matrices=len(A) < rest.shape[1])
        singular = np.zeros(rest.shape[1])
        singular[: len(found)] = found
        vectors, unseen = rest @ rows.T, singular <= NULL * max(largest, np.finfo(float).tiny)
        spread = np.divide(1.0, singular, out=np.full_like(singular, UNSEEN), where=~unseen)
        weak = _Named.of(vectors[:, spread > 1.0], spread[spread > 1.0], self, fixed)
        if weak.words and not hold:
            raise NotExcited(weak.sentence(self.what), weak.words, weak.spreads)
        missing = _Named.of(vectors[:, unseen], spread[unseen], self, fixed)
        return Excitation(
            rank=int(np.count_nonzero(~unseen)),
            expected=len(singular),
            singular_values=singular,
            weakest=self.words(vectors[:, -1], spread[-1]) if len(singular) else "none",
            scale=1.0 / self.limits,
            vectors=vectors,
            held=tuple(weak.words),
            null_space=np.column_stack([fixed, missing.vectors]),
            null_names=(*names, *(f"missing: {name}" for name in missing.each)),
            spread=spread,
        )

    def _may_be_dark(self, A: np.ndarray, fixed: np.ndarray, largest: float) -> bool:
        """Tell whether any direction of `nature` is unseen: all at once, as few ever are."""
        if not self.nature:
            return False
        V = np.concatenate([suspect.directions for suspect in self.nature], axis=1) / self.limits[:, None]
        V = V - fixed @ (fixed.T @ V)
        lengths, seen = np.linalg.norm(V, axis=0), np.linalg.norm(A @ V, axis=0)
        return bool(np.any((lengths > SEEN) & (seen <= SEEN * largest * lengths)))

    def words(self, v: np.ndarray, spread: float) -> str:
        """Name a direction by its largest components, with their deviation."""
        order = [int(i) for i in np.argsort(-np.abs(v))[:3]]
        kept = [i for i in order if abs(v[i]) > PART * abs(v[order[0]])]
        text, i = " and ".join(self.names[i] for i in kept), order[0]
        if not np.isfinite(spread):
            return text
        return f"{text} ({self.names[i]} to {abs(v[i]) * spread * self.limits[i]:.2g} {self.units[i]})"


def spread_covariance(vectors: np.ndarray, spread: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the covariance of what was seen, from orthonormal directions and deviations in units of the limits."""
    seen = np.isfinite(spread)
    reach = limits[:, None] * vectors[:, seen] * spread[seen]
    return reach @ reach.T


@dataclass(frozen=True, eq=False)
class _Named:
    """Weak directions with their names: `words` once for each cause, `each` and `vectors` (d, w) for each direction."""

    words: list[str]
    spreads: list[str]
    advice: list[str]
    each: list[str]
    vectors: np.ndarray

    @classmethod
    def of(cls, W: np.ndarray, spread: np.ndarray, judgement: Judgement, fixed: np.ndarray) -> _Named:
        words, spreads, advice, each = [], [], [], []
        if not W.shape[1]:
            return cls(words, spreads, advice, each, W)
        parts, left, worst = [], W, float(np.max(spread))
        for suspect in judgement.suspects():
            D = suspect.directions / judgement.limits[:, None]
            known = np.column_stack([fixed, *parts])
            Q = _independent(D - known @ (known.T @ D))
            if not Q.shape[1] or not left.shape[1]:
                continue
            _, cosine, turn = np.linalg.svd(Q.T @ left, full_matrices=True)
            k = int(np.count_nonzero(cosine > SAME))
            if k:
                parts.append(left @ turn[:k].T)
                left = left @ turn[k:].T
                words.append(suspect.name)
                spreads.append(_spread_text(worst))
                advice.append(suspect.advice)
                each += [suspect.name] * k
        for v in left.T:
            near = spread[np.argmax(np.abs(W.T @ v))]
            words.append(judgement.words(v, near))
            spreads.append(_spread_text(near))
            each.append(words[-1])
        return cls(words, spreads, advice, each, np.column_stack([*parts, left]))

    def sentence(self, what: str) -> str:
        todo = " ".join(dict.fromkeys(text for text in self.advice if text))
        return (
            f"Expected measurements that tell every direction of the {what}, got {len(self.words)} that they do not, "
            f"or worse than the limit: {'; '.join(self.words)}. "
            f"{todo or 'Measure at more and more different positions of all joints.'} "
            "With weak='prior' the fit goes on and holds them near their nominal values."
        )


def _spread_text(spread: float) -> str:
    return f"{spread:.2g} times the limit" if np.isfinite(spread) else "unseen"


def _independent(D: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the columns, in their order where they are independent."""
    if not D.shape[1]:
        return D
    lengths = np.linalg.norm(D, axis=0)
    Q, R = np.linalg.qr(D / np.where(lengths > 0, lengths, 1.0))
    kept = np.abs(np.diag(R)) > SEEN
    if kept.all():
        return Q
    U, singular, _ = np.linalg.svd(D / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
    return U[:, singular > SEEN]

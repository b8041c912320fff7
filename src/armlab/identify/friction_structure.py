"""Friction structure: terms and nonlinear parameters of each joint, selected on held-out blocks.

    F_f = viscous qd + coulomb s + offset [+ asymmetry |s|] [+ stribeck s exp(-(qd / v_s)^2)] [+ root s sqrt(|qd|)]
          [+ load s |x|]

s is the presliding state z with presliding distance delta, or tanh(qd / v_t); x is the torque transmitted to the links.
Terms in brackets are included only if selected; asymmetry is reported as two Coulomb torques, one per direction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import pairwise, product

import numpy as np

from armlab.estimation.tsqr import one_thread
from armlab.identify.record import Decimation
from armlab.kernels import presliding
from armlab.models.friction import FRICTION_TERMS

# Linear columns, computed in `RegressionColumns.plain`; the last two only with known gears.
FIXED = ("viscous", "offset", "ripple cos", "ripple sin")
SIGNED = ("coulomb+", "coulomb-", "root", "load")  # sign and load columns, without nonlinear parameters
SHAPED = (*SIGNED, "stribeck")


@dataclass(frozen=True, eq=False)
class FrictionColumns:
    """Friction regressor columns of J joints, computed from the joint motion.

    `decimation`: decimation filter of the record, which keeps M rows. `q`, `qd`: (N, J) positions and velocities.
    `resolution`: (J,) half the smallest encoder step [rad]. `load`: (N, J) torque |x| transmitted to the links.
    """

    decimation: Decimation
    q: np.ndarray
    qd: np.ndarray
    resolution: np.ndarray
    load: np.ndarray

    def of(self, i: int) -> FrictionColumns:
        one = slice(i, i + 1)
        q, qd = np.ascontiguousarray(self.q[:, one]), np.ascontiguousarray(self.qd[:, one])
        return FrictionColumns(self.decimation, q, qd, self.resolution[one], self.load[:, one])

    def sign(self, delta: np.ndarray, smooth: np.ndarray) -> np.ndarray:
        """Return the friction sign s (N, J) along the record for `delta`, `smooth` (J,) as in `FrictionStructure`."""
        soft = smooth > 0
        z = np.empty(self.q.shape)
        if not soft.all():
            for a, b in self.decimation.segments:
                z[a:b] = presliding(np.ascontiguousarray(self.q[a:b]), delta, self.resolution)
        for i in np.flatnonzero(soft):
            z[:, i] = np.tanh(self.qd[:, i] / smooth[i])
        return z

    def columns(self, s: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the columns (M, J, 4 + S) for a friction sign s (N, J): the SIGNED columns, then the Stribeck columns
        at S speeds (S, J)."""
        made_of = [FRICTION_TERMS[name].column for name in SIGNED]

        def made(a: int, b: int) -> np.ndarray:
            own = [column(self.qd[a:b], s[a:b]) for column in made_of if column]
            load = SIGNED.index("load")
            own[load] = own[load] * self.load[a:b]
            bells = (np.exp(-((self.qd[a:b] / speed) ** 2)) for speed in speeds)
            return np.concatenate([*own, *(s[a:b] * bell for bell in bells)], axis=1)

        J, count = self.q.shape[1], len(made_of) + len(speeds)
        return np.moveaxis(self.decimation.run(made, J * count).reshape(-1, count, J), 1, 2)


DELTAS = np.geomspace(1e-4, 1e-2, 7)  # rad, candidate presliding distances
SMOOTH_SPEEDS = np.array([0.005, 0.01, 0.02, 0.05, 0.1])  # rad/s, candidate v_t of the smooth sign
STRIBECK_SPEEDS = np.array([0.02, 0.05, 0.1, 0.3])  # rad/s, candidate v_s of the Stribeck term
REFINEMENTS = (1.5, 1.25, 1.12, 1.06, 1.03, 1.015)  # factors tried in both directions after the grid
FEWER = REFINEMENTS[::2]  # fewer factors after the selection of terms, because Gauss-Newton steps follow
FOLDS = 4
GAIN = 0.01  # minimum relative reduction of the squared held-out error for keeping a term
DEFAULT_SPEED = 2  # index in STRIBECK_SPEEDS for joints without a Stribeck term
IDENTIFIED = 1e-6  # smallest eigenvalue of each fold's scaled Gram matrix: no term may depend on a single event
EXACT = 1e-12  # squared error, relative to the torque, below which it counts as rounding error
# All columns of a joint, in order: terms of FRICTION_TERMS, then ripple with known gears.
FRICTION = ("viscous", "coulomb+", "coulomb-", "offset", "stribeck", "root", "load")
COLUMNS = (*FRICTION, "ripple cos", "ripple sin")
# Combinations of asymmetry, Stribeck, root and load, fewest terms first.
TERMS = np.array(sorted(product([False, True], repeat=4), key=lambda terms: (sum(terms), [not x for x in terms])))


@dataclass(frozen=True, eq=False)
class FrictionStructure:
    """Friction structure of all joints; vectors have shape (n,).

    `delta`: presliding distance [rad]. `smooth`: v_t [rad/s], or 0 if s is the presliding state. `speed`: v_s of
    the Stribeck term [rad/s]. `terms`: (n, 4) bool: asymmetry, Stribeck, root, load.
    """

    delta: np.ndarray
    smooth: np.ndarray
    speed: np.ndarray
    terms: np.ndarray

    @classmethod
    def start(cls, n: int) -> FrictionStructure:
        """Return a structure with a presliding distance of 1e-3 rad and all terms but root and load, for n joints."""
        return cls(np.full(n, 1e-3), np.zeros(n), np.full(n, 0.1), np.tile([True, True, False, False], (n, 1)))

    @classmethod
    def joined(cls, parts: Iterable[FrictionStructure]) -> FrictionStructure:
        """Combine the structures of several joints in order."""
        listed = list(parts)
        return cls(*(np.concatenate([getattr(part, field.name) for part in listed]) for field in fields(cls)))

    def of(self, i: int) -> FrictionStructure:
        return FrictionStructure(*(getattr(self, field.name)[i : i + 1] for field in fields(self)))

    @property
    def numbers(self) -> np.ndarray:
        """Nonlinear parameters (n, 2): delta or v_t, depending on the type of sign, and v_s."""
        return np.stack([np.where(self.smooth > 0, self.smooth, self.delta), self.speed], axis=1)

    @property
    def names(self) -> list[tuple[str, str]]:
        """Names of the parameters in `numbers`, for each joint."""
        return [("tanh-speed" if soft else "delta", "stribeck-speed") for soft in self.smooth > 0]

    def moved(self, steps: np.ndarray) -> FrictionStructure:
        """Return the structure with `numbers` times exp(steps) (n, 2), within the search range."""
        (sign, bump), soft = np.exp(steps).T, self.smooth > 0
        return replace(
            self,
            delta=np.where(soft, self.delta, np.clip(sign * self.delta, 0.1 * DELTAS[0], DELTAS[-1])),
            smooth=np.where(soft, np.clip(sign * self.smooth, 0.1 * SMOOTH_SPEEDS[0], SMOOTH_SPEEDS[-1]), 0.0),
            speed=np.clip(bump * self.speed, 0.5 * STRIBECK_SPEEDS[0], 2.0 * STRIBECK_SPEEDS[-1]),
        )

    def same(self, other: FrictionStructure) -> bool:
        """Return whether the other structure has the same terms, with parameters that agree within 10 %."""
        kinds = np.array_equal(self.terms, other.terms) and np.array_equal(self.smooth > 0, other.smooth > 0)
        mine, others = (np.stack([s.delta, s.smooth, s.speed]) for s in (self, other))
        return bool(kinds and np.allclose(mine, others, rtol=0.1))


def term_names(terms: np.ndarray, ripple: bool) -> tuple[str, ...]:
    """Return the names of a joint's columns for the given terms (4,), with ripple columns if `ripple` is true."""
    asymmetric, stribeck, root, load = terms
    present = {"coulomb-": asymmetric, "stribeck": stribeck, "root": root, "load": load}
    one = {} if asymmetric else {"coulomb+": "coulomb"}  # for both directions
    own = tuple(one.get(name, name) for name in FRICTION if present.get(name, True))
    return own + COLUMNS[len(FRICTION) :] if ripple else own


def mixing(terms: np.ndarray, width: int) -> np.ndarray:
    """Return the matrix (width, k) that maps all columns of a joint to the columns of the given terms (4,)."""
    fields = [{*FRICTION_TERMS[name].fields} for name in term_names(terms, ripple=False)]
    own = [[{*FRICTION_TERMS[column].fields} <= of for of in fields] for column in FRICTION]
    rest = width - len(FRICTION)
    return np.block([[np.array(own, dtype=float), np.zeros((len(FRICTION), rest))],
                     [np.zeros((rest, len(fields))), np.eye(rest)]])  # fmt: skip


@dataclass(frozen=True, eq=False)
class StructureChoice:
    """Data for the selection of one joint's friction structure; can be pickled for a worker process.

    `fixed`: (M, 2 or more) columns that do not depend on the structure: viscous friction, offset and others. `target`:
    (M,) torque to be explained by friction. `fold`: (M,) fold of each row, 0 to FOLDS - 1. `trust`: (M,) weights of the
    rows; 0 excludes a row. `start`: initial structure, which replaces the grid search.
    """

    motion: FrictionColumns
    fixed: np.ndarray
    target: np.ndarray
    fold: np.ndarray
    trust: np.ndarray
    start: FrictionStructure | None = None


class _StructureSearch:
    """Held-out errors of the friction structures tried for one joint."""

    def __init__(self, choice: StructureChoice) -> None:
        self.motion = choice.motion
        self._order = np.argsort(choice.fold, kind="stable")
        self._edges = np.searchsorted(choice.fold[self._order], np.arange(FOLDS + 1)).tolist()
        self._fastest = np.abs(choice.fixed[:, 0]).max()
        self._trust = choice.trust[self._order, None]
        self._fixed = choice.fixed[self._order] * self._trust
        self._target = choice.target[self._order] * self._trust[:, 0]

    def scores(self, columns: np.ndarray, speeds: np.ndarray, kinds: slice) -> np.ndarray:
        """Return the relative held-out error (S, k) of columns (M, 1, 4 + S) with Stribeck curves of S speeds."""
        A = np.column_stack([columns[:, 0][self._order] * self._trust, self._fixed])
        folds = ((A[a:b], self._target[a:b]) for a, b in pairwise(self._edges))
        sums = [(rows.T @ rows, rows.T @ y, float(y @ y)) for rows, y in folds]
        fixed = columns.shape[2]
        at = dict(zip((*SIGNED, *FIXED), (*range(len(SIGNED)), *range(fixed, A.shape[1]))))
        rest = range(fixed + FIXED.index("ripple cos"), A.shape[1])  # columns in every combination of terms
        kinds_of = ({**at, "stribeck": len(SIGNED) + s} for s in range(len(speeds)))
        picks = np.array([[*(place[name] for name in FRICTION), *rest] for place in kinds_of])
        out = _held_out(sums, picks, _mixings(picks.shape[1])[kinds])
        wide = speeds > self._fastest  # beyond the log's speeds, Stribeck acts as another viscous term
        out[np.ix_(wide, TERMS[kinds, 1])] = np.inf
        return out


def _held_out(sums: list[tuple[np.ndarray, np.ndarray, float]], picks: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return the squared prediction error (S, k) relative to the torque, with each fold predicted from the other folds.

    `sums`: A^T A, A^T y and y^T y for each of F folds. `picks`: (S, w) column indices of A for each Stribeck speed.
    """
    grams, moments, power = (np.array(part) for part in zip(*sums))
    H = np.ascontiguousarray(grams[:, picks[:, :, None], picks[:, None, :]])[:, :, None]  # (F, S, 1, w, w)
    u = np.ascontiguousarray(moments[:, picks])[:, :, None, :, None]
    back = T.transpose(0, 2, 1)
    A, scale = _scaled(back @ (sum(H) - H) @ T)
    x = T @ (np.linalg.solve(A, back @ (sum(u) - u) / scale) / scale)
    errors = power[:, None, None, None, None] - 2.0 * np.swapaxes(u, -2, -1) @ x + np.swapaxes(x, -2, -1) @ H @ x
    told = np.linalg.eigvalsh(_scaled(back @ H @ T)[0])[..., 0] > IDENTIFIED
    identified = np.all(told | ~H.any(axis=(3, 4)), axis=0)
    error, total = sum(errors[..., 0, 0]), sum(power)
    return np.where(identified, np.maximum(error / total if total > 0 else error, EXACT), np.inf)


@cache
def _mixings(width: int) -> np.ndarray:
    """Return the matrices `mixing` (16, width, width) of all TERMS, padded with zeros for absent columns."""
    T = np.zeros((len(TERMS), width, width))
    for k, terms in enumerate(TERMS):
        mixed = mixing(terms, width)
        T[k, :, : mixed.shape[1]] = mixed
    T.flags.writeable = False
    return T


def _scaled(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A (..., w, w) with columns and rows scaled to a diagonal of 1, and the scale (..., w, 1)."""
    scale = np.sqrt(np.diagonal(A, axis1=-2, axis2=-1))
    scale = np.where(scale > 0, scale, 1.0)[..., None]
    A = A / (scale * np.swapaxes(scale, -2, -1))
    diagonal = np.arange(A.shape[-1])
    A[..., diagonal, diagonal] = 1.0 + EXACT
    return A, scale


@one_thread()
def choose(choice: StructureChoice) -> FrictionStructure:
    """Select one joint's structure by cross-validation: refine the simplest structure within 1 % of the best."""
    search, motion = _StructureSearch(choice), choice.motion
    structure = _of_grid(search) if choice.start is None else choice.start
    errors = search.scores(_columns(motion, structure), structure.speed, slice(None))[0]
    simplest = int(np.argmax(errors <= (1.0 + GAIN) * errors.min()))
    # on the grid, a term may have compensated for a width between two grid points
    structure = replace(structure, terms=TERMS[[simplest]])
    return _refine(search, structure, errors[simplest], FEWER)


def _of_grid(search: _StructureSearch) -> FrictionStructure:
    """Return the refined structure of the best grid point."""
    motion = search.motion
    trials = [(delta, 0.0) for delta in DELTAS] + [(DELTAS[3], smooth) for smooth in SMOOTH_SPEEDS]
    scores = []
    for delta, smooth in trials:
        s = motion.sign(np.array([delta]), np.array([smooth]))
        scores.append(search.scores(motion.columns(s, STRIBECK_SPEEDS[:, None]), STRIBECK_SPEEDS, slice(None)))
    t, k, terms = _pick(np.array(scores))  # (trial, speed, terms)
    delta, smooth = trials[t]
    structure = FrictionStructure(np.array([delta]), np.array([smooth]), STRIBECK_SPEEDS[[k]], TERMS[[terms]])
    return _refine(search, structure, scores[t][k, terms], REFINEMENTS)


Chooser = Callable[[Iterable[StructureChoice]], Iterable[FrictionStructure]]


def choose_here(choices: Iterable[StructureChoice]) -> list[FrictionStructure]:
    return list(map(choose, choices))


def _pick(scores: np.ndarray) -> tuple[int, int, int]:
    """Return (trial, speed, terms) of the simplest structure within 1 % of the smallest squared error."""
    kinds = np.arange(len(scores)) < len(DELTAS)
    choices = []
    for k, terms in enumerate(TERMS):
        for kind in (kinds, ~kinds):
            part = np.where(kind[:, None], scores[:, :, k], np.inf)
            t, s = divmod(int(np.argmin(part)), part.shape[1])
            choices.append((float(part[t, s]), (t, s if terms[1] else DEFAULT_SPEED, k)))
    limit = (1.0 + GAIN) * min(score for score, _ in choices)
    return next(choice for score, choice in choices if score <= limit)


def _refine(
    search: _StructureSearch, structure: FrictionStructure, best: float, factors: tuple[float, ...]
) -> FrictionStructure:
    """Scale the sign parameter and Stribeck speed by trial factors; keep those that reduce the held-out error."""
    motion, kind = search.motion, int(np.flatnonzero((structure.terms == TERMS).all(axis=1))[0])
    ways = ((1.0, 0.0), (0.0, 1.0)) if structure.terms[0, 1] else ((1.0, 0.0),)
    for step in (np.log(factor) * np.array([way]) for factor in factors for way in ways):
        for trial in (structure.moved(step), structure.moved(-step)):
            score = float(search.scores(_columns(motion, trial), trial.speed, slice(kind, kind + 1))[0, 0])
            if score < best:
                best, structure = score, trial
                break  # the opposite step would undo this one
    return structure


def _columns(motion: FrictionColumns, structure: FrictionStructure) -> np.ndarray:
    """Return the columns (M, J, 5) for a friction structure of these joints."""
    return motion.columns(motion.sign(structure.delta, structure.smooth), structure.speed[None])

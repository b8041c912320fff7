"""Residual tests in time order, and the parameter covariance for time-correlated residuals.

White residuals have the covariance M = 1 - U U^T, U = J basis. Lag-1 products, runs of equal sign, the two halves and
the tails of the residuals are compared with their distributions under M, so few samples or many parameters cause no
false alarms. If neighbouring residuals are correlated, the noise of each class is modelled as AR(1) plus white noise.
Models with different correlation times and white fractions are averaged, weighted by their restricted likelihood
(Harville 1977). Under this noise, the least-squares estimate has the covariance basis U^T Omega U basis^T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ALARM = 3.5  # z-score above which a test fails
RARE = 4.7e-4  # p-value below which a test fails; equivalent to ALARM
ENOUGH = 8  # degrees of freedom and neighbour pairs needed for a test
OPEN = 1e-6  # minimum fraction of a direction's information in each half for comparing the halves
WHITE_SHARES = (0.0, 0.1, 0.3, 0.6)  # white-noise fractions of the models
SHORTEST, TIMES_PER_DECADE = 0.3, 4  # shortest correlation time, in samples, and number of correlation times per decade
REACH = 3.0  # longest correlation time, in record lengths
SHORTER = 0.4  # prior tau^-0.4 of correlation times; tuned with REACH for correct coverage at 30 to 300 samples
LIKELY = 1e-3  # relative likelihood below which a model is ignored
CHUNK = 256  # samples whose filtered rows are held in memory


@dataclass(frozen=True, eq=False)
class ResidualCheck:
    """Residual diagnostics of a fit."""

    classes: tuple[str, ...]  # C noise classes
    lag1: np.ndarray  # (C,) correlation of neighbours in time order; 0 for white noise
    lag1_z: np.ndarray  # (C,) z-scores relative to white Gaussian noise; 0 with too few samples: lag-1 products,
    runs_z: np.ndarray  # runs of equal sign,
    tails_z: np.ndarray  # and fourth moment
    halves: float  # NEES per parameter between fits to the first and the second half
    halves_p: float  # p-value of `halves` for white noise
    size: float = 1.0  # RMS of the whitened residuals; 1 for estimated noise
    size_p: float = 1.0  # p-value of `size` for the given noise
    growth: float = 1.0  # largest factor by which correlation increases a standard deviation
    robust: bool = False  # whether outliers were detected

    @property
    def correlated(self) -> np.ndarray:
        """Mask (C,) of the classes in which neighbouring residuals are correlated."""
        return (self.lag1_z > ALARM) | (self.runs_z > ALARM)

    @property
    def suspicious(self) -> np.ndarray:
        """Mask (C,) of the classes whose residuals may be correlated; if the halves disagree, all classes with enough
        samples."""
        return self.correlated | ((self.halves_p < RARE) & (self.lag1_z != 0.0))

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence per failed test."""
        found = []
        if self.correlated.any():
            k = int(np.argmax(np.where(self.correlated, self.lag1, -1.0)))
            found.append(
                f"Residuals are correlated in time (lag 1: {self.lag1[k]:.2f} in class {self.classes[k]}): standard "
                f"deviations are up to {self.growth:.2g} times those of independent samples. Look for drift, or for "
                "errors that change slowly along the motion."
            )
        if self.halves_p < RARE:
            found.append(
                f"The first and the second half of the samples disagree (NEES per parameter {self.halves:.2g}; 1 for "
                "independent samples). The setup may have changed during the recording."
            )
        if self.size_p < RARE:
            found.append(f"Residuals are {self.size:.3g} times the given noise. Check the noise and the samples.")
        if self.tails_z.max(initial=0.0) > ALARM and not self.robust:
            found.append("Residuals have heavy tails: some samples may be outliers. Try robust=True.")
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Series:
    """Whitened residuals r (M,) and U (M, d) with the class, channel and sample (M,) of each row; class -1 for
    priors."""

    r: np.ndarray
    U: np.ndarray
    label: np.ndarray
    channel: np.ndarray
    sample: np.ndarray
    classes: tuple[str, ...]


def check_residuals(series: Series, robust: bool, given: bool) -> ResidualCheck:
    """Test the residuals of a fit; `robust`: outliers were detected, `given`: the noise was given, not estimated."""
    from scipy.special import chdtrc

    order = np.lexsort((series.sample, series.channel))
    order = order[series.label[order] >= 0]
    alike = series.channel[order[:-1]] == series.channel[order[1:]]
    first, second = order[:-1][alike], order[1:][alike]
    diagonal = np.maximum(1.0 - np.einsum("ij,ij->i", series.U, series.U), 0.0)
    found = np.zeros((4, len(series.classes)))
    for c in range(len(series.classes)):
        mine, pairs = series.label == c, series.label[first] == c
        found[:, c] = _neighbours(series, diagonal, mine, first[pairs], second[pairs])
    square, free = float(series.r @ series.r), len(series.r) - series.U.shape[1]
    size = (float(np.sqrt(square / free)), float(chdtrc(free, square))) if given and free > 0 else (1.0, 1.0)
    lag1, lag1_z, runs_z, tails_z = found
    return ResidualCheck(series.classes, lag1, lag1_z, runs_z, tails_z, *_halves(series), *size, robust=robust)


def _neighbours(
    series: Series, diagonal: np.ndarray, mine: np.ndarray, i: np.ndarray, j: np.ndarray
) -> tuple[float, float, float, float]:
    """Return the lag-1 correlation of one class, and the z-scores of lag-1 products, runs and fourth moment."""
    r, U, free = series.r, series.U, float(diagonal[mine].sum())
    power = float(r[mine] @ r[mine])
    if free < ENOUGH or len(i) < ENOUGH or power <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    neighbours, Ui, Uj = np.zeros_like(U), U[i], U[j]
    neighbours[i] += 0.5 * Uj
    neighbours[j] += 0.5 * Ui
    usual = -float(np.vdot(Ui, Uj))
    inner = U[mine].T @ neighbours[mine]
    square = 0.5 * len(i) - 2.0 * float(np.vdot(neighbours, neighbours)) + float(np.vdot(inner, inner))
    spread = np.sqrt(max(2.0 * (square - usual**2 / free) * free / (free + 2.0), np.finfo(float).tiny))
    excess = float(r[i] @ r[j]) * free / power - usual
    sd = np.sqrt(np.maximum(diagonal, OPEN))
    chance = -np.einsum("ij,ij->i", Ui, Uj) / (sd[i] * sd[j])
    agree = np.sign(r[i] * r[j]) - 2.0 / np.pi * np.arcsin(np.clip(chance, -1.0, 1.0))
    scaled = r[mine & (diagonal > OPEN)] / sd[mine & (diagonal > OPEN)]
    return excess / len(i), excess / spread, float(agree.sum()) / np.sqrt(len(i)), _kurtosis_z(scaled)


def _kurtosis_z(x: np.ndarray) -> float:
    """Return the z-score of the kurtosis of x relative to a Gaussian (Anscombe and Glynn 1983)."""
    n = float(len(x))
    if n < 2 * ENOUGH:
        return 0.0
    mean = 3.0 * (n - 1.0) / (n + 1.0)
    variance = 24.0 * n * (n - 2.0) * (n - 3.0) / ((n + 1.0) ** 2 * (n + 3.0) * (n + 5.0))
    excess = (n * float(np.sum(x**4)) / float(np.sum(x**2)) ** 2 - mean) / np.sqrt(variance)
    skew = 6.0 * (n * n - 5.0 * n + 2.0) / ((n + 7.0) * (n + 9.0))
    skew *= np.sqrt(6.0 * (n + 3.0) * (n + 5.0) / (n * (n - 2.0) * (n - 3.0)))
    A = 6.0 + 8.0 / skew * (2.0 / skew + np.sqrt(1.0 + 4.0 / skew**2))
    ratio = (1.0 - 2.0 / A) / max(1.0 + excess * np.sqrt(2.0 / (A - 4.0)), np.finfo(float).tiny)
    return float((1.0 - 2.0 / (9.0 * A) - np.cbrt(ratio)) / np.sqrt(2.0 / (9.0 * A)))


def _halves(series: Series) -> tuple[float, float]:
    """Return the NEES per parameter between fits to the first and the second half, and its p-value."""
    from scipy.special import fdtrc

    of_data = series.label >= 0
    middle = np.median(series.sample[of_data])
    U, r = series.U[of_data], series.r[of_data]
    early = series.sample[of_data] < middle
    share, V = np.linalg.eigh(U[early].T @ U[early])
    seen = (share > OPEN) & (share < 1.0 - OPEN)
    free = len(r) - U.shape[1] - int(seen.sum())
    if not seen.any() or free < ENOUGH:
        return 1.0, 1.0
    along = V[:, seen].T @ (U[early].T @ r[early])
    squares = float(np.sum(along**2 / (share[seen] * (1.0 - share[seen]))))
    rest = max(float(r @ r) - squares, np.finfo(float).tiny)
    F = squares / int(seen.sum()) / (rest / free)
    return F, float(fdtrc(int(seen.sum()), free, F))


def correlated_information(series: Series, which: Sequence[int]) -> np.ndarray:
    """Return ``U^T Omega U`` (d, d) for time-correlated noise in some classes; the identity for white noise."""
    total = series.U.T @ series.U
    for c in which:
        mine = series.label == c
        table = _Table.of(series, mine)
        total += table.information() - series.U[mine].T @ series.U[mine]
    return total


@dataclass(frozen=True, eq=False)
class _Table:
    """Rows [U, r] (N, channels, d + 1) of one class over its samples; missing rows are zero, and `there` is False for
    them."""

    rows: np.ndarray
    there: np.ndarray
    width: int

    @classmethod
    def of(cls, series: Series, mine: np.ndarray) -> _Table:
        _, time = np.unique(series.sample[mine], return_inverse=True)
        _, channel = np.unique(series.channel[mine], return_inverse=True)
        shape = int(time.max()) + 1, int(channel.max()) + 1
        rows, there = np.zeros((*shape, series.U.shape[1] + 1)), np.zeros(shape, dtype=bool)
        rows[time, channel, :-1], rows[time, channel, -1] = series.U[mine], series.r[mine]
        there[time, channel] = True
        return cls(rows, there, series.U.shape[1])

    def information(self) -> np.ndarray:
        """Return the mean of U^T Omega U over the noise models, weighted by their restricted likelihood."""
        longest = REACH * len(self.rows)
        times = np.geomspace(SHORTEST, longest, 1 + int(TIMES_PER_DECADE * np.log10(longest / SHORTEST)))
        tau, white = (a.ravel() for a in np.meshgrid(times, WHITE_SHARES))
        phi = np.exp(-1.0 / tau)
        score, power = self._likelihood(phi, white)
        weight = np.exp(score - score.max()) / tau**SHORTER
        kept = weight > LIKELY * weight.max()
        weight = weight[kept] / weight[kept].sum()
        found = self._summed(phi[kept], white[kept]) * power[kept, None, None]
        return np.einsum("g,gij->ij", weight, found)

    def _likelihood(self, phi: np.ndarray, white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the restricted log likelihood (G,) and the variance (G,) of each model."""
        gram, logs = self._filtered(phi, white)
        n, d = int(self.there.sum()), self.width
        U = self.rows[..., :-1].reshape(-1, d)
        _, s, V = np.linalg.svd(np.linalg.qr(U, mode="r"))
        basis = V[: int(np.count_nonzero(s > OPEN * s[0]))].T
        H = basis.T @ gram[:, :d, :d] @ basis
        g = (gram[:, :d, d] @ basis)[:, :, None]
        rest = gram[:, d, d] - np.einsum("gij,gij->g", g, np.linalg.solve(H, g))
        free = n - basis.shape[1]
        return -0.5 * (logs + np.linalg.slogdet(H)[1] + free * np.log(rest)), rest / free

    def _filtered(self, phi: np.ndarray, white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gram matrices (G, d + 1, d + 1) of rows whitened by a Kalman filter, and log det Omega (G,)."""
        G, (_, C, size) = len(phi), self.rows.shape
        slow, decay = (1.0 - white)[:, None], phi[:, None]
        gram, logs = np.zeros((G, size, size)), np.zeros(G)
        state, variance = np.zeros((G, C, size)), np.tile(slow, (1, C))
        for start in range(0, len(self.rows), CHUNK):
            rows, there = self.rows[start : start + CHUNK], self.there[start : start + CHUNK]
            whitened = np.empty((len(rows), G, C, size))
            for k, (y, now) in enumerate(zip(rows, there)):
                S = np.where(now, variance + white[:, None], 1.0)
                new = np.where(now[:, None], y - state, 0.0)
                whitened[k] = new / np.sqrt(S)[:, :, None]
                logs += np.sum(np.log(S), axis=1)
                gain = np.where(now, variance / S, 0.0)
                state = decay[:, :, None] * (state + gain[:, :, None] * new)
                variance = decay**2 * (1.0 - gain) * variance + (1.0 - decay**2) * slow
            flat = whitened.transpose(1, 0, 2, 3).reshape(G, -1, size)
            gram += flat.transpose(0, 2, 1) @ flat
        return gram, logs

    def _summed(self, phi: np.ndarray, white: np.ndarray) -> np.ndarray:
        """Return U^T Omega U (G, d, d) of each model for unit variance."""
        d, U = self.width, self.rows[..., :-1]
        C = U.shape[1]
        decay, memory = phi[:, None, None], np.zeros((len(phi), C, d))
        cross = np.zeros((len(phi), d, d))
        for u in U:
            cross += memory.transpose(0, 2, 1) @ u
            memory = decay * (memory + u)
        flat = U.reshape(-1, d)
        return flat.T @ flat + (1.0 - white)[:, None, None] * (cross + cross.transpose(0, 2, 1))

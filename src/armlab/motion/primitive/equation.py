"""Equation of a movement primitive: phase, kernels and forcing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name, make_read_only, number, numbers, positive
from armlab.errors import ConfigError, ShapeError
from armlab.motion.arguments import kernel_count, vector
from armlab.motion.storage import freeze_arrays

CONVENTIONS = ("lund", "ijspeert")
SCHEDULES = ("canonical", "time", "position")
SPACINGS = ("time", "phase")
SCALINGS = ("goal", "none", "amplitude", "rotate")
ROUNDING = 1e-12  # motion of a coordinate, relative to the largest value, below which it counts as rounding error
PER_COORDINATE = ("y0", "v0", "g", "extent", "peak_acceleration", "monotone")

UNSCALED = 0.05  # displacement, relative to the demonstrated range, up to which the goal does not scale a coordinate


def time_constants(convention: str, duration: float, alpha_z: float) -> tuple[float, float]:
    """Return alpha_x and tau_d [s] of a convention for a duration [s]."""
    check_name(convention, "convention", CONVENTIONS)
    return (1.0, duration / 3.0) if convention == "lund" else (alpha_z / 3.0, duration)


def placed(schedule: str, spacing: str, n_basis: int, decay: float, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres and widths (n_basis,) of the kernels along the phase.

    Spacing "time" is uniform in time; each width is `factor` times the distance between centres. Spacing "phase" is
    uniform in the phase, as in DynamicMovementPrimitives.jl. The phase ends at exp(-decay), with decay = alpha_x
    duration / tau_d.
    """
    check_name(schedule, "schedule", SCHEDULES)
    check_name(spacing, "spacing", SPACINGS)
    u = np.linspace(0.0, 1.0, kernel_count(n_basis, 50))
    if schedule != "canonical":
        return u, np.full(n_basis, factor / (n_basis - 1))
    last = np.exp(-decay)
    if spacing == "phase":
        return np.linspace(last, 1.0, n_basis), np.full(n_basis, np.sqrt(1.0 - last) * 0.5 / n_basis)
    centres = np.exp(-decay * u)
    gaps = np.abs(np.diff(centres))
    return centres, factor * np.append(gaps, gaps[-1])


def normalised(u: np.ndarray, centres: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normalised Gaussian kernels (computed as a softmax) and their derivatives with respect to u (..., 1)."""
    exponents = -0.5 * ((u - centres) / widths) ** 2
    psi = np.exp(exponents - exponents.max(axis=-1, keepdims=True))
    psi /= psi.sum(axis=-1, keepdims=True)
    slope = -(u - centres) / widths**2
    return psi, psi * (slope - (psi * slope).sum(axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False, repr=False)
class Equation:
    """Fields and equations of `Dmp`."""

    weights: np.ndarray
    centres: np.ndarray
    widths: np.ndarray
    tau_d: float
    duration: float
    y0: np.ndarray
    v0: np.ndarray
    g: np.ndarray
    extent: np.ndarray
    peak_acceleration: np.ndarray
    monotone: np.ndarray
    alpha_z: float = 25.0
    beta_z: float = 6.25
    alpha_x: float = 1.0
    schedule: str = "canonical"
    scaling: str = "goal"
    convention: str = "lund"
    demo_weights: np.ndarray | None = None
    limits: np.ndarray | None = None

    UNITS: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("weights", "demo_weights", "y0", "g", "extent", "limits"), "unit of y, rad or m"),
        "v0": "unit of y per s",
        "peak_acceleration": "unit of y per s^2",
        "tau_d": "s",
        "duration": "s",
        **dict.fromkeys(("centres", "widths", "alpha_z", "beta_z", "alpha_x"), "1"),
    }

    def __post_init__(self) -> None:
        given = [name for name in ("demo_weights", "limits") if getattr(self, name) is not None]
        freeze_arrays(self, "weights", "centres", "widths", *PER_COORDINATE, *given)
        object.__setattr__(self, "monotone", self.monotone > 0)
        make_read_only(self, "monotone")
        self._check_shapes()
        for name in ("tau_d", "duration", "alpha_z", "beta_z", "alpha_x"):
            object.__setattr__(self, name, positive(getattr(self, name), name))
        known = {"schedule": SCHEDULES, "scaling": SCALINGS, "convention": CONVENTIONS}
        for name, names in known.items():
            check_name(getattr(self, name), name, names)
        if self.scaling == "rotate" and (self.n != 3 or self.schedule == "position"):
            raise ConfigError(
                "Expected three coordinates with one phase for scaling "
                f"'rotate', got {self.n} coordinates with schedule "
                f"{self.schedule!r}. Use scaling 'goal'."
            )

    def _check_shapes(self) -> None:
        if self.weights.ndim != 2 or min(self.weights.shape) < 1:
            raise ShapeError(f"Expected weights of shape (n_basis, n), got {self.weights.shape}.")
        m, n = self.weights.shape
        wanted = {"centres": (m,), "widths": (m,), **dict.fromkeys(PER_COORDINATE, (n,))}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(
                    f"Expected {name} of shape {shape} with weights {self.weights.shape}, got "
                    f"{getattr(self, name).shape}."
                )
        if (self.widths <= 0).any():
            raise ShapeError(f"Expected widths (standard deviations) above 0, got {self.widths.min():g}. Correct them.")
        if self.limits is not None and (self.limits.shape != (2, n) or (self.limits[0] > self.limits[1]).any()):
            raise ShapeError(
                f"Expected limits (2, {n}), with the lowest goals in the first row, got shape {self.limits.shape}."
            )
        if self.demo_weights is not None and self.demo_weights.shape[1:] != (m, n):
            raise ShapeError(f"Expected demo_weights of shape (M, {m}, {n}), got {self.demo_weights.shape}.")

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.weights.shape[1]

    @property
    def n_basis(self) -> int:
        """Number of kernels."""
        return self.weights.shape[0]

    @property
    def unscaled(self) -> tuple[int, ...]:
        """Coordinates not scaled by the goal, because their displacement is negligible or below 5 % of their range."""
        if self.scaling != "goal":
            return ()
        rounding = ROUNDING * max(self.extent.max(), np.abs([self.y0, self.g]).max())
        least = np.maximum(UNSCALED * self.extent, rounding)
        return tuple(np.flatnonzero(abs(self.g - self.y0) <= least).tolist())

    @cached_property
    def _primitive(self) -> Any:
        """The `armlab.kernels.Primitive` with the fitted weights."""
        return self._primitive_of(self.weights)

    def _primitive_of(self, weights: np.ndarray) -> Any:
        """Return an `armlab.kernels.Primitive` with the given weights (n_basis, n)."""
        stiffness, pace = self.alpha_z * self.beta_z, self.tau_d / self.duration
        return kernels.Primitive(
            self.centres, self.widths, weights, self.alpha_z, stiffness, self.alpha_x, pace, self.schedule
        )

    def phase(self, t: ArrayLike, tau_d: float | None = None) -> np.ndarray:
        """Return the phase (...) at times (...) since the start: ``exp(-alpha_x t / tau_d)``, or time / duration.

        Parameters
        ----------
        t : times [s].
        tau_d : time constant [s] of the run; default: from the demonstration.

        Raises
        ------
        ConfigError : schedule "position", whose phase depends on the motion.
        """
        if self.schedule == "position":
            raise ConfigError("Expected a time-dependent phase, got schedule 'position'. Use Rollout.x.")
        s = numbers(t, "t", ShapeError) / (self.tau_d if tau_d is None else tau_d)
        return np.exp(-self.alpha_x * s) if self.schedule == "canonical" else s * (self.tau_d / self.duration)

    def kernels(self, x: ArrayLike) -> np.ndarray:
        """Return kernels ``exp(-(x - c)^2 / (2 sd^2))`` (..., n_basis) at phases (...), divided by their sum.

        Parameters
        ----------
        x : phases.
        """
        return self._primitive.basis(numbers(x, "x", ShapeError))

    def forcing(self, x: ArrayLike) -> np.ndarray:
        """Return the forcing (..., n) of the demonstration: ``(psi(x) w)`` times x or, with schedule "time", times the
        fade-out factor.

        Parameters
        ----------
        x : (...) phases; (..., n) with schedule "position".
        """
        return self._primitive.forcing(numbers(x, "x", ShapeError))

    def acceleration(self, y: ArrayLike, yd: ArrayLike, x: ArrayLike) -> np.ndarray:
        """Return ydd (..., n) of a state: ``(alpha_z (beta_z (g - y) - tau_d yd) + f(x)) / tau_d^2``.

        Parameters
        ----------
        y, yd : (..., n) position and velocity.
        x : phases as in `forcing`.
        """
        y, yd = vector(y, "y", self.n), vector(yd, "yd", self.n)
        spring = self.alpha_z * (self.beta_z * (self.g - y) - self.tau_d * yd)
        return (spring + self.forcing(x)) / self.tau_d**2

    def linearise(self, x: float) -> tuple[np.ndarray, np.ndarray]:
        """Return A (2n + 1, 2n + 1) and B (2n + 1, n) of the linearisation ``d/dt [y, yd, x] = A [y, yd, x] + B g``.

        Parameters
        ----------
        x : phase of the linearisation.

        Raises
        ------
        ConfigError : schedule "position".
        """
        if self.schedule == "position":
            raise ConfigError(
                "Expected a time-dependent phase to linearise around, got schedule 'position'. Use 'canonical' or "
                "'time'."
            )
        at, n, tau, step = number(x, "x"), self.n, self.tau_d, 1e-6
        A, B = np.zeros((2 * n + 1, 2 * n + 1)), np.zeros((2 * n + 1, n))
        A[:n, n : 2 * n] = np.eye(n)
        A[n : 2 * n, :n] = -self.alpha_z * self.beta_z / tau**2 * np.eye(n)
        A[n : 2 * n, n : 2 * n] = -self.alpha_z / tau * np.eye(n)
        A[n : 2 * n, 2 * n] = (self.forcing(at + step) - self.forcing(at - step)) / (2 * step * tau**2)
        A[2 * n, 2 * n] = -self.alpha_x / tau if self.schedule == "canonical" else 0.0
        B[n : 2 * n] = self.alpha_z * self.beta_z / tau**2 * np.eye(n)
        return A, B

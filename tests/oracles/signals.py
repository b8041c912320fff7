"""Streaming operators on signals."""

from __future__ import annotations

import numpy as np

KINDS = ("trapezoid", "euler", "difference", "exponential", "lowpass", "slope", "notch")
GAP = 1.5


class SignalOperator:
    """Operator with memory: one sample in, one sample out, with the true step h since the last one.

    ::

        trapezoid    y += h (x + x_prev) / 2          first output init
        euler        y += h x                         first output init + dt x_0
        difference   y = (x - x_prev) / h             first output 0, or (x_0 - init) / dt
        exponential  y = a y + (1 - a) x, a = exp(-h / T)   first output x_0, or one step of dt from init
        lowpass      y'' + 2 z w y' + w^2 y = w^2 x   first output init, or x_0
        slope        y' of lowpass                    first output 0
        notch        x - 2 z / w y' of lowpass        first output x_0

    The oscillators are solved exactly for an input that is linear between samples: with slope
    ``s = (x - x_prev) / h`` and lag ``2 z / w s``, the distance ``e = y - x_prev + lag`` and its rate ``u = y' - s``
    move freely, ``[e; u] <- exp([[0, 1], [-w^2, -2 z w]] h) [e; u]``.

    A sample that is not finite gives NaN, changes nothing and is counted in `skipped`; its time belongs to the next
    step. A step longer than 1.5 dt (1.5 times the first step where dt is NaN) is counted in `gaps`.
    """

    def __init__(self, kind: str, a: float, b: float, dt: float, init: np.ndarray | float | None = None) -> None:
        self._kind, self._a, self._b, self._dt = kind, a, b, dt
        self.reset(init)

    def reset(self, init: np.ndarray | float | None = None) -> None:
        if init is not None:
            self._init = np.array(init, dtype=float).ravel()
        elif not hasattr(self, "_init"):
            self._init = np.zeros(0)
        self.gaps, self.skipped, self.longest_gap = 0, 0, 0.0
        self._started, self._stamped = False, False
        self._clock, self._waiting = 0.0, 0.0
        self._nominal = 0.0 if np.isnan(self._dt) else self._dt
        self._x = self._y = self._v = np.zeros(0)

    def step(self, x: np.ndarray | float, t: float | None = None) -> np.ndarray | float:
        x = np.array(x, dtype=float)
        out = self._step(x, t)
        return out if out.ndim else float(out)

    def run(self, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        stamps = None if t is None else np.asarray(t, dtype=float)
        out = np.empty_like(x)
        for k in range(len(x)):
            out[k] = self.step(x[k], None if stamps is None else float(stamps[k]))
        return out

    def _step(self, x: np.ndarray, t: float | None) -> np.ndarray:
        if not np.isfinite(x).all() or (t is not None and not np.isfinite(t)):
            self.skipped += 1
            self._waiting += self._dt if self._started and t is None else 0.0
            return np.full(x.shape, np.nan)
        if not self._started:
            self._stamped = t is not None
            out = self._begin(x)
        else:
            h = self._dt + self._waiting if t is None else t - self._clock
            self._note_gap(h)
            out = self._advance(h, x)
        self._x, self._waiting = x, 0.0
        self._clock = self._clock if t is None else t
        return out

    def _note_gap(self, h: float) -> None:
        self._nominal = self._nominal or h
        if h > GAP * self._nominal * (1.0 + 1e-9):
            self.gaps += 1
            self.longest_gap = max(self.longest_gap, h)

    def _begin(self, x: np.ndarray) -> np.ndarray:
        """Take the first sample: operators that look back take a step of dt from `init`; the others start there."""
        given, timed = self._init.size > 0, not np.isnan(self._dt)
        whole = self._init.reshape(x.shape if self._init.size == x.size else ()) if given else x
        initial = np.broadcast_to(whole, x.shape)
        self._started, self._x, self._v = True, x, np.zeros_like(x)
        self._y = initial + np.zeros_like(x) if given or self._kind not in KINDS[:3] else np.zeros_like(x)
        if self._kind == "difference" and given:
            self._y = (x - initial) / self._dt if timed else np.zeros_like(x)
        elif timed and (self._kind == "euler" or (self._kind == "exponential" and given)):
            return self._advance(self._dt, x)
        return self._output(x)

    def _advance(self, h: float, x: np.ndarray) -> np.ndarray:
        y, before = self._y, self._x
        if self._kind == "trapezoid":
            self._y = y + 0.5 * h * (x + before)
        elif self._kind == "euler":
            self._y = y + h * x
        elif self._kind == "difference":
            self._y = (x - before) / h
        elif self._kind == "exponential":
            a = np.exp(-h / self._a)
            self._y = a * y + (1.0 - a) * x
        else:
            self._oscillate(h, x)
        return self._output(x)

    def _oscillate(self, h: float, x: np.ndarray) -> None:
        w, z = self._a, self._b
        turning, decay = w * np.sqrt(1.0 - z * z), np.exp(-z * w * h)
        c, s = decay * np.cos(turning * h), decay * np.sin(turning * h) / turning
        slope = (x - self._x) / h
        late = 2.0 * z / w * slope
        e, u = self._y - self._x + late, self._v - slope
        self._y = (c + z * w * s) * e + s * u + x - late
        self._v = -w * w * s * e + (c - z * w * s) * u + slope

    def _output(self, x: np.ndarray) -> np.ndarray:
        if self._kind == "slope":
            return self._v.copy()
        return x - 2.0 * self._b / self._a * self._v if self._kind == "notch" else self._y.copy()

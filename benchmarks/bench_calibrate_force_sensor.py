"""Force sensors and accelerometers: error over the Cramér-Rao bound, handedness, outliers, coverage, time.

Cases F1 to F6 of the specification: 100 orientations, uniform or tilted by at most 30 degrees, 1 kg. The bounds are
evaluated at the truth. Offsets are compared as o = -R b in tool axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, loop, table

from armlab.calibrate import fit_accelerometer, fit_force_sensor
from armlab.errors import NotConverged
from armlab.lie import so3
from armlab.sim import cell

G = np.array([0.0, 0.0, -9.82])
UNITS = {
    "rotation": "rad",
    "mass": "kg",
    "weight": "N",
    "centre": "m",
    "offset of torque": "N m",
    "offset": "N or m/s^2",
}
BAR, TILT = 1.05, np.radians(30.0)


@dataclass(frozen=True)
class Case:
    """Case: seed, force and torque noise, randomised quantities, share of contacts [%]."""

    name: str
    seed: int
    sigma: float
    tilt: bool = False
    torque: float | None = None
    unknown: bool = False
    bias: bool = True
    contacts: int = 0
    accelerometer: bool = False

    @property
    def N(self) -> int:
        """Number of samples."""
        return 50 if self.accelerometer else 100


CASES = (
    Case("F1, 0.1 N", 3000, 0.1),
    Case("F1, 1 N", 3000, 1.0),
    Case("F2, 0.1 N", 3000, 0.1, tilt=True),
    Case("F2, 1 N", 3000, 1.0, tilt=True),
    *(Case(f"F3, {k} %{', tilt' * t}", 3400, 0.1, bool(t), contacts=k) for t in (0, 1) for k in (5, 10, 30)),
    Case("F4, 0.1 N, 5 mN m", 3300, 0.1, torque=0.005),
    Case("F4, 1 N, 10 mN m", 3300, 1.0, torque=0.01),
    Case("F5, no bias, 1 N", 3100, 1.0, unknown=True, bias=False),
    Case("F5, bias, 0.1 N", 3200, 0.1, unknown=True),
    Case("F5, tilt, 0.1 N", 3200, 0.1, tilt=True, unknown=True),
    Case("F5, tilt, 1 N (report only)", 3200, 1.0, tilt=True, unknown=True),
    Case("F6, accelerometer", 3500, 0.02, accelerometer=True),
)


def run(quick: bool) -> list[Table]:
    """Evaluate every case in many runs, then time fits of one experiment."""
    runs = 100 if quick else 1000
    lines = [f"{runs} runs each; error / bound per part, target {BAR}; NEES / dimension; number rejected as mirrored."]
    lines += on_all_cores(_judged, CASES, repeat(runs))
    contenders = []
    for case in (CASES[k] for k in (0, 5, 10, 13)):
        data = [_draw(case, i)[0] for i in range(20)]
        fit = loop(lambda one, case=case: _fit(case, one), data)
        contenders.append(Contender(f"armlab {case.name}", fit, "armlab"))
    clouds = [(G @ one["T_base_tool"], one["wrench"]) for one in (_draw(CASES[0], i)[0] for i in range(20))]
    contenders.append(Contender("the decomposition alone", loop(_decomposition, clouds), "limit"))
    return [table("Force sensors by gravity", "\n\n".join(lines), "µs", contenders, 3 if quick else 10)]


def _decomposition(cloud: tuple[np.ndarray, np.ndarray]) -> Any:
    h, f = (part - part.mean(axis=0) for part in cloud)
    return np.linalg.svd(h.T @ f)


def _draw(case: Case, run: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], np.ndarray]:
    """Return the arguments, the same arguments with noise-free readings, the truth, and the samples in contact."""
    made = cell(case.seed)
    if case.accelerometer:
        drawn = made.accelerometer(run, case.N, sigma=case.sigma)
    else:
        tilt = TILT if case.tilt else None
        drawn = made.force(
            run, case.N, sigma=case.sigma, tilt=tilt, torque=case.torque, unknown=case.unknown, bias=case.bias,
            contacts=case.contacts,
        )  # fmt: skip
    noise = case.sigma if case.torque is None else (case.sigma, case.torque)
    g = -drawn.weight if case.accelerometer else G
    data: dict[str, Any] = {"T_base_tool": drawn.RA, "wrench": drawn.y, "gravity": g, "noise": noise}
    if case.unknown:
        data |= {"gravity": "unknown", "bias": case.bias}
    truth = {"R": drawn.R, "b": drawn.bias[:3], "gamma": drawn.weight, "r": drawn.centre, "b_tau": drawn.bias[3:]}
    free = ~drawn.touched
    clean = data | {"T_base_tool": drawn.RA[free], "wrench": drawn.exact[free]}
    return data | {"robust": case.contacts > 0}, clean, truth, drawn.touched


def _fit(case: Case, data: dict[str, Any]) -> Any:
    if not case.accelerometer:
        return fit_force_sensor(**data)
    names = {"T_base_tool": "T_base_tool", "wrench": "acc", "gravity": "gravity", "noise": "noise"}
    return fit_accelerometer(**{new: data[old] for old, new in names.items()})


def _error(case: Case, fit: Any, truth: dict[str, Any]) -> tuple[dict[str, slice], np.ndarray]:
    """Return the slices of the parts, and the error in the coordinates of the covariance."""
    value = fit.value
    parts = {"rotation": so3.log(truth["R"].T @ value.R_tool_sensor)}
    if case.unknown:
        parts["weight"] = value.mass * value.gravity - truth["gamma"]
    elif not case.accelerometer:
        parts["mass"] = np.array([value.mass - 1.0])
    if case.bias:
        parts["offset"] = value.bias[:3] - truth["b"]
    if case.torque is not None:
        parts |= {"centre": value.centre - truth["r"], "offset of torque": value.bias[3:] - truth["b_tau"]}
    ends = np.cumsum([0, *(len(part) for part in parts.values())])
    places = {name: slice(int(a), int(b)) for name, a, b in zip(parts, ends[:-1], ends[1:])}
    return places, np.concatenate(list(parts.values()))


def _judged(case: Case, runs: int) -> str:
    errors: dict[str, float] = {}
    bounds: dict[str, float] = {}
    nees, refused, missed, false = [], 0, 0, 0
    for run in range(runs):
        data, clean, truth, touched = _draw(case, run)
        try:
            fit = _fit(case, data)
        except NotConverged:
            refused += 1
            continue
        C = _fit(case, clean).cov
        places, e = _error(case, fit, truth)
        nees.append(e @ np.linalg.solve(fit.cov, e) / len(e))
        if "offset" in places:  # o = -R b rotates with R
            T = np.eye(len(e))
            T[places["offset"], places["rotation"]] = -so3.hat(truth["b"])
            e, C = T @ e, T @ C @ T.T
        for name, at in places.items():
            errors[name] = errors.get(name, 0.0) + float(e[at] @ e[at])
            bounds[name] = bounds.get(name, 0.0) + float(np.trace(C[at, at]))
        if case.contacts:
            missed += int(np.sum(touched & ~fit.outliers))
            false += int(np.sum(~touched & fit.outliers))
    ratios = ", ".join(
        f"{name} {np.sqrt(errors[name] / bounds[name]):.3f} of {np.sqrt(bounds[name] / len(nees)):.3g} {UNITS[name]}"
        for name in errors
    )
    flags = f"; {missed} contacts missed, {100.0 * false / (runs * case.N):.2f} % false" if case.contacts else ""
    return f"{case.name}: {ratios}; NEES {np.mean(nees):.3f}; {refused} refused{flags}."

"""The statistical contract: ten properties that every `fit_*` of the package must have, tested by one function.

A fit is run on many experiments of known truth. What it says of its own errors is then held to the errors that it made:

    NEES = e^T C^-1 e,    mean over runs = number of parameters, when the covariance C is honest

(Bar-Shalom, Li and Kirubarajan 2001). The other properties are laws: order, units, refusals, files, clean hands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab._numbers import flag, number
from armlab.errors import ConfigError, UnknownName
from armlab.estimation import _laws, _statistics
from armlab.estimation._statistics import Trial
from armlab.estimation.fit import Fit

__all__ = ["PROPERTIES", "Contract", "Experiment", "Gauge", "Limits", "Property", "check_estimator", "difference"]

PROPERTIES = (
    "consistent",
    "honest",
    "efficient",
    "order-free",
    "gauge-free",
    "refuses",
    "robust",
    "saves",
    "explains",
    "clean",
)
BENCHMARK = 1000  # runs from which the limits of the benchmark hold

Error = Callable[[Fit[Any], Any], Any]
Spoil = Callable[[dict[str, Any], np.random.Generator], tuple[dict[str, Any], np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment of known truth.

    Attributes
    ----------
    data : keyword arguments of the fit: arrays with samples along axis 0, Tables, noise, whatever it takes.
    truth : what the fit should find; the (d,) parameters unless `error` knows better.
    bound : (d, d) Cramer-Rao bound of the errors; without it the fit cannot be called efficient.
    """

    data: Mapping[str, Any]
    truth: Any
    bound: np.ndarray | None = None


@dataclass(frozen=True)
class Gauge:
    """A change of frame or unit that must change the answer in a known way.

    Attributes
    ----------
    name : in words. change : data -> data of the same experiment in other frames or units.
    expect : fit of the data as they were -> truth that the fit of the changed data should find.
    """

    name: str
    change: Callable[[dict[str, Any]], dict[str, Any]]
    expect: Callable[[Fit[Any]], Any]


@dataclass(frozen=True)
class Limits:
    """What is accepted.

    Two-sided limits give way to three standard errors where few runs make these wider; one-sided ones grow by them.

    Attributes
    ----------
    consistent : error of 4 N samples over that of N. honest : NEES over its dimension. covered : by stated 95 %.
    efficient : error over the Cramer-Rao bound. robust : error with 5 % outliers over that of the rest.
    false : share of good samples that may be flagged.
    """

    consistent: tuple[float, float] = (0.40, 0.60)
    honest: tuple[float, float] = (0.80, 1.25)
    covered: tuple[float, float] = (0.93, 0.97)
    efficient: float = 1.05
    robust: float = 1.25
    false: float = 0.005

    @classmethod
    def of(cls, runs: int, noise_given: bool) -> Limits:
        """Return the limits of the test suite, or those of the benchmark from 1000 runs on.

        Parameters
        ----------
        runs : their number. noise_given : False where the fit estimates it, which widens the NEES.
        """
        noise_given = flag(noise_given, "noise_given")
        if number(runs, "the number of runs") < BENCHMARK:
            return cls(honest=(0.80, 1.25 if noise_given else 1.30))
        return cls((0.44, 0.54), (0.95, 1.05 if noise_given else 1.10), robust=1.06)


@dataclass(frozen=True)
class Property:
    """One property of the contract.

    Attributes
    ----------
    name : one of PROPERTIES. passed : None where it was not judged. text : what was measured and needed, or why not.
    """

    name: str
    passed: bool | None
    text: str


@dataclass(frozen=True)
class Contract:
    """What `check_estimator` found.

    Attributes
    ----------
    properties : all ten, in the order of PROPERTIES. runs : number of experiments.
    """

    properties: tuple[Property, ...]
    runs: int

    @property
    def passed(self) -> bool:
        """True when no property failed."""
        return all(one.passed is not False for one in self.properties)

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the properties that failed."""
        return tuple(one.name for one in self.properties if one.passed is False)

    def __getitem__(self, name: str) -> Property:
        """Return the property of that name."""
        for one in self.properties:
            if one.name == name:
                return one
        raise UnknownName.among("property", name, PROPERTIES)

    def text(self) -> str:
        """Return one line per property: verdict, name, and what was measured."""
        verdicts = {True: "passed", False: "FAILED", None: "-"}
        lines = [f"{verdicts[one.passed]:7s}{one.name:11s} {one.text}" for one in self.properties]
        return "\n".join([*lines, f"{self.runs} runs"])


def difference(fit: Fit[Any], truth: Any) -> np.ndarray:
    """Return the error (d,) of the parameters of a fit against a truth of the same shape."""
    return fit.parameters - np.asarray(truth)


def check_estimator(
    fit: Callable[..., Fit[Any]],
    experiment: Callable[[int, int], Experiment],
    runs: int = 200,
    *,
    n: int = 50,
    error: Error = difference,
    blocks: Mapping[str, Sequence[int]] | None = None,
    gauges: Sequence[Gauge] = (),
    refusals: Mapping[str, Mapping[str, Any]] | None = None,
    spoil: Spoil | None = None,
    noise_given: bool = True,
    limits: Limits | None = None,
    skip: Mapping[str, str] | None = None,
    seed: int = 0,
) -> Contract:
    """Test a fit for the ten properties of the statistical contract; what fails is in the result, nothing is raised.

    Parameters
    ----------
    fit : takes `Experiment.data` as keyword arguments, returns a `Fit`.
    experiment : (seed, n) -> `Experiment` of n samples; the same seed gives the same experiment.
    runs : experiments; from 1000 on the narrower limits of the benchmark hold, and efficiency is judged.
    n : samples of an experiment; consistency also needs experiments of 4 n.
    error : (fit, truth) -> (d,) error in the coordinates of `fit.cov`, or that and its covariance (m, m), for example
        errors of validation poses where `fit.cov` has not full rank.
    blocks : parts of the error whose efficiency is judged apart, name -> indices; the whole when left out.
    gauges : changes of frame or unit.
    refusals : words -> data that must be refused by `NotExcited` with a direction that contains the words.
    spoil : (data, rng) -> data with 5 % gross outliers, with what makes the fit look for them, and which samples (N,)
        they are, None where the fit has no flags.
    noise_given : False where the fit estimates the noise: NEES then exceeds 1 by about 2 / (degrees of freedom).
    limits : what is accepted, where a specification says another thing.
    skip : property -> why this fit cannot have it.
    seed : of the first experiment.

    Raises
    ------
    UnknownName : `skip` names a property that does not exist. ConfigError : without a reason.
    """
    reasons = dict(skip or {})
    for name, reason in reasons.items():
        if name not in PROPERTIES:
            raise UnknownName.among("property", name, PROPERTIES)
        if not reason.strip():
            raise ConfigError(
                f"Expected the reason why {name!r} is skipped, got none. Say why this fit cannot have it."
            )
    accepted = limits or Limits.of(runs, noise_given)
    trial = Trial(fit, experiment, runs, n, seed, error, blocks or {}, gauges, refusals or {}, spoil, accepted)
    return Contract(tuple(_properties(trial, reasons)), runs)


def _properties(trial: Trial, reasons: dict[str, str]) -> Iterator[Property]:
    judges = {
        "consistent": _statistics.consistent,
        "honest": _statistics.honest,
        "efficient": _statistics.efficient,
        "order-free": _laws.order_free,
        "gauge-free": _laws.gauge_free,
        "refuses": _laws.refuses,
        "robust": _statistics.robust,
        "saves": _laws.saves,
        "explains": _laws.explains,
        "clean": _laws.clean,
    }
    for name, judge in judges.items():
        if name in reasons:
            yield Property(name, None, f"skipped: {reasons[name]}")
            continue
        try:
            yield Property(name, *judge(trial))
        except Exception as error:  # whatever a fit does wrong is a finding
            yield Property(name, False, f"raised {type(error).__name__}: {error}")

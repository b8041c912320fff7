"""Estimation for the whole package: `Fit`, streaming and robust least squares, excitation, block bootstrap."""

from armlab.estimation.bootstrap import (
    BlockSums,
    Bootstrap,
    CrossValidation,
    block_bootstrap,
    block_cv,
    block_seconds,
    correlation_time,
    effective_samples,
    shrinkage,
)
from armlab.estimation.contract import Contract, Experiment, Gauge, Limits, Property, check_estimator, difference
from armlab.estimation.errors_in_variables import TotalSolution, total_least_squares
from armlab.estimation.excitation import Excitation, Prior, check_excitation, check_spread, unhurried
from armlab.estimation.fit import Fit
from armlab.estimation.linear_problem import ActiveBound, LinearProblem, LinearSolution, solve, within_bounds
from armlab.estimation.nonlinear import Measurement, NonlinearProblem, NonlinearSolution, nonlinear_least_squares
from armlab.estimation.robust import huber, least_squares, least_trimmed_squares, mad
from armlab.estimation.tsqr import Factors, Rows, factorise

__all__ = [
    "ActiveBound",
    "BlockSums",
    "Bootstrap",
    "Contract",
    "CrossValidation",
    "Excitation",
    "Experiment",
    "Factors",
    "Fit",
    "Gauge",
    "Limits",
    "LinearSolution",
    "Measurement",
    "NonlinearSolution",
    "Prior",
    "NonlinearProblem",
    "Property",
    "LinearProblem",
    "Rows",
    "TotalSolution",
    "block_bootstrap",
    "block_cv",
    "block_seconds",
    "check_estimator",
    "check_excitation",
    "check_spread",
    "correlation_time",
    "difference",
    "effective_samples",
    "factorise",
    "huber",
    "least_squares",
    "mad",
    "nonlinear_least_squares",
    "shrinkage",
    "solve",
    "total_least_squares",
    "least_trimmed_squares",
    "unhurried",
    "within_bounds",
]

"""Estimation for the whole package: `Fit`, streaming and robust least squares, excitation, block bootstrap."""

from armlab.estimation.blocks import BlockSums, Bootstrap, CrossValidation, block_bootstrap, block_cv, shrinkage
from armlab.estimation.bounds import within_bounds
from armlab.estimation.contract import Contract, Experiment, Gauge, Limits, Property, check_estimator, difference
from armlab.estimation.correlation import block_seconds, correlation_time, effective_samples
from armlab.estimation.descent import Problem
from armlab.estimation.excitation import Excitation, Prior, check_excitation, check_spread, unhurried
from armlab.estimation.factors import Factors, Rows, factorise
from armlab.estimation.fit import Fit
from armlab.estimation.linear import least_squares
from armlab.estimation.measurements import Measurement
from armlab.estimation.nonlinear import NonlinearSolution, nonlinear_least_squares
from armlab.estimation.robust import huber, mad, trimmed
from armlab.estimation.solution import ActiveBound, LinearSolution, Question, solve
from armlab.estimation.total import TotalSolution, total_least_squares

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
    "Problem",
    "Property",
    "Question",
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
    "trimmed",
    "unhurried",
    "within_bounds",
]

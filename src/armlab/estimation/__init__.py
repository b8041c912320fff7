"""Estimation tools used by the whole package: `Fit`, streaming and robust least squares, excitation, block
bootstrap."""

from armlab.estimation.contract import Contract, ContractLimits, Experiment, Gauge, check_estimator
from armlab.estimation.errors_in_variables import total_least_squares
from armlab.estimation.fit import Fit
from armlab.estimation.linear_problem import Excitation, Prior
from armlab.estimation.nonlinear import Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.robust import BlockSums, Bootstrap, CrossValidation, block_bootstrap, block_cv, least_squares
from armlab.estimation.tsqr import Rows

__all__ = [
    "BlockSums", "Bootstrap", "Contract", "ContractLimits", "CrossValidation", "Excitation", "Experiment", "Fit",
    "Gauge", "Measurement", "NonlinearProblem", "Prior", "Rows", "block_bootstrap", "block_cv", "check_estimator",
    "least_squares", "nonlinear_least_squares", "total_least_squares",
]  # fmt: skip

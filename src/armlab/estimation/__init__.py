"""Estimation for the whole package: `Fit`, block least squares, excitation, block bootstrap, effective sample size."""

from armlab.estimation.blocks import (
    BlockSums,
    accumulate,
    block_bootstrap,
    correlation_time,
    effective_samples,
)
from armlab.estimation.excitation import Excitation, check_excitation
from armlab.estimation.fit import Fit

__all__ = [
    "BlockSums",
    "Excitation",
    "Fit",
    "accumulate",
    "block_bootstrap",
    "check_excitation",
    "correlation_time",
    "effective_samples",
]

"""What figures are given: another kind of thing gets a sentence in place of a fault deep inside."""

from __future__ import annotations

from armlab.errors import ShapeError, shortened

__all__ = ["expect"]

_MAKERS = {
    "Dmp": "motion.fit_dmp gives one",
    "Excitation": "The excitation of a fit is one",
    "Fit": "A fit_* returns one, and estimation.Fit.load reads one",
    "Hypotheses": "contact.hypotheses gives them",
    "PeriodicDmp": "motion.fit_periodic_dmp gives one",
    "PoseDmp": "motion.fit_pose_dmp gives one",
    "ProMP": "motion.fit_promp gives one",
    "Table": "log.read gives one",
    "TwoDofRun": "TwoDofDmp.simulate and TwoDofDmp.recorded give one",
}


def expect(value: object, kind: type) -> None:
    """Refuse what is not of the kind that a figure draws.

    Parameters
    ----------
    value : what came. kind : class of what is drawn.

    Raises
    ------
    ShapeError : it is of another kind; says where the right one comes from.
    """
    if not isinstance(value, kind):
        raise ShapeError(f"Expected {kind.__name__} to draw, got {shortened(value)}. {_MAKERS[kind.__name__]}.")

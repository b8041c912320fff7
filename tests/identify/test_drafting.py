"""A draft: what is not linear is settled, the rest are sums of blocks that can be left out."""

from __future__ import annotations

import numpy as np

from armlab.identify import base_parameters
from armlab.identify.dynamics import FitProblem, FitSettings, Progress, fit_of, fold_models, make_problem, model_of
from armlab.identify.record import prepare


def test_a_draft_is_linear_in_what_is_left(short_arm) -> None:
    told: list[str] = []
    robot = short_arm.robot
    tell: Progress = lambda done, total, what: told.append(what)  # noqa: E731
    job = FitSettings("torque model", "irls", 0, tell)
    draft = make_problem(prepare(short_arm.log(0, 3000), robot), robot, base_parameters(robot), job)
    assert isinstance(draft, FitProblem)
    assert "choosing the shape of friction" in told
    x = draft.sums.solution.x
    assert draft.design.free.any()
    assert len(x) == len(draft.theta) + np.count_nonzero(draft.design.free)
    assert np.array_equal(draft.gain_cov.shape, (2, 2))
    all_blocks = draft.sums.solve(np.ones(len(draft.sums.rows)))
    np.testing.assert_allclose(all_blocks, x, atol=1e-6 * np.abs(x).max())
    model = model_of(draft.design, x, draft.sums.solution.cov)
    folds = fold_models(model, draft.design, draft.sums, draft.block, draft.length)
    assert len(folds) == 5
    fit = fit_of(model, draft.design, draft.sums.solution, draft.sums.solution.cov, 3000)
    np.testing.assert_allclose(fit.cov, fit.formal_cov)
    assert (fit.value, fit.n) == (model, 3000)
    assert np.array_equal(np.sum([mask for _, mask in folds], axis=0), np.ones(3000))  # each sample is held out once
    assert len({fold.base_values.tobytes() for fold, _ in folds}) == 5

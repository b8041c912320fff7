"""Nonlinear least squares over manifolds, and errors in variables."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Measurement, NonlinearProblem, nonlinear_least_squares, total_least_squares
from armlab.estimation.linear_problem import student_factor
from armlab.estimation.nonlinear import descend
from armlab.lie import so3

SIGMA = 0.01


def curve(x: np.ndarray, y: np.ndarray, model) -> NonlinearProblem[np.ndarray]:
    def evaluate(b: np.ndarray) -> list[Measurement]:
        value, gradient = model(x, b)
        return [Measurement((value - y)[:, None], gradient[:, None, :], None, ("y",))]

    return NonlinearProblem(evaluate, lambda b, step: b + step)


def misra(x: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    decay = np.exp(-b[1] * x)
    return b[0] * (1 - decay), np.stack([1 - decay, b[0] * x * decay], axis=1)


def kowalik(x: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    up, down = x * x + x * b[1], x * x + x * b[2] + b[3]
    value = b[0] * up / down
    return value, np.stack([up / down, b[0] * x / down, -value * x / down, -value / down], axis=1)


MISRA = (
    [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0],
    [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78],
)
KOWALIK = (
    [4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625],
    [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246],
)


@pytest.mark.parametrize(("data", "model", "start", "certified", "sd", "noise"), [
    (MISRA, misra, [500, 1e-4], [2.3894212918e2, 5.5015643181e-4], [2.7070075241, 7.2668688436e-6], 0.1018787633),
    (KOWALIK, kowalik, [0.25, 0.39, 0.415, 0.39], [1.9280693458e-1, 1.9128232873e-1, 1.2305650693e-1, 1.3606233068e-1],
     [1.1435312227e-2, 1.9633220911e-1, 8.0842031232e-2, 9.0025542308e-2], 6.6279236551e-3),
], ids=["Misra1a, far", "MGH09"])  # fmt: skip
def test_certified_values_of_nist(data, model, start, certified, sd, noise) -> None:
    """NIST Statistical Reference Datasets, nonlinear regression: parameters, their SD, and the residual SD."""
    x, y = (np.array(part, dtype=float) for part in data)
    found = nonlinear_least_squares(curve(x, y, model), np.array(start, dtype=float))
    np.testing.assert_allclose(found.value, certified, rtol=1e-7)
    white = found.cov if found.formal_cov is None else found.formal_cov
    unsure = student_factor(np.array([float(len(start))]), np.array([float(len(x) - len(start))]))
    np.testing.assert_allclose(np.sqrt(np.diag(white) / unsure), sd, rtol=1e-5)
    assert found.sigma[0] == pytest.approx(noise, rel=1e-7)
    assert found.freedom == len(x) - len(start)


def rotations(R: np.ndarray, cov: np.ndarray | None) -> NonlinearProblem[np.ndarray]:
    """Mean of rotations: r = Log(X^T R_i), X [+] w = X Exp(w), J = -left_jacobian_inv(r)."""

    def evaluate(X: np.ndarray) -> list[Measurement]:
        r = so3.log(X.T @ R)
        return [Measurement(r, -so3.left_jacobian_inv(r), cov, ("R",) * 3)]

    return NonlinearProblem(evaluate, lambda X, w: X @ so3.exp(w), what="mean rotation")


def sampled(seed: int, N: int = 30) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = so3.exp(rng.standard_normal(3))
    return truth, truth @ so3.exp(SIGMA * rng.standard_normal((N, 3)))


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
def test_the_mean_of_rotations_has_an_honest_covariance(known: bool) -> None:
    nees, sigma = [], []
    for seed in range(60):
        truth, R = sampled(seed)
        found = nonlinear_least_squares(rotations(R, SIGMA**2 * np.eye(3) if known else None), R[0])
        error = so3.log(found.value.T @ truth)
        nees.append(error @ np.linalg.solve(found.cov, error) / 3)
        sigma.append(found.sigma[0])
    assert np.mean(nees) == pytest.approx(1.0, abs=0.25)  # two to three standard errors
    assert np.mean(sigma) == pytest.approx(SIGMA, rel=0.03)


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
@pytest.mark.parametrize("bad", [2, 9], ids=["5 %", "30 %"])
def test_outliers_are_flagged_and_do_not_count(bad: int, known: bool) -> None:
    for seed in range(5):
        truth, R = sampled(seed)
        R[:bad] = R[:bad] @ so3.exp(np.array([0.2, 0.1, 0.0]))
        cov = SIGMA**2 * np.eye(3) if known else None
        found = nonlinear_least_squares(rotations(R, cov), R[0], robust=True)
        assert found.outliers[:bad].all()
        assert found.outliers.sum() <= bad + 1
        assert found.squares.shape == (30,)
        clean = nonlinear_least_squares(rotations(R[~found.outliers], cov), R[-1])
        np.testing.assert_allclose(found.value, clean.value, atol=1e-7)
        np.testing.assert_allclose(found.cov, clean.cov, rtol=1e-3)
        error = so3.log(found.value.T @ truth)
        assert error @ np.linalg.solve(found.cov, error) < 20


def test_two_classes_of_noise_find_their_own_deviation() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((400, 2, 3))
    y = A @ [1.0, 2.0, 3.0] + rng.standard_normal((400, 2)) * [1e-3, 0.1]
    linear = NonlinearProblem(lambda x: [Measurement(A @ x - y, A, None, ("t", "R"))], lambda x, step: x + step)
    found = nonlinear_least_squares(linear, np.zeros(3))
    assert found.classes == ("t", "R")
    np.testing.assert_allclose(found.sigma, [1e-3, 0.1], rtol=0.1)
    weighted = np.linalg.lstsq((A / found.sigma[:, None]).reshape(-1, 3), (y / found.sigma).ravel(), rcond=None)[0]
    np.testing.assert_allclose(found.value, weighted, rtol=1e-6)


def test_noise_is_found_beside_a_part_that_is_known() -> None:
    """y = A x + noise with covariance sigma^2 I + S_i and known S_i: both the estimate and sigma are honest."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(25):
        A = rng.standard_normal((100, 2, 3))
        known = np.einsum("n,ij->nij", rng.uniform(0.0, 2.0, 100), np.array([[0.02, 0.01], [0.01, 0.02]]))
        y = A @ [1.0, 2.0, 3.0] + 0.1 * rng.standard_normal((100, 2))
        y += np.einsum("nij,nj->ni", np.linalg.cholesky(known), rng.standard_normal((100, 2)))

        def evaluate(x, A=A, y=y, known=known) -> list[Measurement]:
            return [Measurement(A @ x - y, A, None, ("y", "y"), added=known)]

        fit = nonlinear_least_squares(NonlinearProblem(evaluate, lambda x, step: x + step), np.zeros(3))
        e = fit.value - [1.0, 2.0, 3.0]
        found.append([fit.sigma[0], e @ np.linalg.solve(fit.cov, e) / 3])
    assert np.mean(found, axis=0) == pytest.approx([0.1, 1.0], rel=0.3)
    assert np.mean([one[0] for one in found]) == pytest.approx(0.1, rel=0.04)


def test_priors_hold_what_the_data_do_not_tell_and_are_no_samples() -> None:
    y = np.array([1.0, 1.1, 0.9])
    J = np.zeros((3, 1, 2))
    J[:, 0, 0] = 1.0

    def evaluate(x: np.ndarray) -> list[Measurement]:
        data = Measurement((x[0] - y)[:, None], J, np.eye(1) * 0.01, ("y",))
        return [data, Measurement((x - 0.5)[None], np.eye(2)[None], np.diag([4.0, 0.09]), ("p",) * 2, prior=True)]

    found = nonlinear_least_squares(NonlinearProblem(evaluate, lambda x, step: x + step), np.zeros(2), robust=True)
    assert found.value[1] == pytest.approx(0.5)
    assert found.cov[1, 1] == pytest.approx(0.09)
    assert found.value[0] == pytest.approx((3.0 / 0.01 + 0.5 / 4.0) / (3 / 0.01 + 1 / 4.0))
    assert found.outliers.shape == (3,)
    assert found.classes == ("y",)


def test_exact_data_and_too_few() -> None:
    truth, _ = sampled(0)
    R = np.repeat(truth[None], 5, axis=0)
    found = nonlinear_least_squares(rotations(R, None), np.eye(3))
    assert so3.angle(found.value, truth) < 1e-12
    with pytest.raises(NotExcited, match="at least 4 residuals to fit the mean rotation, got 3"):
        nonlinear_least_squares(rotations(R[:1], None), np.eye(3))


def test_a_start_that_is_near_is_not_left() -> None:
    """Two clusters: a loss that starts wide finds the larger one; a narrow loss stays at the one where it starts."""
    y = np.concatenate([np.zeros(60), np.ones(40)]) + SIGMA * np.random.default_rng(0).standard_normal(100)

    def evaluate(b: np.ndarray) -> list[Measurement]:
        return [Measurement((b - y)[:, None], np.ones((100, 1, 1)), np.array([SIGMA**2]), ("y",))]

    problem = NonlinearProblem(evaluate, lambda b, step: b + step)
    wide, narrow = (nonlinear_least_squares(problem, np.ones(1), robust=True, near=near) for near in (False, True))
    np.testing.assert_allclose([wide.value[0], narrow.value[0]], [0.0, 1.0], atol=0.01)
    assert wide.outliers[60:].all()
    assert narrow.outliers[:60].all()


def problem(residual, jacobian, **options) -> NonlinearProblem[np.ndarray]:
    def evaluate(x: np.ndarray) -> list[Measurement]:
        return [Measurement(residual(x)[:, None], jacobian(x)[:, None, :], np.eye(1), ("r",))]

    return NonlinearProblem(evaluate, lambda x, step: x + step, **options)


def rosenbrock() -> NonlinearProblem[np.ndarray]:
    return problem(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )


def test_rosenbrock_from_the_usual_start() -> None:
    found = descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2))
    np.testing.assert_allclose(found.value, 1.0, rtol=1e-9)
    assert np.all(np.diff(found.history) < 0)
    np.testing.assert_allclose(found.basis.T @ found.rows.J.T @ found.rows.J @ found.basis, np.eye(2), atol=1e-9)


def test_what_the_data_do_not_see_stays_and_is_reported() -> None:
    see = problem(lambda x: np.array([x[0] + 2 * x[1] - 5.0]), lambda x: np.array([[1.0, 2.0]]), scale=np.ones(2))
    found = descend(see, np.zeros(2), {}, np.ones(1))
    np.testing.assert_allclose(found.value, [1.0, 2.0])
    np.testing.assert_allclose(np.abs(found.null[:, 0]), np.array([2.0, 1.0]) / np.sqrt(5))
    assert found.basis.shape == (2, 1)


def test_iterations_end_with_the_best_value_and_history() -> None:
    with pytest.raises(NotConverged, match="after 3 iterations") as caught:
        descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2), iterations=3)
    assert caught.value.best.shape == (2,)
    assert len(caught.value.history) == 3
    loose = descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2), iterations=3, strict=False)
    np.testing.assert_array_equal(loose.value, caught.value.best)


def test_a_wrong_jacobian_does_not_pass_for_a_minimum() -> None:
    wrong = problem(lambda x: np.array([x[0] - 3.0, x[1]]), lambda x: -np.eye(2))
    with pytest.raises(NotConverged):
        descend(wrong, np.zeros(2), {}, np.ones(2))


TRUTH = np.array([1.5, -0.8, 0.4])


def rows(seed: int, n: int = 100, sigma: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Errors with the same standard deviation in two columns and in y; the third column is an offset."""
    rng = np.random.default_rng([3, seed])
    A = np.column_stack([rng.standard_normal((n, 2)), np.ones(n)])
    y = A @ TRUTH
    A[:, :2] += sigma * rng.standard_normal((n, 2))
    return A, y + sigma * rng.standard_normal(n)


def test_exact_rows() -> None:
    A, y = rows(0, sigma=0.0)
    for options in ({"exact": [2]}, {}, {"cov": np.diag([1.0, 1, 0, 1]) * 1e-4}):
        np.testing.assert_allclose(total_least_squares(A, y, **options).x, TRUTH, rtol=0, atol=1e-12)


def test_the_corrected_rows_agree_and_outliers_are_found() -> None:
    A, y = rows(1)
    found = total_least_squares(A, y, exact=[2])
    fixed = np.column_stack([A, y]) - found.corrections
    np.testing.assert_allclose(fixed @ np.append(found.x, -1.0), 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.corrections[:, 2], 0.0)
    assert found.sigma == pytest.approx(0.1, rel=0.2)
    A, y = rows(6, sigma=0.01)
    y[[3, 50]] += 2.0
    found = total_least_squares(A, y, cov=np.diag([1.0, 1, 0, 1]) * 1e-4, robust=True)
    assert np.flatnonzero(found.outliers).tolist() == [3, 50]


def test_weighted_is_plain_where_weights_are_equal() -> None:
    A, y = rows(2)
    plain = total_least_squares(A, y, exact=[2])
    one = np.diag([1.0, 1, 0, 1]) * plain.sigma**2
    for cov in (one, np.broadcast_to(one, (len(A), 4, 4))):
        found = total_least_squares(A, y, cov=cov)
        np.testing.assert_allclose(found.x, plain.x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.cov, plain.cov, rtol=1e-6)
        np.testing.assert_allclose(found.corrections, plain.corrections, atol=1e-9)
        assert found.sigma == pytest.approx(1.0)


def test_no_bias_and_honest_covariance() -> None:
    """With errors of a tenth of the signal, least squares is off by many SD, this fit is not. NEES/3 is 1."""
    found = [total_least_squares(*rows(seed), exact=[2]) for seed in range(100)]
    e = np.array([one.x - TRUTH for one in found])
    mean = np.linalg.inv(found[0].cov)
    assert e.mean(axis=0) @ mean @ e.mean(axis=0) * len(e) < 16.3  # 99.9 % of chi^2 with 3
    nees = np.mean([d @ np.linalg.solve(one.cov, d) / 3 for d, one in zip(e, found, strict=True)])
    assert 0.85 < nees < 1.2
    plain = np.array([np.linalg.lstsq(*rows(seed), rcond=None)[0] - TRUTH for seed in range(100)]).mean(axis=0)
    assert plain @ mean @ plain * len(e) > 50


def test_weighted_rows_of_their_own_covariance() -> None:
    errors, plain, nees = [], [], []
    for seed in range(60):
        rng = np.random.default_rng([4, seed])
        n = 60
        root = rng.standard_normal((n, 3, 3)) * rng.uniform(0.01, 0.1, (n, 1, 1))
        A = rng.standard_normal((n, 2))
        Z = np.column_stack([A, A @ TRUTH[:2]]) + np.einsum("nij,nj->ni", root, rng.standard_normal((n, 3)))
        cov = root @ np.swapaxes(root, 1, 2)
        found = total_least_squares(Z[:, :2], Z[:, 2], cov=cov)
        d = found.x - TRUTH[:2]
        errors.append(d @ d)
        nees.append(d @ np.linalg.solve(found.cov, d) / 2)
        other = total_least_squares(Z[:, :2], Z[:, 2]).x - TRUTH[:2]
        plain.append(other @ other)
    assert 0.8 < np.mean(nees) < 1.25
    assert np.sqrt(np.mean(errors) / np.mean(plain)) < 0.7


@pytest.mark.parametrize(("change", "error", "sentence"), [
    ({"A": np.ones((5, 3, 1))}, ShapeError, r"A \(N, p\)"),
    ({"y": np.ones(5)}, ShapeError, r"y \(N,\)"),
    ({"y": np.where(np.arange(100) == 7, np.nan, 1.0)}, ShapeError, "rows 7"),
    ({"A": np.ones((3, 3)), "y": np.ones(3)}, NotExcited, "more than 3 rows"),
    ({"A": np.ones((9, 2)), "y": np.arange(9.0)}, NotExcited, "x0 and x1|x1 and x0"),
    ({"exact": [5]}, ShapeError, "exact columns"),
    ({"names": ["a"]}, ShapeError, "3 names"),
    ({"robust": True}, ShapeError, "cov="),
    ({"cov": np.eye(3)}, ShapeError, "cov"),
    ({"cov": -np.eye(4)}, ShapeError, "positive semidefinite"),
    ({"cov": np.diag([1.0, 1, 1, 0])}, ShapeError, "variance of y"),
    ({"cov": np.eye(4), "exact": [2]}, ShapeError, "got both"),
])  # fmt: skip
def test_bad_input_is_refused(change: dict, error: type[Exception], sentence: str) -> None:
    A, y = rows(0)
    with pytest.raises(error, match=sentence):
        total_least_squares(**{"A": A, "y": y, **change})

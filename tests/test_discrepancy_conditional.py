"""The conditional Gaussian of an electrode given the others."""

import numpy as np

from biotac_mj.discrepancy.recordings.conditional import Components, Conditional


def test_residual_is_that_of_a_regression_on_all_others():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 3)) @ rng.standard_normal((3, 6)) + 0.3 * rng.standard_normal((4000, 6))
    given = Conditional(x.T @ x / len(x), np.zeros(6), 4)
    for k in range(4):
        others = np.delete(x, k, axis=1)
        w = np.linalg.lstsq(others, x[:, k], rcond=None)[0]
        np.testing.assert_allclose(given.residual(x)[:, k], x[:, k] - others @ w, atol=1e-9)
    np.testing.assert_allclose(given.noise, given.residual(x).std(0), rtol=1e-3)


def test_a_pattern_has_the_amplitude_that_was_added():
    """Generalised least squares: all of what lies along the pattern, and as little noise as may be."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((4000, 2)) @ rng.standard_normal((2, 5)) + 0.1 * rng.standard_normal((4000, 5))
    given, pattern, size = (
        Conditional(x.T @ x / len(x), np.zeros(5)),
        np.arange(1.0, 6),
        np.linspace(0, 1, 4000),
    )
    found = given.along(pattern, x + np.outer(size, pattern))
    assert (found - size).std() < (x @ pattern / (pattern @ pattern)).std()
    np.testing.assert_allclose(given.along(pattern, np.outer(size, pattern)), size, atol=1e-9)


def test_products_stay_within_those_of_the_rows_fitted():
    rng = np.random.default_rng(2)
    x = rng.standard_normal((500, 4)) * [3.0, 2.0, 1.0, 0.5]
    x -= x.mean(0)
    fitted = Components(x, 2)
    np.testing.assert_allclose(fitted.scores(x).std(0), 1)
    np.testing.assert_allclose(fitted.products(x).mean(0), 0, atol=1e-12)
    assert fitted.scores(100 * x).max() == fitted.scores(x).max()

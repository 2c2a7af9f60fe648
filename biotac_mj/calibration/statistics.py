"""Statistics of a fit's residual: covariance of the parameters, and a test of whiteness."""

import numpy as np

# statsmodels has both (S_hac_simple, acorr_ljungbox) but needs pandas, which nothing else here needs


def covariance(jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Covariance of least-squares parameters, for white residuals and for autocorrelated ones.

    Gauss-Newton for white residuals: s^2 (J^T J)^-1. For others the sandwich (J^T J)^-1 S (J^T J)^-1 with S
    the long-run covariance of the score J_t^T r_t after Newey and West (Econometrica 55, 1987): Bartlett
    weights, lag 4 (n/100)^(2/9) as in their 1994 rule, scaled by n/(n-p).

    Args:
      jacobian: (n, m, p) derivatives of m force components at n times.
      residual: (n, m).

    Returns:
      white (p, p), robust (p, p), lags.

    Raises:
      ValueError: no more numbers than parameters, or a parameter on which the forces do not depend.
    """
    n, m, p = jacobian.shape
    if n * m <= p or n <= p:
        raise ValueError(f"{n} samples do not identify {p} parameters: record more of the indentation")
    normal = np.einsum("tip,tiq->pq", jacobian, jacobian)
    scale = np.sqrt(np.diag(normal))
    if (scale == 0).any() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12:
        raise ValueError(
            "the forces do not identify the parameters: "
            "fit fewer, or use an indentation with more shear and sliding"
        )
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    score = np.einsum("tip,ti->tp", jacobian, residual)
    lags = min(n - 1, int(np.ceil(4 * (n / 100) ** (2 / 9))))
    total = score.T @ score
    for lag in range(1, lags + 1):
        cross = score[lag:].T @ score[:-lag]
        total += (1 - lag / (lags + 1)) * (cross + cross.T)
    white = (residual**2).sum() / (n * m - p) * inverse
    return white, n / (n - p) * inverse @ total @ inverse, lags


def ljung_box(residual: np.ndarray) -> dict:
    """Ljung-Box test (Biometrika 65, 1978) of the whiteness of a residual (n, m), per component.

    Returns:
      lags, a fifth of n but 10 at most; statistic (m,) and p_value (m,), nan for a component that is zero;
      white: whether no component's p-value is below 0.05 / m (Bonferroni).
    """
    residual = np.asarray(residual, float)
    n, m = residual.shape
    lags = min(10, n // 5)
    if not lags:
        raise ValueError(f"{n} samples are too few for the whiteness test: record at least 5 samples")
    from scipy.special import chdtrc  # scipy.stats takes a second to import

    centred = residual - residual.mean(0)
    power = (centred**2).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = (
            np.array([(centred[lag:] * centred[:-lag]).sum(0) for lag in range(1, lags + 1)]) / power
        )
    statistic = n * (n + 2) * (correlation**2 / (n - np.arange(1, lags + 1))[:, None]).sum(0)
    p_value = chdtrc(lags, statistic)
    return {"lags": lags, "statistic": statistic, "p_value": p_value, "white": not (p_value < 0.05 / m).any()}

"""Statistics of the residuals of a fit."""

import numpy as np
from jaxtyping import Float


def neighbour_correlation(residuals: Float[np.ndarray, "used"]) -> float:
    """Correlation of neighbouring residuals, outliers clipped; from -.95 to .95."""
    if residuals.size < 4 or np.ptp(residuals) == 0:
        return 0.0
    clipped = np.clip(residuals, *(np.median(residuals) + np.array([-3, 3]) * residuals.std()))
    centred = clipped - clipped.mean()
    correlation = float(np.dot(centred[1:], centred[:-1]) / np.dot(centred, centred))
    return min(max(correlation, -0.95), 0.95)


def correlation_factor(correlation: float) -> float:
    """Factor >= 1 by which correlated errors increase a standard error."""
    return float(np.sqrt((1 + correlation) / (1 - correlation))) if correlation > 0 else 1.0


def chi2_scale(residuals: Float[np.ndarray, "used"], num_parameters: int) -> float:
    """Scale of differences of chi^2: 1 for independent errors of the given size.

    Args:
        residuals: over their errors, of the best fit.
        num_parameters: of that fit.
    """
    reduced = float(np.sum(residuals**2)) / max(residuals.size - num_parameters, 1)
    return correlation_factor(neighbour_correlation(residuals)) ** 2 * max(reduced, 1.0)

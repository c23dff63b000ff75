"""Statistics of the residuals of a fit."""

from math import erfc, sqrt

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

FEWEST = 4
"""Residuals below which no correlation is estimated."""

OUTLIER = 3.0
"""Distance from the median, in standard deviations, beyond which a residual is clipped."""

STRONGEST = 0.95
"""Largest correlation that is taken over from an estimate."""


@eqx.filter_jit
def neighbour_correlation(
    residuals: Num[Array, "n"], used: Bool[Array, "n"] | None = None
) -> Float[Array, ""]:
    """Correlation of neighbouring residuals, outliers clipped; from -.95 to .95.

    Args:
        residuals: in the order of time.
        used: which of them count, by default those that are not 0.
    """
    used = residuals != 0 if used is None else used
    number = jnp.sum(used)
    packed = jnp.argsort(~used, stable=True)
    known = jnp.where(used, residuals, jnp.nan)[packed]
    spread = OUTLIER * jnp.nanstd(known)
    middle = jnp.nanmedian(known)
    clipped = jnp.clip(known, middle - spread, middle + spread)
    centred = jnp.nan_to_num(clipped - jnp.nanmean(clipped))
    square = jnp.sum(centred**2)
    enough = (number >= FEWEST) & (square > 0)
    correlation = jnp.sum(centred[1:] * centred[:-1]) / jnp.where(enough, square, 1.0)
    return jnp.clip(jnp.where(enough, correlation, 0.0), -STRONGEST, STRONGEST)


def runs_test(residuals: Num[np.ndarray, "n"]) -> tuple[int, float, float]:
    """Wald & Wolfowitz's test of the runs of one sign in a sequence.

    Of ``a`` positive and ``b`` negative residuals in random order, n in all, the number of runs has
    the mean ``m = 1 + 2 a b/n`` and the variance ``(m - 1)(m - 2)/(n - 1)``; it is taken for
    Gaussian.

    Args:
        residuals: in the order of time; those that are 0 do not count.

    Returns:
        The number of runs, m, and the probability of so few by chance; 1 for fewer than `FEWEST`
        residuals and where all have one sign.
    """
    positive = residuals[residuals != 0] > 0
    n, a = positive.size, int(np.sum(positive))
    number = int(np.sum(positive[1:] != positive[:-1])) + bool(n)
    mean = 1 + 2 * a * (n - a) / max(n, 1)
    variance = (mean - 1) * (mean - 2) / max(n - 1, 1)
    if n < FEWEST or variance <= 0:
        return number, mean, 1.0
    return number, mean, 0.5 * erfc((mean - number) / sqrt(2 * variance))


def correlation_factor(correlation: Float[Array, ""]) -> Float[Array, ""]:
    """Factor >= 1 by which correlated errors increase a standard error."""
    positive = jnp.maximum(correlation, 0.0)
    return jnp.sqrt((1 + positive) / (1 - positive))


@eqx.filter_jit
def chi2_scale(
    residuals: Num[Array, "n"], num_parameters: Int[Array, ""] | int
) -> Float[Array, ""]:
    """Scale of differences of chi^2: 1 for independent errors of the given size.

    Args:
        residuals: over their errors, of the best fit; 0 where a point is not used.
        num_parameters: of that fit.
    """
    degrees = jnp.maximum(jnp.sum(residuals != 0) - num_parameters, 1)
    reduced = jnp.sum(residuals**2) / degrees
    return correlation_factor(neighbour_correlation(residuals)) ** 2 * jnp.maximum(reduced, 1.0)

"""Standard errors that come from the scatter of a few replicas."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgran.checks.validation import number
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.residuals import neighbour_correlation

QUANTITIES = {
    "measurement": "temperature",
    "rotation": "rotational_temperature",
    "displacement": "displacement",
}
"""Fields of a curve that have errors, by the names of `jaxgran.fitting.comparison.Comparison`."""

POINTS_EACH = 6
"""Fewest points for each coefficient of the smooth course of an error."""

ITERATIONS = 60
"""Of the fit of that course, whose steps are at most 1 in the logarithm of a variance."""


def smooth_errors(
    curve: CoolingCurve, replicas: int
) -> tuple[CoolingCurve, dict[str, Float[Array, ""]]]:
    """The curve with errors that are smooth along it, and how many degrees of freedom they have.

    The relative variance of each point, from R replicas, has R - 1 degrees of freedom and scatters
    by ``sqrt(2/(R - 1))``: weights by it favour points that agree by chance. Its expectation is
    taken to be smooth, ``ln variance`` a parabola in the number of the point (a line or a constant
    for few points), fitted by maximum likelihood of the chi^2 distribution of the R - 1 degrees;
    all points together have ``(R - 1) n (1 - c)/(1 + c)`` degrees, c being the correlation of
    neighbours' variances, by which a chi^2 has the F distribution.

    Args:
        curve: with errors of means over the replicas; one without errors is returned as it is.
        replicas: R; with 1, errors are taken for known exactly.

    Returns:
        The curve, and the degrees of freedom of the errors by quantity; {} where they are exact.
    """
    if replicas < 2 or curve.temperature_error is None:
        return curve, {}
    smooth, degrees = {}, {}
    for name, field in QUANTITIES.items():
        values, error = getattr(curve, field), getattr(curve, f"{field}_error")
        if values is None or error is None:
            continue
        found = _smoothed(values, error, number(replicas))
        smooth[f"{field}_error"], degrees[name] = found
    return replace(curve, **smooth), degrees


@eqx.filter_jit
def _smoothed(
    values: Float[Array, "n"], error: Float[Array, "n"], replicas: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Smooth errors of values, and their degrees of freedom."""
    used = (values > 0) & (error > 0)
    share = jnp.where(used, error, 1.0) / jnp.where(used, values, 1.0)
    expected, own = _course(share**2, used)
    return jnp.where(used, values * jnp.sqrt(expected), 0.0), (replicas - 1) * jnp.maximum(own, 1.0)


def _course(
    variance: Float[Array, "n"], used: Bool[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """The expectation of variances along a curve, and the number of independent points."""
    place = jnp.linspace(-1.0, 1.0, variance.size, dtype=variance.dtype)
    powers = min(2, variance.size // POINTS_EACH - 1)
    design = jnp.stack([place**k for k in range(max(powers, 0) + 1)], axis=1)
    onto = jnp.linalg.pinv(design * used[:, None])

    def step(_, coefficients: Array) -> Array:
        excess = jnp.where(used, variance * jnp.exp(-design @ coefficients) - 1, 0.0)
        return coefficients + jnp.clip(onto @ excess, -1.0, 1.0)

    number = jnp.maximum(jnp.sum(used), 1)
    mean = jnp.sum(jnp.where(used, variance, 0.0)) / number
    tiny = jnp.finfo(variance.dtype).tiny
    first = jnp.zeros(design.shape[1], variance.dtype).at[0].set(jnp.log(jnp.maximum(mean, tiny)))
    expected = jnp.exp(design @ jax.lax.fori_loop(0, ITERATIONS, step, first))
    correlation = jnp.maximum(neighbour_correlation(variance / expected - 1, used), 0.0)
    return expected, number * (1 - correlation) / (1 + correlation)

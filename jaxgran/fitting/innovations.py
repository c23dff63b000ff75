"""The residuals of a measured curve, relative to a computed one, and their innovations."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.fitting.kalman import Nodes, filtered
from jaxgran.fitting.rows import Noise, Observed
from jaxgran.scene.gas import Gas

LOG_FROM = 10.0
"""T over its error above which ln T is compared."""

LINEAR_TO = 5.0
"""T over its error below which T itself is compared."""

LOG_RATIO_FROM = 0.5
"""Measured over computed value below which ln is continued by its tangent."""


class Innovations(NamedTuple):
    """Residuals of measured values minus what is expected from all values before them.

    `innovations` returns arrays of the shape (nodes, 2, gases).

    Attributes:
        values: innovations of T and of T_rot, relative; 0 where nothing is used.
        variances: of them.
        density_changes: what -2 ln L gains where T is compared in place of ln T
            (`log_density_change`).
    """

    values: Any
    variances: Any
    density_changes: Any


def innovations(
    gas: Gas,
    nodes: Nodes,
    log_computed: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    observed: Observed,
    noise: Noise,
) -> Innovations:
    """Return the innovations of a measured curve about some gases.

    Args:
        gas, nodes, sensitivity: see `jaxgran.fitting.kalman.filtered`.
        log_computed: ln T and ln T_rot with which the measured values are compared.
        observed: the measured values.
        noise: what makes them scatter; its `inverse_number` and `white` have the shape (gases,).
    """
    values = observed.values[..., None]
    errors = observed.errors[..., None]
    column = log_ratio(values, log_computed, errors)[:, :, None]
    variances = (errors / jnp.exp(log_computed)) ** 2 + observed.simulation[..., None]
    variances = variances.at[:, 0].add(noise.white[None] ** 2)  # of T alone
    found = filtered(gas, nodes, column, variances, sensitivity, observed.used, noise)
    changes = log_density_change(values, log_computed, errors)
    return Innovations(found.values[:, :, 0], found.variances, changes)


def log_ratio(values: Array, log_computed: Array, errors: Array) -> Array:
    """Return the residual of a measured value, relative to the computed one.

    It is ln(measured/computed) where the computed value is many errors above 0, and their
    difference over the computed value where it is within some errors of 0; in between a mean of
    both, so that it is continuous. The choice is by the computed value alone: one by the measured
    value would favour large ones.
    """
    ratio = values / jnp.exp(log_computed)
    # Continued to small and negative ratios by its tangent.
    tangent = jnp.log(LOG_RATIO_FROM) + ratio / LOG_RATIO_FROM - 1
    log = jnp.log(jnp.maximum(ratio, LOG_RATIO_FROM))
    log = jnp.where(ratio > LOG_RATIO_FROM, log, tangent)
    share = _share_of_log(log_computed, errors)
    return jnp.where(share < 1, share * log + (1 - share) * (ratio - 1), log)


def log_density_change(values: Array, log_computed: Array, errors: Array) -> Array:
    """Return what -2 ln L gains as `log_ratio` is not everywhere ln of the measured value.

    It is ``-2 ln(y df/dy)`` for the residual f of a value y, 0 where f is ln y: the density of y is
    the density of f times df/dy. Where y is below its error, the error replaces the first y, which
    no parameter changes.
    """
    ratio = values / jnp.exp(log_computed)
    share = _share_of_log(log_computed, errors)
    slope = share / jnp.maximum(ratio, LOG_RATIO_FROM) + 1 - share
    y = jnp.where(values > errors, values, errors)
    is_log = (share == 1) & (ratio >= LOG_RATIO_FROM)
    change = -2 * (jnp.log(jnp.where(is_log, 1.0, y * slope)) - log_computed)
    return jnp.where(is_log, 0.0, change)


def _share_of_log(log_computed: Array, errors: Array) -> Array:
    """Return 1 where logarithms are compared, 0 where values are."""
    distance = jnp.exp(log_computed) / jnp.where(errors > 0, errors, jnp.finfo(errors.dtype).tiny)
    share = jnp.clip((distance - LINEAR_TO) / (LOG_FROM - LINEAR_TO), 0.0, 1.0)
    return share**2 * (3 - 2 * share)

"""Tables of averages over impacts at the temperatures that a gas reaches.

Units are the same as in `jaxgran.theory.averages`.
"""

from collections.abc import Callable
from functools import cache, partial
from math import pi, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.laws import ReducedLaw
from jaxgran.theory.averages import mean_inelasticity
from jaxgran.theory.elements import ElementBounds


class RateTable(eqx.Module):
    """Averages over the impacts of one gas (`impact_moments`) as a Chebyshev series in ln T.

    The averages are smooth in ln T, so that a few quadratures in advance replace one in every
    stage of the ODE solver.

    Attributes:
        coefficients: of the Chebyshev polynomials, shape (nodes, rows, terms), or (nodes, ...,
            rows, terms) for several such functions over the same range.
        lowest: lower end of the series in ln(T/T_0). The series must not be evaluated outside.
        highest: upper end, 0 unless the gas is heated.
    """

    coefficients: Float[Array, "nodes ... rows terms"]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]

    @classmethod
    def from_function(
        cls,
        averages: Callable[[Float[Array, ""]], Float[Array, "rows terms"]],
        lowest: Float[Array, ""],
        highest: Float[Array, ""],
        num_nodes: int,
    ) -> "RateTable":
        """Return the series in a range of temperatures.

        Args:
            averages: the function to be tabulated, of sqrt(T/T_0).
            lowest, highest: ends of ln(T/T_0), see `log_temperature_range`.
            num_nodes: number of terms; see `ReducedLaw.num_nodes`.
        """
        nodes, to_coefficients = (jnp.asarray(x, lowest.dtype) for x in _chebyshev(num_nodes))
        speeds = jnp.exp(highest / 2 + (lowest - highest) * (1 - nodes) / 4)
        values = jax.vmap(averages)(speeds)
        return cls(jnp.tensordot(to_coefficients, values, 1), lowest, highest)

    def __call__(self, log_theta: Float[Array, ""]) -> Float[Array, "... rows terms"]:
        """Return the averages at ln(T/T_0), as the tabulated function returns them.

        Args:
            log_theta: ln(T/T_0), from `lowest` to `highest`.
        """
        x = 2 * (1 - (log_theta - self.highest) / (self.lowest - self.highest)) - 1
        if self.coefficients.ndim > 3:  # a matrix product is faster for many functions
            polynomials = [jnp.ones_like(x), x]
            for _ in range(2, len(self.coefficients)):
                polynomials.append(2 * x * polynomials[-1] - polynomials[-2])
            return jnp.tensordot(jnp.stack(polynomials), self.coefficients, 1)
        # Clenshaw's recurrence, from the highest term down.
        last = jnp.zeros_like(self.coefficients[0])
        before = last
        for row in self.coefficients[:0:-1]:
            last, before = row + 2 * x * last - before, last
        return self.coefficients[0] + x * last - before

    def with_slopes(self, slopes: Float[Array, "directions nodes rows terms"]) -> "RateTable":
        """Return the function, its slope and its derivatives as one function of ln(T/T_0).

        Args:
            slopes: coefficients of the derivatives of the function in some directions.

        Returns:
            A table of shape (2 + directions, rows, terms) at each temperature: the function, its
            derivative in ln(T/T_0), and those given.
        """
        derivative = jnp.asarray(_derivative_matrix(len(self.coefficients)), self.lowest.dtype)
        width = self.highest - self.lowest
        slope = jnp.tensordot(derivative, self.coefficients, 1) * 2 / width
        function_and_slope = jnp.stack([self.coefficients, slope], axis=1)
        derivatives = jnp.moveaxis(slopes, 0, 1)
        coefficients = jnp.concatenate([function_and_slope, derivatives], 1)
        return RateTable(coefficients, self.lowest, self.highest)


@cache
def _chebyshev(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev nodes in [-1, 1], and the matrix from values at them to coefficients."""
    angles = (np.arange(num_nodes) + 0.5) * pi / num_nodes
    matrix = 2 / num_nodes * np.cos(np.outer(np.arange(num_nodes), angles))
    matrix[0] /= 2
    return np.cos(angles), matrix


@cache
def _derivative_matrix(num_nodes: int) -> np.ndarray:
    """Matrix that takes the coefficients of a Chebyshev series to its derivative."""
    return np.pad(np.polynomial.chebyshev.chebder(np.eye(num_nodes)), ((0, 1), (0, 0)))


_SCAN_POINTS = 16
"""Temperatures at which the cooling rate is computed to determine the range of a `RateTable`."""


def log_temperature_range(
    law: ReducedLaw,
    duration: Float[Array, ""],
    dimension: int,
    bounds: ElementBounds,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return bounds of ln(T/T_0) within a reduced time; they have no derivatives.

    The lower bound is negative, and not far below the lowest value. The upper bound is 0, or
    positive where the gas is heated.

    The first lower bound is Haff's law for e = 0 with 10 % added to the rate. A law with small
    losses at low speed cools much less; a series over the whole range would lose digits. Therefore
    the time to cool is bounded from below by integrating the law's rate, with 10 % added, over
    `_SCAN_POINTS` temperatures, and the range is cut off one point below the temperature reached.

    The first upper bound has no losses, ``T_0 + xi_0^2 t`` and the whole energy of rotation. Smooth
    spheres do not heat up beyond the temperature at which their impacts take the power of the
    drive, with half of the losses to spare for a_2 and soft contacts; the range is cut off one of
    `_SCAN_POINTS` temperatures above it.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        duration: reduced time.
        dimension: d.
        bounds: of the cooling and the heating by the elements of the scene, see `element_bounds`.
    """
    law, duration, bounds = jax.lax.stop_gradient((law, duration, bounds))
    collisions = sphere_surface(dimension) / sqrt(2 * pi)

    def scan_to(end: Array) -> tuple[Array, Array, Array]:
        """ln(T/T_0) from 0 to an end, sqrt(T/T_0), and the loss of energy over sqrt(T/T_0)."""
        log_theta = end * jnp.linspace(0, 1, _SCAN_POINTS, dtype=end.dtype)
        speeds = jnp.exp(log_theta / 2)
        losses = collisions / 2 * jax.vmap(partial(mean_inelasticity, law))(speeds)
        return log_theta, speeds, losses

    fastest = 1.1 * collisions / (2 * dimension) + bounds.cooling_over_speed / 2
    lowest = -2 * jnp.log1p(fastest * duration) - bounds.constant_cooling * duration
    log_theta, speeds, losses = scan_to(lowest)
    rate = 2.2 / dimension * losses * speeds
    rate = rate + bounds.cooling_over_speed * speeds + bounds.constant_cooling
    if bounds.heating is not None:
        rate = rate - bounds.heating / speeds**2
    rate = jnp.maximum(rate, jnp.finfo(rate.dtype).tiny)
    earliest = jnp.cumsum(-jnp.diff(log_theta) / jnp.maximum(rate[1:], rate[:-1]))
    reached = jnp.min(jnp.where(earliest < duration, log_theta[1:], 0.0))
    lowest = jnp.minimum(jnp.maximum(reached + log_theta[1], lowest), -1e-3)
    if bounds.heating is None:
        return lowest, jnp.zeros_like(lowest)
    energy_gain = 0.0 if bounds.energy_gain is None else bounds.energy_gain
    highest = jnp.log1p(bounds.heating * duration + energy_gain)
    if bounds.energy_gain is None:
        log_theta, speeds, losses = scan_to(highest)
        is_balanced = losses / dimension * speeds >= bounds.heating / speeds**2
        balance = jnp.min(jnp.where(is_balanced, log_theta, highest))
        highest = jnp.minimum(highest, balance + log_theta[1])
    return lowest, jnp.maximum(highest, 1e-3)

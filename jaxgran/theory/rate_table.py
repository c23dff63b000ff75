"""A table of the averages over impacts for the temperatures that a gas reaches.

Units as in `jaxgran.theory.averages`.
"""

from collections.abc import Callable
from functools import cache
from math import pi, sqrt
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.geometry import sphere_surface

_SCAN_POINTS = 16
"""Temperatures at which the cooling rate is computed to find the ends of a `RateTable`."""


@cache
def _chebyshev(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev nodes in [-1, 1], and the matrix from values at them to coefficients."""
    angles = (np.arange(num_nodes) + 0.5) * pi / num_nodes
    matrix = 2 / num_nodes * np.cos(np.outer(np.arange(num_nodes), angles))
    matrix[0] /= 2
    return np.cos(angles), matrix


@cache
def _derivative(num_nodes: int) -> np.ndarray:
    """Matrix from the coefficients of a Chebyshev series to those of its derivative."""
    return np.pad(np.polynomial.chebyshev.chebder(np.eye(num_nodes)), ((0, 1), (0, 0)))


class Bounds(NamedTuple):
    """Bounds of what the elements of a scene do to T, from which a `RateTable` takes its range.

    Attributes:
        by_speed: an upper bound of a part of ``-d ln T/dt`` over sqrt(T/T_0).
        constant: of a part that does not depend on T.
        heating: d(T/T_0)/dt by a drive; None where nothing heats.
        rotation: T/T_0 that a gas could gain from the spins; None of smooth spheres.
    """

    by_speed: ArrayLike = 0.0
    constant: ArrayLike = 0.0
    heating: ArrayLike | None = None
    rotation: ArrayLike | None = None


NO_ELEMENTS = Bounds()
"""Of smooth spheres without walls, drag and drive."""


class RateTable(eqx.Module):
    """The function `averages` of one gas as a Chebyshev series in ln T.

    The averages are smooth in ln T, so that a few quadratures in advance replace one in every
    stage of the ODE solver.

    Attributes:
        coefficients: of the Chebyshev polynomials, shape (nodes, rows, terms), or (nodes, ...,
            rows, terms) for several such functions over the same range.
        lowest: lower end of the series in ln(T/T_0). The series must not be evaluated outside.
        highest: the upper end of a gas that is heated; None is 0.
    """

    coefficients: Float[Array, "nodes ... rows terms"]
    lowest: Float[Array, ""]
    highest: Float[Array, ""] | None = None

    @classmethod
    def of(
        cls,
        averages: Callable[[Float[Array, ""]], Float[Array, "rows terms"]],
        duration: Float[Array, ""],
        dimension: int,
        num_nodes: int,
        bounds: Bounds = NO_ELEMENTS,
    ) -> "RateTable":
        """The series for all temperatures that a gas reaches in a given time.

        Args:
            averages: the function to be tabulated, of sqrt(T/T_0).
            duration: reduced time.
            dimension: d.
            num_nodes: number of terms; see `ReducedLaw.num_nodes`.
            bounds: of what the elements of the scene do to T.
        """
        lowest = _lowest_log_temperature(averages, duration, dimension, bounds)
        nodes, to_coefficients = (jnp.asarray(x, lowest.dtype) for x in _chebyshev(num_nodes))
        if bounds.heating is None:
            highest, speeds = None, jnp.exp(lowest * (1 - nodes) / 4)
        else:
            highest = _highest_log_temperature(
                averages, duration, dimension, bounds.heating, bounds.rotation
            )
            speeds = jnp.exp(highest / 2 + (lowest - highest) * (1 - nodes) / 4)
        values = jax.vmap(averages)(speeds)
        return cls(jnp.tensordot(to_coefficients, values, 1), lowest, highest)

    def __call__(self, log_theta: Float[Array, ""]) -> Float[Array, "... rows terms"]:
        """The averages at ln(T/T_0), as the function `averages` returns them.

        Args:
            log_theta: ln(T/T_0), from `lowest` to `highest`.
        """
        if self.highest is None:
            x = 2 * (1 - log_theta / self.lowest) - 1
        else:
            x = 2 * (log_theta - self.lowest) / (self.highest - self.lowest) - 1
        if self.coefficients.ndim > 3:  # of many functions a product with a matrix is faster
            polynomials = [jnp.ones_like(x), x]
            for _ in range(2, len(self.coefficients)):
                polynomials.append(2 * x * polynomials[-1] - polynomials[-2])
            return jnp.tensordot(jnp.stack(polynomials), self.coefficients, 1)
        # Clenshaw's recurrence, from the highest term down.
        last = before = jnp.zeros_like(self.coefficients[0])
        for row in self.coefficients[:0:-1]:
            last, before = row + 2 * x * last - before, last
        return self.coefficients[0] + x * last - before

    def with_slopes(self, along: Float[Array, "directions nodes rows terms"]) -> "RateTable":
        """This function of one gas, its slope and its derivatives as one function of ln(T/T_0).

        Args:
            along: coefficients of the derivatives of the function in some directions.

        Returns:
            A table of shape (2 + directions, rows, terms) at each temperature: the function, its
            derivative in ln(T/T_0), and those given.
        """
        derivative = jnp.asarray(_derivative(len(self.coefficients)), self.lowest.dtype)
        width = -self.lowest if self.highest is None else self.highest - self.lowest
        slope = jnp.tensordot(derivative, self.coefficients, 1) * 2 / width
        both = jnp.stack([self.coefficients, slope], axis=1)
        further = jnp.moveaxis(along, 0, 1)
        return RateTable(jnp.concatenate([both, further], 1), self.lowest, self.highest)


def _lowest_log_temperature(
    averages: Callable[[Float[Array, ""]], Float[Array, "rows terms"]],
    duration: Float[Array, ""],
    dimension: int,
    bounds: Bounds,
) -> Float[Array, ""]:
    """A lower bound of ln(T/T_0) after a reduced time, negative and not far below the true value.

    The first bound is Haff's law for e = 0 with 10 % added to the rate. A law with small losses at
    low speed cools much less; a series over the whole range would lose digits. Therefore the time
    to cool is bounded from below by integrating the law's own rate, with 10 % added, over
    `_SCAN_POINTS` temperatures, and the range is cut off one point below what is reached.
    """
    duration, bounds = jax.lax.stop_gradient((duration, bounds))
    by_speed, constant = bounds.by_speed, bounds.constant
    collisions = sphere_surface(dimension) / sqrt(2 * pi)
    haff = 1.1 * collisions / (2 * dimension) + by_speed / 2
    bound = -2 * jnp.log1p(haff * duration) - constant * duration
    scan = bound * jnp.linspace(0, 1, _SCAN_POINTS, dtype=bound.dtype)
    speeds = jnp.exp(scan / 2)
    loss = jax.lax.stop_gradient(jax.vmap(averages)(speeds)[:, 0, 0])
    rate = 2.2 / dimension * loss * speeds + by_speed * speeds + constant
    if bounds.heating is not None:
        rate = rate - bounds.heating / speeds**2
    rate = jnp.maximum(rate, jnp.finfo(bound.dtype).tiny)
    earliest = jnp.cumsum(-jnp.diff(scan) / jnp.maximum(rate[1:], rate[:-1]))
    reached = jnp.min(jnp.where(earliest < duration, scan[1:], 0.0))
    lowest = reached + scan[1]
    return jnp.minimum(jnp.maximum(lowest, bound), -1e-3)


def _highest_log_temperature(
    averages: Callable[[Float[Array, ""]], Float[Array, "rows terms"]],
    duration: Float[Array, ""],
    dimension: int,
    heating: ArrayLike,
    rotation: ArrayLike | None,
) -> Float[Array, ""]:
    """An upper bound of ln(T/T_0) of a driven gas within a reduced time, positive.

    The first bound has no losses, ``T_0 + xi_0^2 t`` and all the heat of rotation. Smooth spheres
    are not heated beyond the temperature at which their impacts, with half of the losses to spare
    for a_2 and soft contacts, take what the drive gives; the range is cut off one of `_SCAN_POINTS`
    temperatures above it.
    """
    duration, heating, rotation = jax.lax.stop_gradient((duration, heating, rotation))
    bound = jnp.log1p(heating * duration + (0.0 if rotation is None else rotation))
    if rotation is None:
        scan = bound * jnp.linspace(0, 1, _SCAN_POINTS, dtype=bound.dtype)
        speeds = jnp.exp(scan / 2)
        loss = jax.lax.stop_gradient(jax.vmap(averages)(speeds)[:, 0, 0])
        balanced = loss / dimension * speeds >= heating / speeds**2
        stop = jnp.min(jnp.where(balanced, scan, bound))
        bound = jnp.minimum(bound, stop + scan[1])
    return jnp.maximum(bound, 1e-3)

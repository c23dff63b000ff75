"""Gases whose spheres differ in size: rates of cooling and of exchange, and their noise.

The distribution of diameters is represented by two halves, of diameters ``sigma (1 - s)`` and
``sigma (1 + s)``, which have its mean and its standard deviation ``s sigma``. All results are
correct to second order in s for any distribution, and to all orders for two sizes in equal numbers.
All spheres consist of one material: masses are in proportion to the cubes of diameters.

Each half is Maxwellian and has its own mean square velocity ``d T_1`` and ``d T_2``, with ``T =
(T_1 + T_2)/2``. The second variable is ``q = ln(T_1/T_2)``; it is 0 at t = 0, where small and large
spheres are equally fast, and grows within some collisions. Equipartition would be ``T_1/T_2 =
m_2/m_1``; inelastic spheres stay near it. While energy passes from large to small spheres T grows
even where impacts lose nothing, since T is not the energy: see `energy_ratio`.

Spheres of the kinds i and j meet ``n_j g_ij sigma_ij^(d-1) S_d sqrt((T_i + T_j)/(2 pi))`` times per
time and sphere i, at normal speeds u with the density ``u exp(-u^2/(2 w))``, ``w = T_i + T_j``.
Given u the normal velocity of sphere i is Gaussian with the mean ``(T_i/w) u`` and the variance
``T_i T_j/w``. With ``a_i = m_j/(m_i + m_j)`` and ``k = 1 + eps`` an impact changes v_i^2 by

    Delta_i = (a_i^2 k^2 - 2 a_i k T_i/w) u^2 - 2 a_i k u xi,    xi Gaussian, <xi^2> = T_i T_j/w,

and v_j^2 likewise with ``+ 2 a_j k u xi``: the deviation xi of the velocity of the centre exchanges
energy between the two. Equal spheres of the same effective radius and mass have the same eps.

Reference: Garzo & Dufty, Phys. Rev. E 60, 5706 (1999), for mixtures of constant restitution.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.reduced import PAIRS, ReducedSizes
from jaxgran.theory.averages import collision_rate, loss_nodes

_MEMBERS = np.array([[[1, 1], [0, 0]], [[1, 0], [0, 1]], [[0, 0], [1, 1]]], float)
"""For each of `PAIRS` the sums over small and over large spheres of the two changes."""


class PairRates(NamedTuple):
    """Sums over the impacts of a unit of reduced time, per particle.

    Attributes:
        changes: of Delta over small and over large spheres, over T.
        squares: of the products of these two sums in each impact, over T^2.
        impacts: number of impacts.
    """

    changes: Float[Array, "2"]
    squares: Float[Array, "2 2"]
    impacts: Float[Array, ""]


def partial_temperatures(ratio: Float[Array, "..."]) -> Float[Array, "2 ..."]:
    """Return T_1/T and T_2/T of small and large spheres, from ``q = ln(T_1/T_2)``."""
    half = jnp.tanh(ratio / 2)
    return jnp.stack([1 + half, 1 - half])


def energy_ratio(spread: ArrayLike, ratio: ArrayLike) -> Float[Array, "..."]:
    """Return the temperature by the energy, ``<m v^2>/(d <m>)``, over ``T = <v^2>/d``.

    Args:
        spread: s.
        ratio: q, any shape.
    """
    spread = jnp.asarray(spread)
    ratio = jnp.asarray(ratio)
    return 1 - spread * (3 + spread**2) / (1 + 3 * spread**2) * jnp.tanh(ratio / 2)


def energy_slope(spread: ArrayLike, ratio: ArrayLike) -> Float[Array, "..."]:
    """Return the derivative of the logarithm of `energy_ratio` in q."""
    spread = jnp.asarray(spread)
    ratio = jnp.asarray(ratio)
    change = spread * (3 + spread**2) / (1 + 3 * spread**2) / (2 * jnp.cosh(ratio / 2) ** 2)
    return -change / energy_ratio(spread, ratio)


def pair_rates(
    sizes: ReducedSizes,
    speed: Float[Array, ""],
    ratio: Float[Array, ""],
    sonine: Any,
    d: int,
) -> PairRates:
    """Return the changes by impacts of two sizes.

    Args:
        sizes: in reduced units.
        speed: sqrt(T/T_0).
        ratio: q.
        sonine: a_2 of each size, in the distribution of normal speeds.
        d: dimension.
    """
    T = partial_temperatures(ratio)
    masses = sizes.masses
    pairs = np.array(PAIRS)
    g, weights = loss_nodes(speed)
    weights = weights * (1 + sonine / 16 * (g**2 * (g**2 - 6) + 3))

    def of_pair(law: Any, pair: Array) -> tuple[Array, Array, Array]:
        own = T[pair]
        mass = masses[pair]
        variance = jnp.sum(own)
        a = mass[::-1] / jnp.sum(mass)
        share = own / variance
        powers = law.loss_powers(g * jnp.sqrt(variance / 2) * speed, 4)
        # Delta_i/u^2 in powers of the loss 1 - eps: 0 for elastic impacts of equal spheres.
        mean = jnp.stack([4 * a * (a - share), 2 * a * (share - 2 * a), a**2])
        square = jnp.zeros((5, 2, 2), mean.dtype)
        for i in range(3):
            for j in range(3):
                square = square.at[i + j].add(jnp.outer(mean[i], mean[j]))
        moments = powers @ weights
        changes = variance * (moments[:3] @ mean)
        squares = variance**2 * jnp.tensordot(powers @ (weights * g**2), square, 1)
        kick = 4 * moments[0] - 4 * moments[1] + moments[2]  # <(1 + eps)^2 u^2>
        opposite = a * jnp.array([1.0, -1.0])
        exchanged = 4 * own[0] * own[1] * kick * jnp.outer(opposite, opposite)
        return changes, squares + exchanged, jnp.sqrt(variance / 2)

    changes, squares, faster = jax.vmap(of_pair)(sizes.laws, jnp.asarray(pairs))
    rates = sizes.frequency * faster * collision_rate(0.0, d) * speed
    members = jnp.asarray(_MEMBERS, rates.dtype)
    changes = jnp.einsum("k,kij,kj->i", rates, members, changes)
    squares = jnp.einsum("k,kij,kjl,kml->im", rates, members, squares, members)
    return PairRates(changes, squares, jnp.sum(rates))


def equal_rates(law: Any, speed: Float[Array, ""], sonine: Any, d: int) -> Float[Array, ""]:
    """Return ``d ln T/dt`` of equal spheres, by the same quadrature as `pair_rates`."""
    g, weights = loss_nodes(speed)
    weights = weights * (1 + sonine / 16 * (g**2 * (g**2 - 6) + 3))
    _, one, two = law.loss_powers(g * speed, 2)
    return -collision_rate(0.0, d) * speed / (2 * d) * jnp.sum(weights * (2 * one - two))


def variable_changes(ratio: Float[Array, ""], d: int) -> Float[Array, "2 2"]:
    """Return the changes of ln T and of q by a change of v^2/T of small and of large spheres, times
    the number of particles."""
    T = partial_temperatures(ratio)
    of_T = jnp.full(2, 1 / d, T.dtype)
    return jnp.stack([of_T, 2 / d * jnp.array([1.0, -1.0]) / T])


def drag_factors(sizes: ReducedSizes) -> Float[Array, "2"]:
    """Return the drag rates of small and large spheres over the rate of the mean diameter.

    By Stokes' law the rate is inversely proportional to the square of the diameter.
    """
    return sizes.masses ** (-2 / 3)

"""Geometry of equal spheres: surface, mass, packing, and the pair correlation at contact.

Averages over the normal speeds of the impacts in a gas.
"""

from collections.abc import Callable
from math import gamma, pi

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import POSITIVE, UserNumber, number


def _quadrature(num_nodes: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes g and weights for ``int_0^inf g exp(-g^2/2) f(g) dg``.

    Gauss-Legendre in sqrt(g), since laws of restitution are smooth in small powers of g. The
    integral beyond `top` is neglected.
    """
    x, w = np.polynomial.legendre.leggauss(num_nodes)
    root = (x + 1) / 2
    g = top * root**2
    return g, w * top * root * g * np.exp(-(g**2) / 2)


NODES, WEIGHTS = _quadrature(num_nodes=32, top=9.0)
"""Normal speeds g in units of sqrt(2 T), and their weights."""


def impact_average(function: Callable[[Array], Array], like: Float[Array, ""]) -> Float[Array, ""]:
    """``int_0^inf g exp(-g^2/2) f(g) dg``, the average over the normal speeds of impacts.

    Args:
        function: f, of an array of g.
        like: a number of the precision that is wanted.
    """
    nodes, weights = (jnp.asarray(x, like.dtype) for x in (NODES, WEIGHTS))
    return jnp.sum(weights * function(nodes))


CLOSE_PACKING = {2: pi / (2 * 3**0.5), 3: pi / (3 * 2**0.5)}
"""Packing fraction of the densest packing of equal disks (2) and of equal spheres (3)."""


def sphere_surface(dimension: int) -> float:
    """Surface area of the unit sphere in d dimensions, ``S_d = 2 pi^(d/2) / Gamma(d/2)``."""
    return 2 * pi ** (dimension / 2) / gamma(dimension / 2)


def sphere_mass(diameter: UserNumber, density: UserNumber) -> Float[Array, "..."]:
    """Mass of a solid sphere, ``m = pi density diameter^3 / 6``.

    Args:
        diameter: sigma, m, > 0, any shape.
        density: of the material, kg/m^3, > 0, same shape or a scalar.

    Returns:
        m, kg.

    Raises:
        ValueError: for a value that is not positive or not a number.

    >>> f"{float(jaxgran.sphere_mass(2e-3, 2500.0)):.3g} kg"
    '1.05e-05 kg'
    """
    POSITIVE.check("diameter", diameter, "Give the diameter in metres.")
    POSITIVE.check("density", density, "Give the density of the material in kg/m^3.")
    return pi / 6 * number(density) * number(diameter) ** 3


def side_of_box(
    num_particles: Float[Array, ""], number_density: Float[Array, "..."], dimension: int
) -> Float[Array, "..."]:
    """Side of the cube (of the square if d = 2) of N particles of a number density."""
    return (num_particles / number_density) ** (1 / dimension)


def contact_value(packing_fraction: ArrayLike, dimension: int) -> Float[Array, "..."]:
    """Equilibrium pair correlation function at contact, ``g_2(sigma)``.

    ``(2 - phi) / (2 (1 - phi)^3)`` in three dimensions (Carnahan & Starling 1969),
    ``(1 - 7 phi/16) / (1 - phi)^2`` in two (Henderson 1975). It tends to 1 for a dilute gas.

    Args:
        packing_fraction: phi, any shape; the formulae hold in the fluid, for phi below about 0.5
            (3D) or 0.7 (2D).
        dimension: d, 2 or 3.

    Returns:
        g_2, same shape.
    """
    phi = jnp.asarray(packing_fraction)
    if dimension == 3:
        return (2 - phi) / (2 * (1 - phi) ** 3)
    return (1 - 7 * phi / 16) / (1 - phi) ** 2


def contact_value_slopes(
    packing_fraction: ArrayLike, dimension: int
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Logarithmic slopes of the pair correlation of hard spheres at contact.

    Args: as `contact_value`.

    Returns:
        ``d ln g_2/d ln sigma = d phi g_2'/g_2`` at fixed number density, and ``-d ln g/d ln r`` at
        r = sigma: in three dimensions Percus and Yevick's
        ``(9/2) phi (1 + phi)/((1 - phi)^3 g_2)``; in two, to first order in phi,
        ``(16/3 - 25/8) phi``, the excluded area of two disks at contact less what the first slope
        has of it.
    """
    phi = jnp.asarray(packing_fraction)
    g_2 = contact_value(phi, dimension)
    if dimension == 3:
        by_diameter = 3 * phi * (3 / (1 - phi) - 1 / (2 - phi))
        return by_diameter, 4.5 * phi * (1 + phi) / ((1 - phi) ** 3 * g_2)
    by_diameter = 2 * phi * (2 / (1 - phi) - 7 / (16 - 7 * phi))
    return by_diameter, (16 / 3 - 25 / 8) * phi

"""Spheres in a box: geometry, pair correlation at contact, shear waves, and speeds of impacts.

`scaled_critical_wavenumber` is the wavenumber below which shear waves of a cooling gas grow.
`impact_average` is the average over the normal speeds of the impacts in a gas.
"""

from collections.abc import Callable
from math import gamma, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import POSITIVE, UserNumber, float_array

CLOSE_PACKING = {2: pi / (2 * 3**0.5), 3: pi / (3 * 2**0.5)}
"""Packing fraction of the densest packing of equal disks (2) and of equal spheres (3)."""

PACKING_LIMIT = {2: 0.65, 3: 0.48}
"""Largest packing fraction of a random start, which is a fluid, by dimension; hard disks and
spheres freeze at slightly larger ones."""

MIN_BOX = 2.1
"""Least side of a box in diameters; in a smaller one a sphere could touch another one and its image
at once."""

SHEAR_VISCOSITY = {2: (2.0, 1.0, 0.8729), 3: (4.0, 0.8, 0.7614)}
"""Coefficients b, a_1, a_2 of Enskog's shear viscosity, by dimension.

``eta g_2 / eta_0 = 1 + a_1 y + a_2 y^2`` with ``y = b phi g_2``.

Reference: Gass 1971 (2D); Chapman & Cowling, Eq. 16.41.7 (3D).
"""


def sphere_surface(dimension: int) -> float:
    """Surface area of the unit sphere in d dimensions, ``S_d = 2 pi^(d/2) / Gamma(d/2)``."""
    return 2 * pi ** (dimension / 2) / gamma(dimension / 2)


def sphere_mass(diameter: UserNumber, density: UserNumber) -> Float[Array, "..."]:
    """Mass of a solid sphere, ``m = pi density diameter^3 / 6``.

    Args:
        diameter: sigma, m, > 0, any shape.
        density: density of the material, kg/m^3, > 0, same shape or a scalar.

    Returns:
        m, kg.

    Raises:
        ValueError: if a value is not a positive number.

    >>> f"{float(jaxgran.sphere_mass(2e-3, 2500.0)):.3g} kg"
    '1.05e-05 kg'
    """
    POSITIVE.check("diameter", diameter, "Give the diameter in metres.")
    POSITIVE.check("density", density, "Give the density of the material in kg/m^3.")
    return _sphere_mass(float_array(diameter, unit="m"), float_array(density, unit="kg/m^3"))


@jax.jit
def _sphere_mass(diameter: Array, density: Array) -> Array:
    return pi / 6 * density * diameter**3


def contact_value(packing_fraction: ArrayLike, dimension: int) -> Any:
    """Equilibrium pair correlation function at contact, ``g_2(sigma)``.

    ``(2 - phi) / (2 (1 - phi)^3)`` in three dimensions (Carnahan & Starling 1969) and
    ``(1 - 7 phi/16) / (1 - phi)^2`` in two (Henderson 1975). It tends to 1 for a dilute gas.

    Args:
        packing_fraction: phi, any shape; the formulae hold for the fluid phase, for phi below about
            0.5 (3D) or 0.7 (2D).
        dimension: d, 2 or 3.

    Returns:
        g_2, same shape; a float for a float, for which nothing is compiled.
    """
    phi: Any = packing_fraction
    if dimension == 3:
        return (2 - phi) / (2 * (1 - phi) ** 3)
    return (1 - 7 * phi / 16) / (1 - phi) ** 2


def pair_contact_value(
    packing_fraction: ArrayLike, spread: ArrayLike, pair: ArrayLike, dimension: int
) -> Float[Array, "..."]:
    """Pair correlation at contact of two spheres of a gas of spheres of unequal sizes.

    ``1/(1 - phi) + 3 phi y/(2 (1 - phi)^2) + phi^2 y^2/(2 (1 - phi)^3)`` with ``y = (sigma_i
    sigma_j/sigma_ij) <sigma^2>/<sigma^3>`` in three dimensions (Boublik 1970; Mansoori, Carnahan,
    Starling & Leland 1971), and ``1/(1 - phi) + 9 phi y/(16 (1 - phi)^2)`` with ``y = (sigma_i
    sigma_j/sigma_ij) <sigma>/<sigma^2>`` in two (Jenkins & Mancini 1987). It is `contact_value` for
    equal spheres.

    Args:
        packing_fraction: phi.
        spread: standard deviation of the diameters over their mean.
        pair: ``sigma_i sigma_j/sigma_ij`` over the mean diameter, with the mean sigma_ij of the
            two diameters, any shape.
        dimension: d, 2 or 3.
    """
    phi = jnp.asarray(packing_fraction)
    square = jnp.asarray(spread) ** 2
    rest = 1 - phi
    if dimension == 3:
        y = pair * (1 + square) / (1 + 3 * square)
        return 1 / rest + 3 * phi * y / (2 * rest**2) + (phi * y) ** 2 / (2 * rest**3)
    y = pair / (1 + square)
    return 1 / rest + 9 * phi * y / (16 * rest**2)


def contact_value_slopes(
    packing_fraction: ArrayLike, dimension: int
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Logarithmic slopes of the pair correlation of hard spheres at contact.

    Arguments: see `contact_value`.

    Returns:
        Slope ``d ln g_2/d ln sigma = d phi g_2'/g_2`` at fixed number density.
        Slope ``-d ln g/d ln r`` at r = sigma. In three dimensions it is
        ``(9/2) phi (1 + phi)/((1 - phi)^3 g_2)`` of Percus and Yevick; in two dimensions, to first
        order in phi, ``(16/3 - 25/8) phi``: the excluded area of two disks at contact, minus the
        part that the first slope contains.
    """
    phi = jnp.asarray(packing_fraction)
    g_2 = contact_value(phi, dimension)
    if dimension == 3:
        by_diameter = 3 * phi * (3 / (1 - phi) - 1 / (2 - phi))
        return by_diameter, 4.5 * phi * (1 + phi) / ((1 - phi) ** 3 * g_2)
    by_diameter = 2 * phi * (2 / (1 - phi) - 7 / (16 - 7 * phi))
    return by_diameter, (16 / 3 - 25 / 8) * phi


def scaled_critical_wavenumber(
    packing_fraction: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """Critical wavenumber ``k_c sigma/sqrt(I)``, below which shear waves of a cooling gas grow.

    ``n sigma^3 sqrt(32 pi f/15)`` in three dimensions and ``n sigma^2 sqrt(pi f)`` in two, with
    ``f = g_2^2/(1 + a_1 y + a_2 y^2)`` by `SHEAR_VISCOSITY`. I = <1 - eps^2> is weighted by the
    energy of the normal motion; see `Gas.critical_box`.

    Args:
        packing_fraction: phi.
        dimension: d, 2 or 3.
    """
    g_2 = contact_value(packing_fraction, dimension)
    phi = packing_fraction
    b, a_1, a_2 = SHEAR_VISCOSITY[dimension]
    y = b * phi * g_2
    dense = g_2**2 / (1 + a_1 * y + a_2 * y**2)
    density = phi * dimension * 2**dimension / sphere_surface(dimension)
    return density * jnp.sqrt((32 * pi / 15 if dimension == 3 else pi) * dense)


def _quadrature(num_nodes: int, max_speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes g and weights for ``int_0^inf g exp(-g^2/2) f(g) dg``.

    The rule is Gauss-Legendre in sqrt(g), since laws of restitution are smooth in small powers of
    g. The integral from `max_speed` to infinity is neglected.
    """
    x, w = np.polynomial.legendre.leggauss(num_nodes)
    root = (x + 1) / 2
    g = max_speed * root**2
    return g, w * max_speed * root * g * np.exp(-(g**2) / 2)


NODES, WEIGHTS = _quadrature(num_nodes=32, max_speed=9.0)
"""Normal speeds g in units of sqrt(2 T), and their weights."""


def impact_average(function: Callable[[Array], Array], like: Float[Array, ""]) -> Float[Array, ""]:
    """Average over the normal speeds of impacts, ``int_0^inf g exp(-g^2/2) f(g) dg``.

    Args:
        function: f, a function of an array of g, the speeds in units of sqrt(2 T).
        like: a number whose dtype the result has.
    """
    nodes, weights = (jnp.asarray(x, like.dtype) for x in (NODES, WEIGHTS))
    return jnp.sum(weights * function(nodes))


def wrap(position: Float[Array, "n d"], side: ArrayLike) -> Float[Array, "n d"]:
    """Return positions in a periodic box, 0 <= x < side: a remainder may round to the side."""
    inside = jnp.mod(position, side)
    return jnp.where(inside >= side, 0.0, inside)


def wrap_on_host(
    position: Float[np.ndarray, "... d"], side: float | Float[np.ndarray, "d"]
) -> Float[np.ndarray, "... d"]:
    """Return positions in a periodic box as `wrap`, but compile nothing."""
    inside = position % side
    return np.where(inside < side, inside, 0.0)

"""The shear instability of a cooling gas: the shortest wave of a flow that outlives the heat."""

from math import pi

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.geometry import contact_value, sphere_surface
from jaxgran.scene.impact_average import impact_average
from jaxgran.scene.law import ReducedLaw

SHEAR_VISCOSITY = {2: (2.0, 1.0, 0.8729), 3: (4.0, 0.8, 0.7614)}
"""b, a_1, a_2 of Enskog's ``eta g_2 / eta_0 = 1 + a_1 y + a_2 y^2`` with ``y = b phi g_2``.

Reference: Gass 1971 (2D); Chapman & Cowling, Eq. 16.41.7 (3D).
"""


def unit_wavenumber(packing_fraction: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """``k_c sigma/sqrt(I)``, I = <1 - eps^2>: see `critical_length`."""
    g_2, phi = contact_value(packing_fraction, dimension), packing_fraction
    b, first, second = SHEAR_VISCOSITY[dimension]
    y = b * phi * g_2
    dense = g_2**2 / (1 + first * y + second * y**2)
    density = phi * dimension * 2**dimension / sphere_surface(dimension)
    return density * jnp.sqrt((32 * pi / 15 if dimension == 3 else pi) * dense)


def mean_loss(law: ReducedLaw, like: Float[Array, ""]) -> Float[Array, ""]:
    """``I = <1 - eps^2>``, weighted by the energy of the normal motion, at the reference speed.

    Args:
        law: of restitution.
        like: a number of the precision that is wanted.
    """

    def lost(g: Array) -> Array:
        loss = law.loss(g)
        return g**2 / 2 * loss * (2 - loss)

    return impact_average(lost, like)


def critical_length(
    law: ReducedLaw, packing_fraction: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """L_c = 2 pi/k_c in diameters, at the reference speed sqrt(2 T) of the law.

    The energy of a wave of shear flow decays at the rate ``2 eta k^2/rho``, heat at the cooling
    rate: equal at k_c. ``k_c sigma = n sigma^3 sqrt((32 pi/15) I f)`` (3D) or
    ``n sigma^2 sqrt(pi I f)`` (2D) with ``I = <1 - eps^2>``, weighted by the energy of the normal
    motion, and ``f = g_2^2/(1 + a_1 y + a_2 y^2)`` of a dense gas, by Enskog's viscosity of elastic
    spheres in the first Sonine approximation.

    Returns:
        L_c/sigma; infinite for elastic spheres.
    """
    loss = mean_loss(law, packing_fraction)
    inelastic = loss > 0
    root = unit_wavenumber(packing_fraction, dimension) * jnp.sqrt(jnp.where(inelastic, loss, 1.0))
    return jnp.where(inelastic, 2 * pi / root, jnp.inf)

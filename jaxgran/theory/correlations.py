"""Velocity correlations of dissipating hard spheres, which Enskog's theory leaves out."""

from math import log, pi

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.shear import unit_wavenumber

SHORTEST = {2: (0.168, 3.49), 3: (0.922, 2.228)}
"""a, b of ``K sigma = a + b phi``, the largest wavenumber of the modes of the flow, by dimension.

Fitted to ``experiments/accuracy/measure_correlations.py``: hard spheres of eps = .7 and .9 at phi =
.05 to .3, eighteen gases; chi^2 is 10 of 9 gases with two numbers, in each dimension.
"""

BUILD_UP = 4.0
"""Collisions per particle in which the correlations arise: 4 +- 2 in boxes below L_c/2."""

LONGEST = 2.0
"""Least wavenumber that is counted, over k_c; longer waves belong to the box, see
`jaxgran.theory.shear_modes`."""

TAIL = LONGEST + log((LONGEST - 1) / (LONGEST + 1)) / 2
"""``LONGEST - int_LONGEST^inf (x^2/(x^2 - 1) - 1) dx``."""


def slowing(
    packing_fraction: Float[Array, ""], inelasticity: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """Share of the cooling rate that velocity correlations take, once they have arisen.

    Spheres that have met move more in parallel than before, and some of them meet again: their
    normal speed is then lower than that of strangers. As modes of the flow, a shear wave of
    wavenumber k > k_c is cooled by viscosity and not by impacts, and holds ``1/((k/k_c)^2 - 1)`` of
    T above equipartition (`jaxgran.theory.shear_modes`), which does not take part in impacts. All
    waves from 2 k_c, those shorter than L_c/2, to a shortest one, K, take
    ``(3/2) (d - 1)/(d n) int d^dk/(2 pi)^d 1/((k/k_c)^2 - 1)`` of the rate, that is
    ``k_c^2 (K - 1.451 k_c)/(2 pi^2 n)`` in 3D and ``3 k_c^2 ln((K^2/k_c^2 - 1)/3)/(16 pi n)`` in
    2D. It is 0 for an elastic gas, whose collision rate is Enskog's but for .4 % at phi = .3, by
    which the virial series exceeds it.

    Args:
        packing_fraction: phi.
        inelasticity: I = <1 - eps^2>, weighted by the energy of the normal motion.
        dimension: d.
    """
    phi = packing_fraction
    a, b = SHORTEST[dimension]
    n = phi * dimension * 2**dimension / sphere_surface(dimension)  # in one diameter^d
    unit, shortest = unit_wavenumber(phi, dimension), a + b * phi
    # Elastic spheres: without the bound derivatives in I were not finite.
    critical = unit**2 * jnp.maximum(inelasticity, 1e-12)
    if dimension == 3:
        taken = (shortest - TAIL * jnp.sqrt(critical)) / (2 * pi**2)
    else:
        ratio = (shortest**2 / critical - 1) / (LONGEST**2 - 1)
        taken = 3 * jnp.log(jnp.maximum(ratio, 1.0)) / (16 * pi)
    return unit**2 * inelasticity / n * jnp.maximum(taken, 0.0)


def built_up(collisions: Float[Array, "..."]) -> Float[Array, "..."]:
    """``1 - exp(-N/N_0)`` after N collisions per particle."""
    return -jnp.expm1(-collisions / BUILD_UP)

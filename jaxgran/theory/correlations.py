"""Velocity correlations of dissipating hard spheres, which Enskog's theory leaves out."""

from math import log, pi

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.shear import unit_wavenumber

SHORTEST = {2: (0.181, 3.10), 3: (0.926, 2.19)}
"""a, b of ``K sigma = a + b phi``, up to which waves count, by dimension.

Fitted to ``experiments/accuracy/measure_correlations.py``: hard spheres of eps = .7 and .9 at phi =
.05 to .3. With two numbers chi^2 is 7 (2D) and 10 (3D) of nine gases. Errors: 2D .05, .24; 3D .07,
.32. With --full gases of eps = .95, to which nothing was fitted, agree in 3D, but those of eps =
.8 and phi >= .2 cool up to 1 % faster than this says, and disks of phi >= .2 up to 2 %.
"""

BUILD_UP = 4.0
"""Collisions per particle in which the correlations arise: 4 +- 2 in boxes below L_c/2."""

LONGEST = 2.0
"""Least wavenumber that is counted, over k_c; longer waves belong to the box, see
`jaxgran.theory.shear_modes`."""

TAIL = LONGEST + log((LONGEST - 1) / (LONGEST + 1)) / 2
"""``LONGEST - int_LONGEST^inf (x^2/(x^2 - 1) - 1) dx``, what is missing of K/k_c."""


def slowing(
    packing_fraction: Float[Array, ""], inelasticity: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """Share of the cooling rate that velocity correlations take, once they have arisen.

    Spheres that have met move more in parallel than before, and some of them meet again: their
    normal speed is then lower than that of strangers. In modes of the flow: a shear wave of
    wavenumber k > k_c is cooled by viscosity and not by impacts, and holds ``1/((k/k_c)^2 - 1)`` of
    T above equipartition (`jaxgran.theory.shear_modes`), which takes no part in impacts. All waves
    shorter than L_c/2 take ``(3/2) (d - 1)/(d n) int d^dk/(2 pi)^d 1/((k/k_c)^2 - 1)`` of the rate,
    from 2 k_c on. Short waves are no waves of a fluid: of the leading term k_c^2/k^2, which they
    make with any small I in proportion to it, as much is counted as a fluid would have up to K.
    That is ``k_c^2 (K - 1.451 k_c)/(2 pi^2 n)`` in 3D and ``3 k_c^2 ln(K^2/(3 k_c^2))/(16 pi n)``
    in 2D, at least 0. An elastic gas has none of it: its collision rate is Enskog's but for .4 % at
    phi = .3, by which the virial series exceeds it.

    Reference: Kawahara & Nakanishi, J. Phys. Soc. Jpn. 73 (2004) 68, who found in three-dimensional
    hard spheres an energy decay slower than that of independent collisions from the early stage on,
    and velocity correlations as its reason.

    Args:
        packing_fraction: phi.
        inelasticity: I = <1 - eps^2>, weighted by the energy of the normal motion.
        dimension: d.
    """
    phi = packing_fraction
    a, b = SHORTEST[dimension]
    n = phi * dimension * 2**dimension / sphere_surface(dimension)  # in one diameter^d
    unit, shortest = unit_wavenumber(phi, dimension), a + b * phi
    # Elastic spheres: without the bound the root had no derivative.
    critical = unit * jnp.sqrt(jnp.maximum(inelasticity, 1e-12))
    if dimension == 3:
        taken = jnp.maximum(shortest - TAIL * critical, 0.0) / (2 * pi**2)
    else:
        x = shortest / critical
        taken = 3 * jnp.log(jnp.maximum(x**2 / (LONGEST**2 - 1), 1.0)) / (16 * pi)
    return unit**2 * inelasticity / n * taken


def built_up(collisions: Float[Array, "..."]) -> Float[Array, "..."]:
    """``1 - exp(-N/N_0)`` after N collisions per particle."""
    return -jnp.expm1(-collisions / BUILD_UP)

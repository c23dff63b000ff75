"""The shear instability: the wavenumber below which shear waves of a cooling gas grow."""

from math import pi

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.geometry import contact_value, sphere_surface

SHEAR_VISCOSITY = {2: (2.0, 1.0, 0.8729), 3: (4.0, 0.8, 0.7614)}
"""Coefficients b, a_1, a_2 of Enskog's shear viscosity, by dimension.

``eta g_2 / eta_0 = 1 + a_1 y + a_2 y^2`` with ``y = b phi g_2``.

Reference: Gass 1971 (2D); Chapman & Cowling, Eq. 16.41.7 (3D).
"""


def scaled_critical_wavenumber(
    packing_fraction: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """Critical wavenumber ``k_c sigma/sqrt(I)``, with I = <1 - eps^2>; see `Gas.critical_box`."""
    g_2 = contact_value(packing_fraction, dimension)
    phi = packing_fraction
    b, a_1, a_2 = SHEAR_VISCOSITY[dimension]
    y = b * phi * g_2
    dense = g_2**2 / (1 + a_1 * y + a_2 * y**2)
    density = phi * dimension * 2**dimension / sphere_surface(dimension)
    return density * jnp.sqrt((32 * pi / 15 if dimension == 3 else pi) * dense)

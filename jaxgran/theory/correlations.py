"""Velocity correlations of dissipating hard spheres, which Enskog's theory leaves out."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas

STRENGTH = {2: (0.4, 5.0, 0.0), 3: (0.46, 0.0, 17.0)}
"""a, b, c of ``h = a phi/(1 + b phi + c phi^2)`` by dimension.

Measured in event-driven runs at phi = .05 to .3 and eps = .7 to .95, net of the waves below twice
the critical wavenumber, which belong to the box (`jaxgran.theory.shear_modes`), and of 1/(2 N): in
3D h = .022, .042, .053, .052 at phi = .05, .1, .2, .3, each +- .005; in 2D .02 to .06 +- .02.
"""

BUILD_UP = 4.0
"""Collisions per particle in which the correlations arise: 3 to 5 where it could be told."""


def strength(gas: Gas) -> Float[Array, ""]:
    """h in ``1 - h <1 - eps^2> (1 - exp(-N/N_0))``, a factor of the cooling rate.

    N is the number of collisions per particle.

    Spheres that have met move more in parallel than before, and some of them meet again: their
    normal speed is then lower than that of strangers. An elastic gas has no such correlations (its
    collision rate is Enskog's within .4 % up to phi = .3). They are the sum over the modes of the
    flow of what these hold above equipartition, of those modes whose waves are shorter than L_c/2.

    Args:
        gas: the scene.
    """
    phi, (a, b, c) = gas.packing_fraction, STRENGTH[gas.dimension]
    return a * phi / (1 + phi * (b + c * phi))


def built_up(collisions: Float[Array, "..."]) -> Float[Array, "..."]:
    """``1 - exp(-N/N_0)`` after N collisions per particle."""
    return -jnp.expm1(-collisions / BUILD_UP)

"""Tangents of a gas that exchanges energy with rotation, walls, drag and a drive.

Such a gas is taken to remember two numbers, the energies of translation and of rotation, with
velocities and spins distributed alike at all times. Their tangents ``dE`` in a parameter p, at a
fixed time, grow by the energy F that each step brings:

    d(dE) = dF/dp + dF/dc c + dF/dc_r c_r + F c/2.

Here c and c_r are the tangents ``dE/E`` of the two energies, which stand for velocities (c/2) v and
spins (c_r/2) s at all impacts of the step; and the last term says that faster spheres have more
impacts. All four are sums over the impacts that happen: no law of the gas is assumed. The number of
collisions has the tangent ``d(dN) = dN c/2``.

A direction of its own makes all that happens more frequent. It tells the derivative in time: what
is sooner by some share everywhere, is sooner by this share of its time.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class ExchangeTangents(NamedTuple):
    """Tangents of energies along p directions, the last of which is that of time.

    Attributes:
        energies: of translation and rotation.
        collisions: of their number.
    """

    energies: Float[Array, "p 2 *replicas"]
    collisions: Float[Array, "p *replicas"]

    def after(
        self,
        before: Float[Array, "2 *replicas"],
        gained: Float[Array, "2 *replicas"],
        along: Float[Array, "changes 2 *replicas"],
        collisions: Float[Array, "*replicas"],
    ) -> "ExchangeTangents":
        """The tangents after a step, by the midpoint rule.

        Args:
            before: both energies before it.
            gained: F, what each gained.
            along: tangents of F, for each direction, for the logarithm of all velocities, and for
                that of all spins.
            collisions: that happened.
        """
        sooner = jnp.zeros(len(self.energies), gained.dtype).at[-1].set(1.0)
        sooner = sooner.reshape(-1, *[1] * gained.ndim)
        by_velocity, by_spin = along[-2] + gained, along[-1]

        def growth(c: Array) -> Array:
            by_scale = by_velocity[None] * c[:, :1] / 2 + by_spin[None] * c[:, 1:] / 2
            return along[:-2] + by_scale + sooner * gained[None]

        middle = before + gained / 2
        first = _ratio(self.energies, before[None])
        half = _ratio(self.energies + growth(first) / 2, middle[None])
        met = sooner[:, 0] * collisions[None] + half[:, 0] / 2 * collisions[None]
        return ExchangeTangents(self.energies + growth(half), self.collisions + met)


def _ratio(above: Array, below: Array) -> Array:
    """The ratio, 0 where the denominator is 0."""
    known = below > 0
    return jnp.where(known, above / jnp.where(known, below, 1.0), 0.0)

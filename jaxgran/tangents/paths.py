"""Tangents of the paths of particles: how far they go, and how long they keep their velocity.

In own time s, ``ds = T^(1/2) dt``, collisions come at a constant rate, and kinetic theory has, with
``M = D / T^(1/2)`` and the mean square displacement R,

    dM/ds = 1 - kappa M,    dR/ds = 2 d M,    d ln<v(0).v>/ds = -kappa - zeta/2.

Here zeta is the cooling rate, and kappa the rate of velocity relaxation less zeta/2, both in own
time. For omega collisions per particle and unit of s at a restitution eps they are
``zeta = omega (1 - eps^2)/d`` and ``kappa = omega (1 + eps)^2/(2 d)``, so that a change of eps
changes both in a fixed ratio, ``d kappa = -h d zeta`` with ``h = (1 + eps)/(2 eps)``. The change of
zeta is what makes the tangent of the temperature grow: ``dc/ds = -d zeta``. This closes the
equations with measured rates, whatever the law of restitution.

Reference: Brilliantov & Poeschel, Self-diffusion in granular gases; first Sonine approximation.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

LEAST_RESTITUTION = 0.3
"""Floor of eps in h, which grows without bound as eps vanishes."""


class PathTangents(NamedTuple):
    """Tangents at a fixed place in the sequence of collisions, along p directions.

    Attributes:
        mobility: M.
        displacement: R, as the equations above have it.
        mobility_along: tangents of M.
        displacement_along: tangents of R.
        correlation_along: tangents of ``ln(<v(0).v> / T^(1/2))``.
    """

    mobility: Float[Array, "replicas"]
    displacement: Float[Array, "replicas"]
    mobility_along: Float[Array, "p replicas"]
    displacement_along: Float[Array, "p replicas"]
    correlation_along: Float[Array, "p replicas"]

    @classmethod
    def at_start(cls, num_directions: int, replicas: int, dtype: DTypeLike) -> "PathTangents":
        """The tangents of an initial state."""
        each, along = jnp.zeros(replicas, dtype), jnp.zeros((num_directions, replicas), dtype)
        return cls(each, each, along, along, along)

    def after(
        self,
        own_time: Float[Array, "replicas"],
        gain: Float[Array, "p replicas"],
        meeting: Float[Array, "replicas"],
        cooling: Float[Array, "replicas"],
        dimension: int,
    ) -> "PathTangents":
        """The tangents after a time, by the implicit midpoint rule.

        Args:
            own_time: increase of s.
            gain: increase of c.
            meeting: omega.
            cooling: zeta.
            dimension: d.
        """
        d = dimension
        square = 1 - d * cooling / jnp.maximum(meeting, jnp.finfo(meeting.dtype).tiny)
        eps = jnp.sqrt(jnp.clip(square, LEAST_RESTITUTION**2, 1.0))
        ratio = (1 + eps) / (2 * eps)
        half = 0.5 * meeting * (1 + eps) ** 2 / (2 * d) * own_time
        old = self.mobility
        new = ((1 - half) * old + own_time) / (1 + half)
        faded = ratio[None] * gain
        kept, mean = ((1 - half) / (1 + half))[None], (0.5 * (old + new) / (1 + half))[None]
        along = kept * self.mobility_along - mean * faded
        return PathTangents(
            mobility=new,
            displacement=self.displacement + d * own_time * (old + new),
            mobility_along=along,
            displacement_along=self.displacement_along
            + d * own_time[None] * (self.mobility_along + along),
            correlation_along=self.correlation_along - faded,
        )

    @property
    def log_displacement(self) -> Float[Array, "p replicas"]:
        """Tangents of ``ln R``; 0 at t = 0."""
        known = self.displacement > 0
        safe = jnp.where(known, self.displacement, 1.0)
        return jnp.where(known[None], self.displacement_along / safe[None], 0.0)

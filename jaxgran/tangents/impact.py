"""Tangents of a gas of instantaneous impacts, projected at every impact."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float

from jaxgran.scene.restitution import ReducedLaw
from jaxgran.tangents.paths import PathTangents
from jaxgran.tangents.rates import Rates


class ImpactTangents(NamedTuple):
    """Tangents of a gas of instantaneous impacts along p directions in its law of restitution.

    The tangent of the velocities is (c/2) v, without a rest, since every impact is projected. An
    impact at the normal speed g dissipates ``(1 - eps^2) g^2 / 4``, so that a change of eps adds
    ``eps g^2 d eps / 2`` to the energy, with ``d eps = d eps/dp + (c/2) d eps/d ln g``.

    Attributes:
        law: the directions, stacked along a first axis of each leaf.
        log_temperature: c = d ln T.
        clock: tangent of the time at a fixed place in the sequence of collisions.
        rates: of the gas.
        paths: tangents of the paths of the particles.
    """

    law: ReducedLaw
    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    rates: Rates
    paths: PathTangents

    @classmethod
    def at_start(cls, law: ReducedLaw, replicas: int, dtype: DTypeLike) -> "ImpactTangents":
        """The tangents of an initial state, which does not depend on the law."""
        num_directions = max((len(leaf) for leaf in jax.tree.leaves(law)), default=0)
        zeros = jnp.zeros((num_directions, replicas), dtype)
        paths = PathTangents.at_start(num_directions, replicas, dtype)
        return cls(law, zeros, zeros, Rates.none(replicas, dtype), paths)

    def gains(
        self, law: ReducedLaw, normal_speed: Float[Array, "rows"]
    ) -> Float[Array, "changes rows"]:
        """``eps g^2 d eps / 2`` of impacts: one row per direction, and a last one for ln g."""

        def along(direction):
            return jax.jvp(lambda law: law.restitution(normal_speed), (law,), (direction,))[1]

        eps, in_speed = jax.jvp(law.restitution, (normal_speed,), (normal_speed,))
        slopes = in_speed[None]
        if len(self.log_temperature):
            slopes = jnp.concatenate([jax.vmap(along)(self.law), slopes])
        return 0.5 * (eps * normal_speed**2)[None] * slopes

    def after(
        self,
        gains: Float[Array, "changes replicas"],
        energy: Float[Array, "replicas"],
        temperature: Float[Array, "replicas"],
        duration: ArrayLike,
        rates: Rates,
        trend: Float[Array, "replicas"],
        dimension: int,
    ) -> "ImpactTangents":
        """The tangents after some impacts, by the implicit midpoint rule.

        Args:
            gains: the sums of `gains` over the impacts.
            energy: mean thermal energy of each replica during them.
            temperature: T of each replica after them.
            duration: of the time in which they happened.
            rates: of the gas after them.
            trend: the dependence of its cooling rate on T, now.
            dimension: d.
        """
        c = self.log_temperature
        half = gains[-1:] / (4 * energy[None])
        new = ((1 + half) * c + gains[:-1] / energy[None]) / (1 - half)
        speed = jnp.sqrt(temperature)
        paths = self.paths.after(
            speed * duration,
            new - c,
            meeting=rates.collision(jnp.ones_like(speed)),
            cooling=rates.cooling(trend) / jnp.where(speed > 0, speed, 1.0),
            dimension=dimension,
        )
        return self._replace(
            log_temperature=new,
            clock=self.clock - 0.25 * (c + new) * duration,
            rates=rates,
            paths=paths,
        )

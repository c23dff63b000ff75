"""Two memories of a derivative: what is kept of the tangent of a chaotic gas.

In each mean free time the trajectories of a gas diverge by a factor of 6 (phi = .1) to 120
(phi = .02), and the exact derivative of a run with them: after a few collisions it says nothing
about the mean. But a homogeneous gas forgets all of its microscopic state except its temperature,
and a change of temperature is only a change of clock: with velocities s times as large, and with
``alpha s^2`` and ``A / s`` in place of alpha and A, the particles follow the same paths s times as
fast. So the tangent of a state in a parameter p is projected onto few numbers:

- `ContactTangents`, of gases of lasting contacts: ``c = d ln T/dp`` and the tangent of the clock.
  The derivative at a fixed time is the derivative at a fixed place in the sequence of collisions
  plus the rate of change of the gas times the tangent of the clock. Rates are averages over the
  last mean free times (`RateSums`), which are less noisy than projections at fixed times.
- `ExchangeTangents`, of gases of instantaneous impacts: the tangents of one energy, of two where
  spheres rotate, that grow by what each impact, wall, drag and drive exchange.

Both leave out that a parameter changes the shape of the velocity distribution. After 10 to 100 mean
free times of smooth spheres in 3D d ln T/d ln A is .2 % too large at a thermal beta of .03 and .09,
and .1 % too small at .15, 1 % at .3, 2.4 % at .5, 5 % at 1. The figures are from kinetic theory
with a_2(t) kept fixed, and DSMC agrees with them at .09 and 1.

In a box longer than L_c a gas also remembers its flow, and these derivatives are too large.
``docs/pages/validation/accuracy.md`` has figures of projections that keep more of the tangents
there: none of them is right at 100 collisions per particle, so the package has none. Use
differences of runs (`jaxgran.gradients.differences`) in such boxes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS

AVERAGING_TIME = 5.0
"""Mean free times over which rates of change are averaged."""


def ratio_or_zero(above: Array, below: Array) -> Array:
    """Return the ratio, or 0 where the denominator is 0."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)


class RateSums(NamedTuple):
    """Exponentially weighted sums, from which rates of several changes are estimated.

    The trend of a rate is its known dependence on the state, in an arbitrary unit.

    Attributes:
        amounts: how much has changed.
        trends: how much a rate equal to its trend would have changed.
    """

    amounts: Float[Array, "changes replicas"]
    trends: Float[Array, "changes replicas"]

    @classmethod
    def zero(cls, changes: int, replicas: int, dtype: DTypeLike) -> "RateSums":
        """Return the sums before the first collision."""
        zeros = jnp.zeros((changes, replicas), dtype)
        return cls(zeros, zeros)

    def after(
        self,
        amounts: Float[Array, "changes replicas"],
        trends: Float[Array, "changes replicas"],
        passed: Float[Array, "replicas"],
    ) -> "RateSums":
        """Return the sums after further changes, and `passed` mean free times."""
        decay = jnp.exp(-passed / AVERAGING_TIME)[None]
        return RateSums(decay * self.amounts + amounts, decay * self.trends + trends)

    def rate(self, change: int, trend: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Return the rate of a change, given its trend now."""
        return ratio_or_zero(self.amounts[change], self.trends[change]) * trend


def component_along(
    rest: Float[Array, "p n k"], vectors: Float[Array, "n k"], replicas: int
) -> Float[Array, "p replicas"]:
    """Return the component of each replica's rest along its vectors, relative to the vectors.

    It is 0 where all vectors are 0.
    """
    flat = vectors.reshape(replicas, -1)
    product = jnp.sum(rest.reshape(len(rest), *flat.shape) * flat[None], -1)
    return ratio_or_zero(product, jnp.sum(flat * flat, -1)[None])


class ContactTangents(NamedTuple):
    """Tangents of the state of a gas of lasting contacts along p directions in its material.

    The tangent of a state has three parts:

    - ``c = d ln T/dp``, which stands for velocities ``(c/2) v``, spins ``(c/2) s`` and for the
      corresponding changes of the material;
    - the tangent of the clock, the integral of ``-(c/2) dt``, at a fixed place in the sequence of
      collisions;
    - the exact rest of the tangents of positions, velocities and spins.

    At regular intervals the rest is projected (thermal projection): its component along v is added
    to c, and the part orthogonal to v is dropped. A gas with friction remembers T and T_rot, so
    that the rest of the spins is replaced by its component along s, the change of ``T_rot/T``.
    Spheres in contact are projected after they part.

    Attributes:
        directions: in the material, a pytree like it, stacked along a first axis.
        log_temperature: c = d ln T.
        delay: tangent of the time at a fixed place in the sequence of collisions.
        position: tangent of the positions.
        velocity: tangent of the velocities, without the part (c/2) v.
        free: True for spheres that touch no other one.
        elapsed: time since the last projection.
        rates: of the gas.
        spin: tangents of the spins, without the part (c/2) s; None for smooth spheres.
    """

    directions: Any
    log_temperature: Float[Array, "p replicas"]
    delay: Float[Array, "p replicas"]
    position: Float[Array, "p n d"]
    velocity: Float[Array, "p n d"]
    free: Bool[Array, "n"]
    elapsed: Float[Array, ""]
    rates: RateSums
    spin: Float[Array, "p n spins"] | None = None

    @classmethod
    def initial(
        cls,
        directions: Any,
        velocity: Float[Array, "n d"],
        rates: RateSums,
        spin: Float[Array, "p n spins"] | None = None,
    ) -> "ContactTangents":
        """Return the tangents of an initial state that depends on the material by its spins only.

        Args:
            directions: p directions in the material.
            velocity: of the state, for its shape and dtype.
            rates: sums before the first collision.
            spin: tangents of the spins; None for smooth spheres.
        """
        p = len(jax.tree.leaves(directions)[0])
        dtype = velocity.dtype
        zeros = jnp.zeros((p, rates.amounts.shape[1]), dtype)
        particle_zeros = jnp.zeros((p, *velocity.shape), dtype)
        return cls(
            directions=directions,
            log_temperature=zeros,
            delay=zeros,
            position=particle_zeros,
            velocity=particle_zeros,
            free=jnp.ones(len(velocity), bool),
            elapsed=jnp.zeros((), dtype),
            rates=rates,
            spin=spin,
        )

    def projected(
        self, velocity: Float[Array, "n d"], spin: Float[Array, "n spins"] | None = None
    ) -> "ContactTangents":
        """Return the tangents after a thermal projection of the spheres that touch no other one.

        Args:
            velocity: of the particles, in the frame in which each replica is at rest.
            spin: of the particles; None for smooth spheres.
        """
        c = self.log_temperature
        free = self.free[:, None]
        replicas = c.shape[1]
        size = len(velocity) // replicas
        gain = 2 * component_along(self.velocity, jnp.where(free, velocity, 0.0), replicas)

        def of_particles(values: Float[Array, "p replicas"]) -> Float[Array, "p n 1"]:
            return jnp.repeat(values, size, axis=1)[:, :, None]

        spin_tangent = self.spin
        if spin_tangent is not None and spin is not None:
            rest = spin_tangent - 0.5 * of_particles(gain) * spin[None]
            share = component_along(rest, jnp.where(free, spin, 0.0), replicas)
            spin_tangent = jnp.where(free[None], of_particles(share) * spin[None], rest)
        rest = self.velocity - 0.5 * of_particles(gain) * velocity[None]
        return self._replace(
            log_temperature=c + gain,
            delay=self.delay - 0.5 * (c + 0.5 * gain) * self.elapsed,
            position=jnp.where(free[None], 0.0, self.position),
            velocity=jnp.where(free[None], 0.0, rest),
            elapsed=jnp.zeros_like(self.elapsed),
            spin=spin_tangent,
        )


class ExchangeTangents(NamedTuple):
    """Tangents of energies along p directions, the last of which is the direction of time.

    A gas of instantaneous impacts, which also exchanges energy with rotation, walls, drag and a
    drive, is assumed to remember its energies: the energy of translation and, where spheres
    rotate, the energy of rotation. The shapes of the distributions of velocities and spins do not
    change. The tangents ``dE`` of the energies in a parameter p, at a fixed time, grow by the
    energy F that each step adds:

        d(dE) = dF/dp + dF/dc c + dF/dc_r c_r + F c/2.

    Here c and c_r are the tangents ``dE/E`` of the two energies, which stand for velocities (c/2) v
    and spins (c_r/2) s in all impacts of the step; the last term arises because faster spheres have
    more impacts. All terms are sums over the impacts that happen, so no law of the gas is
    assumed. The number of collisions has the tangent ``d(dN) = dN c/2``.

    The last direction makes all events more frequent. It gives the derivative in time: events that
    are all sooner by some share are sooner by this share of their time.

    Attributes:
        directions: in the material, stacked along a first axis.
        energies: tangents of the energies, one of smooth spheres, two of spheres that rotate.
        collisions: tangents of their number.
    """

    directions: Any
    energies: Float[Array, "p energies *replicas"]
    collisions: Float[Array, "p *replicas"]

    @classmethod
    def initial(
        cls, directions: Any, material: Any, velocity: Float[Array, "n d"], replicas: int
    ) -> "ExchangeTangents":
        """Return the tangents at t = 0, where T is 1 and the material gives T_rot."""
        directions = jax.tree.map(
            lambda x: jnp.concatenate([x, jnp.zeros_like(x, shape=(1, *x.shape[1:]))]), directions
        )
        if material.drag is not None:  # drag acts sooner, too
            rates = jax.tree.map(lambda x, rate: x.at[-1].set(rate), directions.drag, material.drag)
            directions = directions._replace(drag=rates)
        n, d = velocity.shape
        leaves = jax.tree.leaves(directions)
        p = len(leaves[0]) if leaves else 1  # a law may have no floats
        zeros = jnp.zeros((p, replicas), velocity.dtype)
        energies = [zeros]
        if material.surface is not None:
            rotational_energy = n // replicas * NUM_SPIN_COMPONENTS[d] / 2
            energies.append(zeros + rotational_energy * directions.surface.ratio[:, None])
        return cls(directions, jnp.stack(energies, axis=1), zeros)

    def after(
        self,
        before: Float[Array, "energies *replicas"],
        gained: Float[Array, "energies *replicas"],
        by_direction: Float[Array, "p energies *replicas"],
        by_scale: Float[Array, "energies energies *replicas"],
        collisions: Float[Array, "*replicas"],
    ) -> "ExchangeTangents":
        """Return the tangents after a step, by the midpoint rule.

        Args:
            before: the energies before it.
            gained: F, the energy that each gained.
            by_direction: tangents of F along the directions.
            by_scale: tangents of F in the logarithm of all velocities, and of all spins.
            collisions: number of those that happened.
        """
        is_time = jnp.zeros(len(self.energies), gained.dtype).at[-1].set(1.0)
        sooner = is_time.reshape(-1, *[1] * gained.ndim)
        # Faster spheres have more impacts.
        by_scale = by_scale.at[0].add(gained)

        def growth(c: Array) -> Array:
            by_energies = sum(
                slopes[None] * c[:, k : k + 1] / 2 for k, slopes in enumerate(by_scale)
            )
            return by_direction + by_energies + sooner * gained[None]

        first = ratio_or_zero(self.energies, before[None])
        middle = ratio_or_zero(self.energies + growth(first) / 2, (before + gained / 2)[None])
        number = collisions.astype(self.collisions.dtype)[None]
        more = sooner[:, 0] * number + middle[:, 0] / 2 * number
        return self._replace(
            energies=self.energies + growth(middle), collisions=self.collisions + more
        )

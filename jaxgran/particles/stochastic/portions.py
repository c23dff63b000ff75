"""A drive and walls in a step of DSMC, which act on portions of the particles.

The kicks of a drive in one step are far smaller than the velocities. So each half of a step kicks
a portion of all particles, with the variance of all steps until it has its turn again: the energy
that a step brings is the same, and costs as much less. How much may be brought in one turn limits
the number of portions, down to all particles in each half of a step.

Walls are met by portions that are drawn anew in each step, and so are met by a sphere that moves as
it does now: by turns, a mean free time apart, spheres that have lost speed would not come later,
and the loss be .9 % of T too large. As many portions are drawn as the fastest spheres need, and a
sphere of them meets a wall the more often.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from jaxgran.particles import kicks
from jaxgran.particles.stochastic.elements import fastest_share, heating, left_by
from jaxgran.particles.stochastic.pairing import Scheme
from jaxgran.scene.reduced_scene import ReducedScene

Sums = TypeVar("Sums")

MOST = 16
"""Portions of many particles."""

LEAST_ROWS = 16
"""Particles of a portion, whose kicks together leave its momentum as it is."""


class Portion(NamedTuple):
    """Some neighbouring rows of the particles.

    Attributes:
        first: the first of them.
        counted: which of them belong to the portion.
    """

    first: Int[Array, ""]
    counted: Bool[Array, "rows"]

    def of(self, particles: Float[Array, "N components"]) -> Float[Array, "rows components"]:
        """Its rows."""
        return jax.lax.dynamic_slice_in_dim(particles, self.first, len(self.counted))

    def written(self, particles: Float[Array, "N components"], rows: Array) -> Array:
        """All particles with new rows."""
        return jax.lax.dynamic_update_slice_in_dim(particles, rows, self.first, 0)


def number(num_particles: int) -> int:
    """The number of portions."""
    return max(min(MOST, num_particles // LEAST_ROWS), 1)


def portion(index: Int[Array, ""], num_particles: int, active: Bool[Array, ""]) -> Portion:
    """A portion of particles, each of which belongs to one."""
    n, parts = num_particles, number(num_particles)
    begin, end = index * n // parts, (index + 1) * n // parts
    rows = -(-n // parts)
    first = jnp.minimum(begin, n - rows)
    row = first + jnp.arange(rows, dtype=first.dtype)
    return Portion(first, (row >= begin) & (row < end) & active)


class Portions(NamedTuple):
    """How many portions of the particles take part in a step; None without what they take part in.

    Attributes:
        kicks: of a drive, in half of the step.
        walls: impacts on walls.
    """

    kicks: Int[Array, "*replicas"] | None
    walls: Int[Array, "*replicas"] | None


def of_step(
    temperature: Float[Array, "*replicas"],
    clock: Float[Array, "*replicas"],
    share: Float[Array, "*replicas"],
    scene: ReducedScene,
    scheme: Scheme,
) -> Portions:
    """The portions that take part in a share of a step.

    So many are kicked in half of it that T of none grows by more than `kicks.LARGEST`: particles
    whose turns are w T apart have at one time temperatures that differ by so much, by which a_2 of
    all is too large by ``w^2/12``, 2e-4 at most. So many may meet walls that one of the fastest
    spheres does so at most once.
    """
    parts = number(scheme.num_particles)
    ds = share * scheme.own_step / jnp.sqrt(temperature)

    def at_least(needed: Array) -> Array:
        return jnp.clip(jnp.ceil(needed), 1, parts).astype(jnp.int32)

    kicked = walled = None
    if scene.drive is not None:
        growth = heating(scene.drive, scene.drag, clock, ds, 0.0)
        safe = jnp.where(temperature > 0, temperature, 1.0)
        kicked = at_least(parts * growth / (kicks.LARGEST * safe))
    if scene.walls is not None:
        slowed = left_by(scene.drag, clock).velocity
        most = fastest_share(scene, temperature, slowed, ds, scheme.dimension)
        walled = at_least(parts * most)
    return Portions(kicked, walled)


def bounced(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    drawn: Int[Array, ""],
    most: Int[Array, ""],
    meet: Callable[[Array, Array], tuple[Array, Sums]],
    none: Sums,
) -> tuple[Float[Array, "N components"], Sums]:
    """The particles of one replica after their impacts on walls in a step, and sums over these.

    Args:
        particles: of the replica.
        key: of the step.
        drawn: portions that may meet walls.
        most: the largest number of these of all replicas, which share the loop.
        meet: function of particles and of a random number for each; returns them after impacts of
            those whose number is smaller than the impacts that they have in the step, and what is
            summed.
        none: sums of no impacts.
    """
    n, parts = len(particles), number(len(particles))
    bits = jax.random.bits(jax.random.fold_in(key, MOST), (), jnp.uint16)
    which = (bits % parts).astype(jnp.int32)

    def some(i: Int[Array, ""], done: tuple[Array, Sums]) -> tuple[Array, Sums]:
        particles, sums = done
        own = portion((which + i) % parts, n, i < drawn)
        bits = jax.random.bits(jax.random.fold_in(key, i), own.counted.shape, jnp.uint16)
        chance = (bits.astype(particles.dtype) + 0.5) * 2.0**-16 * (drawn / parts)
        rows, more = meet(own.of(particles), jnp.where(own.counted, chance, jnp.inf))
        return own.written(particles, rows), jax.tree.map(jnp.add, sums, more)

    return jax.lax.fori_loop(0, most, some, (particles, none))


def kicked(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    turns: Int[Array, ""],
    most: Int[Array, ""],
    half_steps: UInt32[Array, ""],
    growth: Float[Array, ""],
    time: Float[Array, ""],
    d: int,
    at_rest: bool,
) -> tuple[Float[Array, "N components"], Float[Array, ""]]:
    """The particles of one replica after half of the kicks of a step, and how much T/T_0 has grown.

    Args:
        particles: v, x - v t and spins.
        key: of this half of the step.
        turns: portions that have their turn.
        most: the largest number of turns of all replicas, which share the loop.
        half_steps: number of halves before.
        growth: of T/T_0, on average.
        time: t, as in x - v t.
        d: dimension.
        at_rest: whether the kicks leave the momentum as it is.
    """
    n, parts = len(particles), number(len(particles))
    size = jnp.sqrt(growth / 2 * (parts / turns))

    def turn(i: Int[Array, ""], done: tuple[Array, Array]) -> tuple[Array, Array]:
        particles, gained = done
        index = ((turns * half_steps.astype(jnp.int32) + i) & (2**30 - 1)) % parts
        own = portion(index, n, i < turns)
        rows = own.of(particles)
        v = rows[:, :d]
        kick = kicks.kicks(jax.random.fold_in(key, i), v, at_rest, own.counted)
        kick = jnp.where(own.counted[:, None], size * kick, 0.0)
        after = [v + kick, rows[:, d : 2 * d] - time * kick, rows[:, 2 * d :]]
        particles = own.written(particles, jnp.concatenate(after, axis=-1))
        return particles, gained + jnp.sum(kick * (2 * v + kick))

    zero = jnp.zeros((), particles.dtype)
    particles, gained = jax.lax.fori_loop(0, most, turn, (particles, zero))
    return particles, 2 * gained / (n * d)

"""Tangents of DSMC with elements, by the energies that a step exchanges.

See `jaxgran.tangents.exchange`. Energies here are sum v^2 of translation, and q sum s^2 of the
spins that are kept.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, UInt32

from jaxgran.particles.stochastic.collision_rule import collide
from jaxgran.particles.stochastic.elements import heating, hit_walls, left_by
from jaxgran.scene.elements import SPINS
from jaxgran.scene.reduced_scene import ReducedDrag, ReducedScene
from jaxgran.tangents.exchange import ExchangeTangents


class Candidates(NamedTuple):
    """Candidate pairs of a step.

    Attributes:
        relative: velocities.
        spin: sums of the spins that are kept; None of smooth spheres.
        bits: random ones.
    """

    relative: Float[Array, "pairs d"]
    spin: Float[Array, "pairs spins"] | None
    bits: UInt32[Array, "2 pairs"]


class BeforeWalls(NamedTuple):
    """Velocities and kept spins before impacts on walls, random bits, and across which axis."""

    velocity: Float[Array, "N d"]
    spin: Float[Array, "N spins"]
    bits: UInt32[Array, "N"]
    axis: Int[Array, ""]


class Step(NamedTuple):
    """All that happens in a step.

    Attributes:
        pairs: candidates.
        walls: before impacts on them; None without walls.
        ceiling, share: as for `collide`.
        began, ds: time at its begin, and its length.
        particles: N.
    """

    pairs: tuple[Candidates, Candidates]
    walls: BeforeWalls | None
    ceiling: Float[Array, ""]
    share: Float[Array, ""]
    began: Float[Array, ""]
    ds: Float[Array, ""]
    particles: int


def energies_at_start(
    scene: ReducedScene, num_parameters: int, num_particles: int, dimension: int, replicas: int
) -> ExchangeTangents:
    """The tangents at t = 0, where T is 1 and T_rot as the scene has it; the last is that in time.

    Returns:
        For each replica, along a first axis.
    """
    zero = jnp.zeros_like(scene.law.restitution(jnp.ones(())))
    energies = jnp.zeros((num_parameters + 1, 2), zero.dtype)
    if scene.surface is not None:

        def rotation(scene):
            return num_particles * SPINS[dimension] / 2 * scene.surface.ratio

        energies = energies.at[:-1, 1].set(ravel_pytree(jax.grad(rotation)(scene))[0])
    many = jnp.broadcast_to(energies, (replicas, *energies.shape))
    return ExchangeTangents(many, many[:, :, 0] * 0)


def exchanged(
    old: ExchangeTangents,
    scene: ReducedScene,
    before: Float[Array, "2"],
    step: Step,
    collisions: Float[Array, ""],
) -> ExchangeTangents:
    """The tangents after a step.

    Args:
        old: before it.
        scene: in reduced units.
        before: the two energies before it.
        step: what happens.
        collisions: their number.
    """
    zero = jnp.zeros_like(step.ds)

    def by(scene, velocity, spin, sooner):
        return _impacts(scene, velocity, spin, sooner, step), _kicks(scene, sooner, step)

    (impacts, kicks), pull = jax.vjp(by, scene, zero, zero, zero)

    def row(weights):
        in_scene, *others = pull((weights, weights))
        return jnp.concatenate([ravel_pytree(in_scene)[0], jnp.stack(others)])

    slopes = jax.vmap(row)(jnp.eye(2, dtype=zero.dtype)).T
    along = jnp.concatenate([slopes[:-3], slopes[-1:], slopes[-3:-1]])
    # Kicks do not depend on the speeds, which make impacts more frequent.
    along = along.at[-2].add(-kicks)
    return old.after(before, impacts + kicks, along, collisions)


def _sooner(scene: ReducedScene, share: Array) -> ReducedDrag | None:
    if scene.drag is None:
        return None
    return ReducedDrag(*(rate * (1 + share) for rate in scene.drag))


def _impacts(
    scene: ReducedScene, velocity: Array, spin: Array, sooner: Array, step: Step
) -> Float[Array, "2"]:
    """What both energies gain by impacts, with velocities and spins greater by factors exp(...)."""
    scene = scene._replace(drag=_sooner(scene, sooner))
    left = left_by(scene.drag, step.began + step.ds / 2)
    slowed = None if scene.drag is None else left.velocity
    faster, turning = jnp.exp(velocity), left.spin * jnp.exp(spin)
    if scene.surface is not None:  # at a given energy spins are smaller where the inertia is larger
        inertia = scene.surface.inertia
        turning = turning * jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
    total = jnp.zeros(2, step.ds.dtype)
    for pairs in step.pairs:
        spins = None if pairs.spin is None else pairs.spin * turning
        found = collide(
            pairs.relative * faster,
            pairs.bits,
            step.ceiling,
            step.share,
            scene,
            False,
            spin=spins,
            slowed=slowed,
        )
        total = total + jnp.stack([-found.loss, found.turned / left.spin**2])
    if step.walls is not None:
        v, s, bits, axis = step.walls
        slow = 1.0 if slowed is None else slowed
        hit = hit_walls(scene, bits, axis, v * faster, s * turning, step.ds, slow)
        total = total + jnp.stack([-hit.lost, hit.turned / left.spin**2])
    return total


def _kicks(scene: ReducedScene, sooner: Array, step: Step) -> Float[Array, "2"]:
    """What both energies gain by a drive."""
    if scene.drive is None:
        return jnp.zeros(2, step.ds.dtype)
    drag = _sooner(scene, sooner)
    growth = sum(heating(scene.drive, drag, step.began, step.ds, place) for place in (0.0, 1.0))
    d = step.pairs[0].relative.shape[1]
    return jnp.stack([step.particles * d / 2 * growth, jnp.zeros_like(step.ds)])

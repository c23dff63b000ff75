"""Tangents of DSMC with elements, by the energies that a step exchanges.

See `jaxgran.tangents.exchange`. Energies here are sum v^2 of translation, and q sum s^2 of the
spins that are kept.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, UInt32

from jaxgran.particles.drag import Decay
from jaxgran.particles.stochastic.collision_rule import collide
from jaxgran.particles.stochastic.elements import Walled, heating, left_by
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


class Gained(NamedTuple):
    """What both energies gain, and its tangents.

    Attributes:
        gains: of translation and rotation.
        along: in the parameters of the scene, in time, and in the logarithms of all velocities and
            of all spins.
    """

    gains: Float[Array, "2"]
    along: Float[Array, "changes 2"]


class Step(NamedTuple):
    """All that happens in a step.

    Attributes:
        pairs: candidates.
        walls: what impacts on them bring; None without walls.
        ceiling, share: as for `collide`.
        began, ds: time at its begin, and its length.
        particles: N.
    """

    pairs: tuple[Candidates, Candidates]
    walls: Gained | None
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


def energies_of(
    particles: Float[Array, "N components"], scene: ReducedScene, d: int
) -> Float[Array, "2"]:
    """sum v^2, and q sum s^2 of the spins that are kept."""
    inertia = 0.0 if scene.surface is None else scene.surface.inertia
    translation, rotation = particles[:, :d], particles[:, 2 * d :]
    return jnp.stack([jnp.sum(translation**2), inertia * jnp.sum(rotation**2)])


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
    pairs = _gained(partial(_impacts, step=step), scene, step.ds)
    kicks = _gained(lambda scene, v, s, sooner: _kicks(scene, sooner, step), scene, step.ds)
    # Kicks do not depend on the speeds, which make impacts more frequent.
    kicks = kicks._replace(along=kicks.along.at[-2].add(-kicks.gains))
    all_of = jax.tree.map(jnp.add, pairs, kicks)
    if step.walls is not None:
        all_of = jax.tree.map(jnp.add, all_of, step.walls)
    return old.after(before, all_of.gains, all_of.along, collisions)


def of_walls(hit: Callable[..., Walled], scene: ReducedScene, middle: Float[Array, ""]) -> Gained:
    """What impacts on walls bring, at the middle of a step: `hit` of `_bounced`."""

    def by(scene, velocity, spin, sooner):
        scene, left, faster, turning = _scaled(scene, velocity, spin, sooner, middle)
        found = hit(scene, faster, turning, left.velocity)
        return jnp.stack([-found.lost, found.turned / left.spin**2])

    return _gained(by, scene, middle)


def _gained(
    by: Callable[..., Float[Array, "2"]], scene: ReducedScene, like: Float[Array, ""]
) -> Gained:
    """Gains as a function of the scene, the logarithms of velocities and spins, and of time."""
    zero = jnp.zeros_like(like)
    gains, pull = jax.vjp(by, scene, zero, zero, zero)

    def row(weights):
        in_scene, *others = pull(weights)
        return jnp.concatenate([ravel_pytree(in_scene)[0], jnp.stack(others)])

    slopes = jax.vmap(row)(jnp.eye(2, dtype=zero.dtype)).T
    return Gained(gains, jnp.concatenate([slopes[:-3], slopes[-1:], slopes[-3:-1]]))


def _scaled(
    scene: ReducedScene, velocity: Array, spin: Array, sooner: Array, middle: Array
) -> tuple[ReducedScene, Decay, Array, Array]:
    """The scene and what drag has left, if all is sooner; factors of velocities and of spins."""
    scene = scene._replace(drag=_sooner(scene, sooner))
    left = left_by(scene.drag, middle)
    faster, turning = jnp.exp(velocity), left.spin * jnp.exp(spin)
    if scene.surface is not None:  # at a given energy spins are smaller where the inertia is larger
        inertia = scene.surface.inertia
        turning = turning * jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
    return scene, left, faster, turning


def _sooner(scene: ReducedScene, share: Array) -> ReducedDrag | None:
    if scene.drag is None:
        return None
    return ReducedDrag(*(rate * (1 + share) for rate in scene.drag))


def _impacts(
    scene: ReducedScene, velocity: Array, spin: Array, sooner: Array, step: Step
) -> Float[Array, "2"]:
    """What both energies gain by impacts, with velocities and spins greater by factors exp(...)."""
    middle = step.began + step.ds / 2
    scene, left, faster, turning = _scaled(scene, velocity, spin, sooner, middle)
    slowed = None if scene.drag is None else left.velocity
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
    return total


def _kicks(scene: ReducedScene, sooner: Array, step: Step) -> Float[Array, "2"]:
    """What both energies gain by a drive."""
    if scene.drive is None:
        return jnp.zeros(2, step.ds.dtype)
    drag = _sooner(scene, sooner)
    growth = sum(heating(scene.drive, drag, step.began, step.ds, place) for place in (0.0, 1.0))
    d = step.pairs[0].relative.shape[1]
    return jnp.stack([step.particles * d / 2 * growth, jnp.zeros_like(step.ds)])

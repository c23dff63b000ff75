"""Time steps of soft spheres in scenes with walls, drag or friction.

Units here: the diameter and the mass are 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.soft import friction, steps, walls
from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.flight import lost_to_drag, shortened, slower
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.tangents.thermal import ElementMaterial


class ElementWork(NamedTuple):
    """Energies of a block by walls and drag, for each of its members.

    Attributes:
        to_walls: energy lost in contacts with walls.
        to_drag: energy lost to drag.
        exchanged, stored, touched, touching: of contacts with walls, as in `ContactWork`.
    """

    to_walls: Float[Array, "members"]
    to_drag: Float[Array, "members"]
    exchanged: Float[Array, "members"]
    stored: Float[Array, "members"]
    touched: Bool[Array, "members"]
    touching: Bool[Array, "members"]


class ElementSums(NamedTuple):
    """Energies of a block by walls and drag, of each replica, and who touches a wall after it.

    Attributes:
        to_walls, to_drag, exchanged, stored: as in `ElementWork`, but of all particles.
        at_walls: whether a particle touches a wall.
    """

    to_walls: Float[Array, "replicas"]
    to_drag: Float[Array, "replicas"]
    exchanged: Float[Array, "replicas"]
    stored: Float[Array, "replicas"]
    at_walls: Bool[Array, "n"]

    @classmethod
    def of(
        cls,
        work: ElementWork,
        members: Int[Array, "members"],
        to_drag: ArrayLike,
        replicas: int,
        n: int,
    ) -> "ElementSums":
        """Of the work on the members, and of what drag would take of each particle if it flew."""

        def by_replica(values: Array) -> Array:
            each = jnp.zeros(n, values.dtype).at[members].set(values, mode="drop")
            return jnp.sum(each.reshape(replicas, -1), axis=1)

        dragged = jnp.broadcast_to(to_drag, (n,)).astype(work.to_drag.dtype)
        dragged = dragged.at[members].set(work.to_drag, mode="drop")
        return cls(
            by_replica(work.to_walls),
            jnp.sum(dragged.reshape(replicas, -1), axis=1),
            by_replica(work.exchanged),
            by_replica(work.stored),
            jnp.zeros(n, bool).at[members].set(work.touching, mode="drop"),
        )

    @property
    def lost(self) -> Float[Array, "replicas"]:
        """Energy lost to walls and drag."""
        return self.to_walls + self.to_drag


class Moving(NamedTuple):
    """Spheres that move: positions, velocities, and spins of those that have some."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    spin: Float[Array, "n spins"] | None


def members_of(scene: SoftScene, everyone: Moving, slots: Int[Array, "members"]) -> Moving:
    """The members of a block; an empty slot is at rest, and not in a wall."""

    def rows(rest: Array) -> Array:
        return rest.at[slots].get(mode="fill", fill_value=0.0)

    x, v = rows(everyone.x), rows(everyone.v)
    spin = None if everyone.spin is None else rows(everyone.spin)
    if scene.walls is not None:
        real = (slots < len(everyone.x))[:, None]
        x = jnp.where(real, x, 0.5 * scene.walls.sides[None])
    return Moving(x, v, spin)


def flown(
    scene: SoftScene, now: Moving, duration: ArrayLike, material: ElementMaterial
) -> tuple[Moving, ArrayLike]:
    """Spheres after a flight, and the energy that each lost to drag.

    Args:
        scene: for the inertia of spins.
        now: the spheres.
        duration: of the flight; negative backwards.
        material: with the rates of drag, one number or one for each sphere; None without drag.
    """
    (x, v, spin), rate = now, material.drag
    if rate is None:
        return Moving(x + v * duration, v, spin), 0.0
    path, left = shortened(rate, duration), slower(rate, duration)
    path, left = (f[:, None] if jnp.ndim(f) else f for f in (path, left))
    lost = lost_to_drag(jnp.sum(v * v, -1), rate, duration)
    x, v = x + v * path, v * left
    if spin is not None and scene.surface is not None:
        slowing, q = material.spin_drag, scene.surface.inertia
        lost = lost + q * lost_to_drag(jnp.sum(spin * spin, -1), slowing, duration)
        left = slower(slowing, duration)
        spin = spin * (left[:, None] if jnp.ndim(left) else left)
    return Moving(x, v, spin), lost


class _Sums(NamedTuple):
    """What the steps of a block have added up: of pairs, and of members."""

    dissipated: Array
    exchanged: Array
    begun: Array
    before: Array
    to_walls: Array
    to_drag: Array
    by_walls: Array
    touched: Array

    @classmethod
    def none(cls, chosen: Encounters, x: Array, touching: Array) -> "_Sums":
        pairs, members = jnp.zeros(len(chosen.a), x.dtype), jnp.zeros(len(x), x.dtype)
        begun, touched = jnp.zeros(len(chosen.a), jnp.int32), jnp.zeros(len(x), bool)
        return cls(pairs, pairs, begun, touching, members, members, members, touched)


def _step(
    now: Moving,
    sums: _Sums,
    own: tuple[ArrayLike, ArrayLike, ArrayLike],
    material: ElementMaterial,
    scene: SoftScene,
    chosen: Encounters,
    dt: ArrayLike,
) -> tuple[Moving, _Sums]:
    """A kick and a drift; `own` is (alpha, rho, A) of pairs."""
    x, v, spin = now
    kick = steps.kicked(x, v, *own, chosen, dt, scene.clipped, sums[:2])
    v, (dissipated, exchanged) = kick.v, kick.work
    if scene.walls is not None:
        wall = walls.kicked(scene.walls, x, v, *material.of_walls(), dt)
        v = wall.v
        sums = sums._replace(
            to_walls=sums.to_walls + wall.dissipated,
            by_walls=sums.by_walls + wall.exchanged,
            touched=sums.touched | wall.touching,
        )
        if scene.walls.friction is not None and scene.surface is not None and spin is not None:
            by_wall = friction.kicked_by_walls(scene.walls, scene.surface, spin, wall, dt)
            v, spin = by_wall.v, by_wall.spin
            sums = sums._replace(to_walls=sums.to_walls + by_wall.dissipated)
    if scene.surface is not None and spin is not None:
        rubbed = friction.kicked(scene.surface, spin, kick._replace(v=v), chosen, dt)
        v, spin, dissipated = rubbed.v, rubbed.spin, dissipated + rubbed.dissipated
    moved, dragged = flown(scene, Moving(x, v, spin), dt, material)
    return moved, sums._replace(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=sums.begun + (kick.touching & ~sums.before),
        before=kick.touching,
        to_drag=sums.to_drag + dragged,
    )


def follow(
    now: Moving,
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    material: ElementMaterial,
    scene: SoftScene,
    chosen: Encounters,
    duration: ArrayLike,
    num_steps: int,
) -> tuple[Moving, ContactWork, ElementWork]:
    """The members of a block after its time steps, as `steps.follow` for smooth spheres.

    Drift-kick-drift steps of equal length, second order. The drift is exact, with drag too; the
    kick is by the normal forces of pairs, then by those of walls, then by tangential forces of
    walls and of pairs, each an implicit midpoint rule at fixed positions.

    Args:
        now: the members; empty slots are at rest inside the container.
        alpha, dissipative_constant: of pairs, one number or one per pair.
        material: of walls and drag, one number or one per member.
        scene: the gas.
        chosen: the pairs.
        duration: of the block.
        num_steps: number of steps.
    """
    dt, own = duration / num_steps, (alpha, 0.5 * alpha, dissipative_constant)

    def step(_, carry: tuple[Moving, _Sums]) -> tuple[Moving, _Sums]:
        return _step(*carry, own, material, scene, chosen, dt)

    first = steps.overlap(now.x, chosen.a, chosen.b, chosen.offset)[2]
    sums = _Sums.none(chosen, now.x, first)
    if scene.walls is not None:
        sums = sums._replace(touched=jnp.any(walls.overlaps(scene.walls, now.x).xi > 0, axis=-1))
    now, dragged = flown(scene, now, 0.5 * dt, material)
    sums = sums._replace(to_drag=sums.to_drag + dragged)
    now, sums = jax.lax.fori_loop(0, num_steps, step, (now, sums))
    now, dragged = flown(scene, now, -0.5 * dt, material)
    sums = sums._replace(to_drag=sums.to_drag + dragged)
    return now, *_work(now.x, alpha, material, scene, chosen, sums, first)


def _work(
    x: Array,
    alpha: ArrayLike,
    material: ElementMaterial,
    scene: SoftScene,
    chosen: Encounters,
    sums: _Sums,
    first: Array,
) -> tuple[ContactWork, ElementWork]:
    """The energies of a block that ends with members at x."""
    xi, _, last = steps.overlap(x, chosen.a, chosen.b, chosen.offset)
    stored, touching = jnp.zeros(len(x), x.dtype), jnp.zeros(len(x), bool)
    if scene.walls is not None:
        stored = walls.stored(scene.walls, x)
        touching = jnp.any(walls.overlaps(scene.walls, x).xi > 0, axis=-1)
    pairs = ContactWork(
        dissipated=sums.dissipated,
        exchanged=sums.exchanged,
        begun=sums.begun + (last & ~sums.before),  # contacts that begin in the last half drift
        touched=(sums.begun > 0) | first,
        stored=steps.elastic_energy(xi, alpha),
        touching=last,
    )
    members = ElementWork(
        to_walls=sums.to_walls,
        to_drag=sums.to_drag,
        exchanged=sums.by_walls,
        stored=stored,
        touched=sums.touched | touching,
        touching=touching,
    )
    return pairs, members

"""Forces on soft spheres, and the time steps of the spheres that may touch within a block.

Units: see `jaxgran.scene.reduced.SphereScene`. Spins are (sigma/2) w.

Without drag a sphere flies freely between contacts. With drag ``dv/dt = -gamma v``, so that
``v(t) = v exp(-gamma t)`` and ``x(t) = x + v (1 - exp(-gamma t))/gamma``: a sphere flies along the
same straight line, only more slowly.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.elements import flight_time, surface_velocity, torque
from jaxgran.scene.contact import contact_force, midpoint_rate
from jaxgran.scene.reduced import ReducedContact, ReducedFriction, ReducedScene, SphereScene


class ContactCandidates(NamedTuple):
    """Pairs that may touch in a block, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        a, b: the slots of the two particles of each pair.
        offset: of the pair, as in `Pairs`.
        replica: to which the pair belongs.
        expected: whether all neighbours of both particles are included, so that a contact of this
            pair cannot make one of them hit a particle outside the selection.
        expected_at_walls: whether all neighbours of a member are included.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
    """

    members: Int[Array, "members"]
    a: Int[Array, "contacts"]
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]
    expected_at_walls: Bool[Array, "members"]
    needed: Int[Array, "kinds"]


class Spheres(NamedTuple):
    """Positions, velocities and spins of spheres; smooth spheres have no spins."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    spin: Any


def block_members(scene: SphereScene, spheres: Spheres, slots: Int[Array, "members"]) -> Spheres:
    """Return the members of a block; an empty slot is at rest, and not in a wall."""
    members = jax.tree.map(lambda x: x.at[slots].get(mode="fill", fill_value=0.0), spheres)
    if scene.container is None:
        return members
    real = (slots < len(spheres.x))[:, None]
    return members._replace(x=jnp.where(real, members.x, 0.5 * scene.container[None]))


def _column(values: Array) -> Array:
    """Return numbers of spheres as a column, and a number of all spheres as it is."""
    return values[:, None] if jnp.ndim(values) else values


def fly(
    scene: SphereScene, spheres: Spheres, duration: ArrayLike, material: ReducedScene
) -> tuple[Spheres, Float[Array, "n"] | None]:
    """Return spheres after a flight, and the energy that each lost to drag, None without drag.

    Args:
        scene: for the unit of the rates of drag.
        spheres: before the flight.
        duration: of the flight; negative for a flight backwards in time.
        material: with rates of drag for all spheres, or for each of them.
    """
    x, v, spin = spheres
    if material.drag is None:
        return Spheres(x + v * duration, v, spin), None
    rate, spin_rate = scene._replace(material=material).drag_rates

    def decayed(vectors: Array, rate: Array) -> tuple[Array, Array]:
        """Return vectors after the flight, and the loss of half their square."""
        loss = -0.5 * jnp.expm1(-2 * rate * duration) * jnp.sum(vectors * vectors, -1)
        return vectors * _column(jnp.exp(-rate * duration)), loss

    x = x + v * _column(flight_time(rate, duration))
    v, lost = decayed(v, rate)
    if spin is not None:
        spin, rotational_loss = decayed(spin, spin_rate)
        lost += material.surface.inertia * rotational_loss
    return Spheres(x, v, spin), lost


def overlap(
    x: Float[Array, "members d"],
    a: Int[Array, "contacts"],
    b: Int[Array, "contacts"],
    offset: Float[Array, "contacts d"],
) -> tuple[Float[Array, "contacts"], Float[Array, "contacts d"], Bool[Array, "contacts"]]:
    """Return the overlap xi (0 without contact), the normal from b to a, and which pairs touch."""
    r = x[a] - x[b] - offset
    distance2 = jnp.sum(r * r, -1)
    touching = distance2 < 1
    distance = jnp.sqrt(jnp.where(touching, distance2, 1.0))
    return 1 - distance, r / distance[:, None], touching


def wall_overlap(
    container: Float[Array, "d"], x: Float[Array, "n d"]
) -> tuple[Float[Array, "n d"], Float[Array, "n d"], Bool[Array, "n"]]:
    """Return overlaps with the nearer wall across each axis (negative without contact), 1 or -1 for
    the direction to this wall, and which spheres touch one."""
    below = 0.5 - x
    above = x - (container - 0.5)[None]
    xi = jnp.maximum(below, above)
    outwards = jnp.where(above > below, 1.0, -1.0).astype(x.dtype)
    return xi, outwards, jnp.any(xi > 0, axis=-1)


PAIR = 0.5
WALL = 1.0
"""Effective mass of two spheres, and of a sphere and a wall."""


def elastic_energy(
    xi: Float[Array, "..."], law: ReducedContact, mass: float
) -> Float[Array, "..."]:
    """Return ``(2/5) rho xi^(5/2)`` with ``rho = alpha m_eff``, 0 without contact."""
    return 0.4 * mass * law.alpha * jnp.maximum(xi, 0.0) ** 2.5


class NormalForce(NamedTuple):
    """Normal forces in a time step.

    Attributes:
        force: normal force.
        viscous: dissipative force per overlap rate.
        lost, exchanged: power lost to the dissipative force, and of the elastic force, positive.
    """

    force: Float[Array, "..."]
    viscous: Float[Array, "..."]
    lost: Float[Array, "..."]
    exchanged: Float[Array, "..."]


def normal_force(
    xi: Float[Array, "..."],
    xi_dot: Float[Array, "..."],
    law: ReducedContact,
    mass: float,
    dt: ArrayLike,
) -> NormalForce:
    """Return the forces in a time step, by the implicit midpoint rule of `midpoint_rate`.

    Args:
        xi, xi_dot: overlaps and their rates.
        law: of the contacts.
        mass: effective mass.
        dt: time step.
    """
    rho = mass * law.alpha
    A = law.dissipative_constant
    rate = midpoint_rate(xi, xi_dot, law.alpha, A, dt)
    force = contact_force(xi, rate, rho, A, clipped=law.clipped)
    elastic = contact_force(xi, 0.0, rho, 0.0)
    viscous = contact_force(xi, 1.0, rho, A) - elastic
    half_change = 0.5 / mass * dt * force
    mean = xi_dot - half_change
    # The midpoint and the trapezoidal sum of sqrt(xi) xi_dot^2 err to opposite sides.
    lost = (force - elastic) * mean + 0.5 * viscous * half_change**2
    return NormalForce(force, viscous, lost, elastic * jnp.abs(mean))


def tangential_kick(
    slip: Float[Array, "contacts d"],
    normal: NormalForce,
    surface: ReducedFriction,
    response: Float[Array, "contacts"],
    dt: ArrayLike,
) -> tuple[Float[Array, "contacts d"], Float[Array, "contacts"]]:
    """Return the kick ``-dt min(viscous |u|, limit) u/|u|`` at the mean slip u, and the energy
    lost.

    u is the mean of the slips before and after a viscous kick, as in `midpoint_rate`. The energy
    lost is exactly the change of the kinetic energy. See `jaxgran.Frictional` for the force.

    Args:
        slip: before the kick.
        normal: the normal force.
        surface: coefficients of friction.
        response: change of the slip over the kick.
        dt: time step.
    """
    viscous = surface.damping * normal.viscous
    limit = surface.friction * normal.force
    mean = slip / (1 + 0.5 * dt * viscous * response)[:, None]
    square = jnp.sum(mean * mean, -1)
    slips = square > 0
    size = jnp.sqrt(jnp.where(slips, square, 1.0))
    force = jnp.where(slips, jnp.minimum(viscous * size, limit) / size, 0.0)
    kick = -(jnp.asarray(dt) * force)[:, None] * mean
    return kick, -jnp.sum(kick * (slip + 0.5 * response[:, None] * kick), -1)


class ContactWork(NamedTuple):
    """Energies and contacts of a block, of each pair, or of each member at walls.

    Attributes:
        dissipated: energy lost.
        exchanged: work of the elastic force, with all its parts counted as positive.
        begun: number of contacts that began; None at walls.
        touching: whether there is a contact now.
        touched: whether there was one at any time.
        stored: elastic energy at the end.
    """

    dissipated: Float[Array, "rows"]
    exchanged: Float[Array, "rows"]
    begun: Any = None
    touching: Any = None
    touched: Any = None
    stored: Any = None


BlockWork = tuple[ContactWork, ContactWork | None, Float[Array, "members"] | None]
"""Energies and contacts of a block: of pairs; of each member at walls, None without walls; and the
energy that each member lost to drag, None without drag."""


def integrate(
    scene: SphereScene,
    members: Spheres,
    material: ReducedScene,
    candidates: ContactCandidates,
    duration: ArrayLike,
    num_steps: int,
) -> tuple[Spheres, BlockWork]:
    """Integrate the members of a block over its time steps.

    Drift-kick-drift steps of equal length, second order. The drift is exact, with drag too. The
    kick is by the normal forces of pairs, then by the normal forces of walls, then by the
    tangential forces of walls and of pairs. Each of them is an implicit midpoint rule at fixed
    positions.

    Args:
        scene: the gas.
        members: empty slots are at rest inside the container.
        material: each number of its law one number or one per pair; of the law of walls and of
            drag one number or one per member.
        candidates: the pairs.
        duration: of the block.
        num_steps: number of steps.

    Returns:
        The members at the end, and energies and contacts of the block.
    """
    a = candidates.a
    b = candidates.b
    offset = candidates.offset
    dt = jnp.asarray(duration / num_steps)
    container = scene.container
    dtype = members.x.dtype
    surface = material.surface
    walls_material = material.walls
    wall_law = walls_material and jax.tree.map(_column, walls_material.law)

    def rub_walls(v: Array, spin: Array, depth: Array, outwards: Array, push: NormalForce):
        """Return velocities and spins after the tangential kicks of walls, one axis after the
        other, and the energy that each member lost."""
        lost = jnp.zeros(len(spin), spin.dtype)
        for axis, unit in enumerate(jnp.eye(v.shape[1], dtype=v.dtype)):
            towards = outwards[:, axis, None] * unit[None]
            lever = 1 - 2 * depth[:, axis]  # distance from the wall
            slip = v * (1 - unit)[None] + lever[:, None] * surface_velocity(spin, towards)
            across = jax.tree.map(lambda x, axis=axis: x[:, axis], push)
            response = 1 + lever**2 / surface.inertia
            kick, taken = tangential_kick(slip, across, walls_material.surface, response, dt)
            v = v + kick
            lost = lost + taken
            spin = spin + (lever / surface.inertia)[:, None] * torque(towards, kick)
        return v, spin, lost

    def rub_pairs(v: Array, spin: Array, xi: Array, towards: Array, force: NormalForce):
        """Return velocities and spins after the tangential kicks of pairs, and the energy lost.

        They follow the normal kicks. The two commute for one contact: neither changes the velocity
        that the other depends on.
        """
        lever = 1 - xi  # the distance of the centres
        relative = v[a] - v[b]
        sideways = relative - jnp.sum(relative * towards, -1, keepdims=True) * towards
        slip = sideways + lever[:, None] * surface_velocity(spin[a] + spin[b], towards)
        response = 2 * (1 + lever**2 / surface.inertia)
        kick, lost = tangential_kick(slip, force, surface, response, dt)
        spin_change = (lever / surface.inertia)[:, None] * torque(towards, kick)
        spin = spin.at[a].add(spin_change).at[b].add(spin_change)
        return v.at[a].add(kick).at[b].add(-kick), spin, lost

    def step(_, carry: tuple[Spheres, BlockWork]) -> tuple[Spheres, BlockWork]:
        (x, v, spin), (pairs, walls, lost_to_drag) = carry
        xi, normal, touching = overlap(x, a, b, offset)
        xi_dot = -jnp.sum((v[a] - v[b]) * normal, -1)
        force = normal_force(xi, xi_dot, material.law, PAIR, dt)
        kick = (dt * force.force)[:, None] * normal
        v = v.at[a].add(kick).at[b].add(-kick)
        pairs = pairs._replace(
            dissipated=pairs.dissipated + dt * force.lost,
            exchanged=pairs.exchanged + dt * force.exchanged,
            begun=pairs.begun + (touching & ~pairs.touching).astype(pairs.begun.dtype),
            touching=touching,
        )
        if container is not None and walls is not None:
            depth, outwards, at_wall = wall_overlap(container, x)
            push = normal_force(depth, outwards * v, wall_law, WALL, dt)
            v = v - dt * push.force * outwards
            walls = walls._replace(
                dissipated=walls.dissipated + dt * jnp.sum(push.lost, -1),
                exchanged=walls.exchanged + dt * jnp.sum(push.exchanged, -1),
                touched=walls.touched | at_wall,
            )
            if walls_material.surface is not None:
                v, spin, lost = rub_walls(v, spin, depth, outwards, push)
                walls = walls._replace(dissipated=walls.dissipated + lost)
        if surface is not None:
            v, spin, lost = rub_pairs(v, spin, xi, -normal, force)
            pairs = pairs._replace(dissipated=pairs.dissipated + lost)
        spheres, lost = fly(scene, Spheres(x, v, spin), dt, material)
        return spheres, (pairs, walls, jax.tree.map(jnp.add, lost_to_drag, lost))

    touching_at_start = overlap(members.x, a, b, offset)[2]
    zeros = jnp.zeros(len(a), dtype)
    num_begun = jnp.zeros(len(a), jnp.int32)
    pairs = ContactWork(zeros, zeros, num_begun, touching_at_start)
    walls = None
    if container is not None:
        zeros = jnp.zeros(len(members.x), dtype)
        walls = ContactWork(zeros, zeros, touched=wall_overlap(container, members.x)[2])
    members, lost = fly(scene, members, 0.5 * dt, material)
    carry = members, (pairs, walls, lost)
    members, (pairs, walls, lost_to_drag) = jax.lax.fori_loop(0, num_steps, step, carry)
    members, lost = fly(scene, members, -0.5 * dt, material)

    # Contacts may also begin in the last half drift.
    xi, _, touching = overlap(members.x, a, b, offset)
    begun = pairs.begun + (touching & ~pairs.touching).astype(pairs.begun.dtype)
    pairs = pairs._replace(
        begun=begun,
        touching=touching,
        touched=(begun > 0) | touching_at_start,
        stored=elastic_energy(xi, material.law, PAIR),
    )
    if container is not None and walls is not None:
        depth, _, touching = wall_overlap(container, members.x)
        walls = walls._replace(
            touching=touching,
            touched=walls.touched | touching,
            stored=jnp.sum(elastic_energy(depth, wall_law, WALL), axis=-1),
        )
    return members, (pairs, walls, jax.tree.map(jnp.add, lost_to_drag, lost))

"""Time steps of soft spheres in contact.

Units here: the diameter and the mass are 1.

Soft spheres that may touch within one block of time steps.

Units here: the diameter is 1.

Flight between contacts, with the drag of a gas around the spheres.

``dv/dt = -gamma v`` has ``v(t) = v exp(-gamma t)`` and ``x(t) = x + v (1 - exp(-gamma t))/gamma``:
the path is that of free flight, and only the time along it differs.

Contacts of soft spheres with the flat walls of a container.

Units here: the diameter and the mass are 1. Positions are coordinates from a corner of the
container; centres of spheres that touch no wall are between 1/2 and its side less 1/2. The
periodic box is a cube longer than the container by a diameter: no sphere meets another one through
its boundary.

A gas of soft spheres in reduced units.

The tangential force of soft spheres: see `jaxgran.Frictional`.

Units here: the diameter and the mass are 1. Spins are (sigma/2) w.

Time steps of soft spheres in scenes with walls, drag or friction.

Units here: the diameter and the mass are 1.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from jaxgran.gradients.tangents import ElementMaterial, FrictionMaterial
from jaxgran.particles.neighbours import Pairs, rows_where
from jaxgran.particles.state import surface_direction, torque
from jaxgran.scene.contact import contact_force, midpoint_rate


class Encounters(NamedTuple):
    """The pairs that may touch in a block, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        a, b: the slots of the two particles of each pair.
        offset: of the pair, as in `Pairs`.
        replica: to which the pair belongs.
        expected: whether all neighbours of both particles are included, so that nothing outside of
            the selection can be hit by a contact of this pair.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
        sure: whether all neighbours of a member are included; None without walls.
    """

    members: Int[Array, "members"]
    a: Int[Array, "contacts"]
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]
    needed: Int[Array, "kinds"]
    sure: Bool[Array, "members"] | None = None

    def by_replica(self, values: Array, replicas: int) -> Shaped[Array, "replicas"]:
        """Sums of values of the pairs over each replica."""
        return jnp.zeros(replicas, values.dtype).at[self.replica].add(values)


def select_encounters(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    margin: ArrayLike,
    extra: Bool[Array, "n"],
    replicas: int,
    capacities: tuple[int, int, int],
    near_walls: Bool[Array, "n"] | None = None,
) -> Encounters:
    """The pairs that would touch in free flight, and the pairs near those.

    Args:
        position, velocity: of all particles.
        pairs: a neighbour list, with all pairs closer than 1 + margin.
        duration: of the block.
        margin: largest change of a pair's distance during the block.
        extra: particles that are known to touch another one besides.
        replicas: number of boxes, whose particles follow one another.
        capacities: for the near pairs, the contacts and the members.
        near_walls: particles that may touch a wall, which are members even without a pair.
    """
    n = len(position)
    most_near, most_contacts, most_members = capacities
    near, real, num_near = _near_pairs(position, pairs, margin, most_near)
    i, j, offset = near.i, near.j, near.offset
    touch = real & _touches_in_flight(near.apart, velocity[i] - velocity[j], duration)

    def spread(active, mask):
        ends = jnp.where(mask[None], jnp.stack([i, j]), n)
        return active.at[ends].set(True, mode="drop")

    # The particles that would touch, those near them, and all pairs near these.
    active = spread(extra if near_walls is None else extra | near_walls, touch)
    active = spread(active, real & (active[i] | active[j]))
    chosen = real & (active[i] | active[j])
    present = spread(jnp.zeros(n, bool) if near_walls is None else extra | near_walls, chosen)
    rows, num_contacts = rows_where(chosen, most_contacts)
    real = jnp.arange(most_contacts) < num_contacts
    rows = jnp.where(real, rows, 0)
    i, j, offset = i[rows], j[rows], offset[rows]
    members, num_members = rows_where(present, most_members)
    slot = jnp.cumsum(present, dtype=jnp.int32) - 1
    return Encounters(
        members=members,
        a=jnp.where(real, slot[i], 0),
        b=jnp.where(real, slot[j], 0),
        offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair out of reach
        replica=i // (n // replicas),
        expected=active[i] & active[j],
        needed=jnp.stack([pairs.count, pairs.lookahead, num_near, num_contacts, num_members]),
        sure=None if near_walls is None else active.at[members].get(mode="fill", fill_value=True),
    )


class _NearPairs(NamedTuple):
    """Pairs that are close enough to touch within the block."""

    i: Int[Array, "near"]
    j: Int[Array, "near"]
    offset: Float[Array, "near d"]
    apart: Float[Array, "near d"]  # displacement of i from j


def _near_pairs(
    position: Float[Array, "n d"], pairs: Pairs, margin: ArrayLike, capacity: int
) -> tuple[_NearPairs, Bool[Array, "{capacity}"], Int[Array, ""]]:
    """The listed pairs closer than 1 + margin, which rows hold one, and how many there are."""
    apart = position[pairs.i] - position[pairs.j] - pairs.offset
    near = jnp.sum(apart * apart, -1) < (1 + margin) ** 2
    near &= jnp.arange(near.size) < pairs.count
    rows, count = rows_where(near, capacity)
    real = jnp.arange(capacity) < count
    return _NearPairs(pairs.i[rows], pairs.j[rows], pairs.offset[rows], apart[rows]), real, count


def _touches_in_flight(
    apart: Float[Array, "near d"], relative: Float[Array, "near d"], duration: ArrayLike
) -> Bool[Array, "near"]:
    """Whether pairs come closer than a diameter in free flight of this duration."""
    distance2 = jnp.sum(apart * apart, -1)
    approach, speed2 = jnp.sum(apart * relative, -1), jnp.sum(relative * relative, -1)
    closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
    return distance2 + (2 * approach + speed2 * closest) * closest < 1.0


SERIES_BELOW = 0.01
"""gamma t below which its share of time is computed by a series, for the sake of derivatives."""


def flight_time(rate: ArrayLike, duration: ArrayLike) -> Array:
    """``(1 - exp(-gamma t))/gamma``, the duration of the free flight that goes as far."""
    z = jnp.asarray(rate * duration)
    small = jnp.abs(z) < SERIES_BELOW
    large = jnp.where(small, 1.0, z)
    series = jnp.ones_like(z)
    for k in (6, 5, 4, 3, 2):  # to z^5: the next term is 1e-15
        series = 1 - z / k * series
    return jnp.asarray(duration) * jnp.where(small, series, -jnp.expm1(-large) / large)


def velocity_factor(rate: ArrayLike, duration: ArrayLike) -> Array:
    """``exp(-gamma t)``, the velocity after a duration over that before."""
    return jnp.exp(-jnp.asarray(rate * duration))


def lost_to_drag(
    square: Float[Array, "n"], rate: ArrayLike, duration: ArrayLike
) -> Float[Array, "n"]:
    """Energy lost in a duration, ``(1 - exp(-2 gamma t))/2`` of the square of the velocities."""
    return -0.5 * jnp.expm1(-2 * jnp.asarray(rate * duration)) * square


MARGIN = 1.0
"""Diameters by which the periodic box is longer than the container."""


class SoftWalls(eqx.Module):
    """The walls of a container.

    Attributes:
        sides: of the container.
        alpha: elastic constant over effective mass, which is that of the sphere.
        dissipative_constant: A of contacts with walls.
        clipped: as for spheres.
        damping, friction: x_t and mu; None where the walls are smooth.
    """

    sides: Float[Array, "d"]
    alpha: Float[Array, ""]
    dissipative_constant: Float[Array, ""]
    clipped: bool = eqx.field(static=True, default=True)
    damping: Float[Array, ""] | None = None
    friction: Float[Array, ""] | None = None


class WallOverlaps(NamedTuple):
    """Overlaps with the nearer wall across each axis.

    Attributes:
        xi: the overlap; negative without contact.
        outwards: 1 or -1, the direction to the wall.
    """

    xi: Float[Array, "n d"]
    outwards: Float[Array, "n d"]


def wall_overlaps(walls: SoftWalls, x: Float[Array, "n d"]) -> WallOverlaps:
    """The overlaps of spheres with the nearer wall across each axis."""
    below, above = 0.5 - x, x - (walls.sides - 0.5)[None]
    return WallOverlaps(
        jnp.maximum(below, above), jnp.where(above > below, 1.0, -1.0).astype(x.dtype)
    )


def wall_energy(walls: SoftWalls, x: Float[Array, "n d"]) -> Float[Array, "n"]:
    """Elastic energy of each sphere in contacts with walls, ``(2/5) rho xi^(5/2)``, rho = alpha."""
    xi = wall_overlaps(walls, x).xi
    touching = xi > 0
    energy = 0.4 * walls.alpha * jnp.where(touching, xi, 1.0) ** 2.5
    return jnp.sum(jnp.where(touching, energy, 0.0), axis=-1)


def near_walls(
    walls: SoftWalls | None, x: Float[Array, "n d"], v: Float[Array, "n d"], duration: ArrayLike
) -> Bool[Array, "n"] | None:
    """Which spheres touch a wall now or would in free flight of this duration; None without."""
    if walls is None:
        return None
    farthest = jnp.maximum(wall_overlaps(walls, x).xi, wall_overlaps(walls, x + v * duration).xi)
    return jnp.any(farthest > 0, axis=-1)


class WallKick(NamedTuple):
    """What walls do to spheres in a time step.

    Attributes:
        v: velocities after it.
        overlaps: before it.
        force, viscous: normal force across each axis, and the change of it by a unit of speed.
        dissipated, exchanged: as in `steps.ContactWork`, of each sphere.
        touching: whether a sphere touches a wall.
    """

    v: Float[Array, "n d"]
    overlaps: WallOverlaps
    force: Float[Array, "n d"]
    viscous: Float[Array, "n d"]
    dissipated: Float[Array, "n"]
    exchanged: Float[Array, "n"]
    touching: Bool[Array, "n"]


def wall_kick(
    walls: SoftWalls,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    dt: ArrayLike,
) -> WallKick:
    """Velocities after the kick of a time step by the implicit midpoint rule of `midpoint_rate`.

    Args:
        walls: for their sides.
        x, v: of the spheres.
        alpha, dissipative_constant: of the walls, one number or one for each sphere, (n, 1).
        dt: time step.
    """
    dt = jnp.asarray(dt)
    xi, outwards = wall_overlaps(walls, x)
    xi_dot, A = outwards * v, dissipative_constant
    rate = midpoint_rate(xi, xi_dot, alpha, A, dt)
    force = contact_force(xi, rate, alpha, A, clipped=walls.clipped)
    elastic = contact_force(xi, 0.0, alpha, 0.0)
    mean, half = xi_dot - 0.5 * dt * force, 0.5 * dt * force
    viscous = contact_force(xi, 1.0, alpha, A) - elastic
    # As for pairs, the mean of the midpoint and the trapezoidal sum.
    lost = (force - elastic) * mean + 0.5 * viscous * half**2
    return WallKick(
        v=v - dt * force * outwards,
        overlaps=WallOverlaps(xi, outwards),
        force=force,
        viscous=viscous,
        dissipated=dt * jnp.sum(lost, axis=-1),
        exchanged=dt * jnp.sum(elastic * jnp.abs(mean), axis=-1),
        touching=jnp.any(xi > 0, axis=-1),
    )


class SoftDrag(NamedTuple):
    """`jaxgran.StokesDrag` in reduced units.

    Attributes:
        per_collision: gamma over the collision frequency at T = 1.
        rotational_per_collision: the same of spins.
    """

    per_collision: Float[Array, ""]
    rotational_per_collision: Float[Array, ""]


class SoftSurface(NamedTuple):
    """`jaxgran.Frictional` in reduced units.

    Attributes:
        damping: x_t.
        friction: mu.
        inertia: q.
        ratio: T_rot/T at t = 0.
    """

    damping: Float[Array, ""]
    friction: Float[Array, ""]
    inertia: Float[Array, ""]
    ratio: Float[Array, ""]


class SoftScene(eqx.Module):
    """A gas of viscoelastic spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the periodic box; it encloses a container, see `jaxgran.particles.soft.forces`.
        alpha: elastic constant over effective mass.
        dissipative_constant: A.
        contact_duration: mean duration of an elastic contact at T = 1.
        collision_frequency: collisions per particle and time at T = 1.
        clipped: whether contact ends where the force vanishes, or else where the overlap does.
        walls, drag, surface: elements of the scene; None is what it does not have.
    """

    side: Float[Array, ""]
    alpha: Float[Array, ""]
    dissipative_constant: Float[Array, ""]
    contact_duration: Float[Array, ""]
    collision_frequency: Float[Array, ""]
    clipped: bool = eqx.field(static=True, default=True)
    walls: SoftWalls | None = None
    drag: SoftDrag | None = None
    surface: SoftSurface | None = None

    @property
    def plain(self) -> bool:
        """Whether there are smooth spheres in free flight and nothing else."""
        return self.walls is None and self.drag is None and self.surface is None

    @property
    def inertial(self) -> bool:
        """Whether nothing is at rest beside the spheres: no walls and no gas that drags."""
        return self.walls is None and self.drag is None

    @property
    def material(self) -> tuple[Any, ...]:
        """The numbers that derivatives are followed in: (alpha, A) and, where there are some, those
        of walls and drag, of which rates are over the collision frequency, and of friction; or
        their tangents."""
        own = self.alpha, self.dissipative_constant
        if self.plain:
            return own
        found = *own, self._of_elements(self.drag)
        return found if self.surface is None else (*found, self.friction_material)

    def with_material(self, material: tuple[Array, Array]) -> "SoftScene":
        """The same scene of smooth spheres in free flight with another (alpha, A)."""
        alpha, constant = material
        return dataclasses.replace(self, alpha=alpha, dissipative_constant=constant)

    def log_loss(self, material: tuple[Array, Array]) -> Float[Array, ""]:
        """ln of an impact's loss, up to a constant: of ``A alpha^(2/5)``, which it is as."""
        alpha, constant = material
        return jnp.log(constant) + 0.4 * jnp.log(alpha)

    @property
    def of_elements(self) -> ElementMaterial:
        """The numbers of walls and drag."""
        drag = self.drag
        if drag is not None:
            drag = SoftDrag(*(rate * self.collision_frequency for rate in drag))
        return self._of_elements(drag)

    def _of_elements(self, drag: SoftDrag | None) -> ElementMaterial:
        rates = {}
        if drag is not None:
            rates["drag"] = drag.per_collision
            if self.surface is not None:
                rates["spin_drag"] = drag.rotational_per_collision
        if self.walls is None:
            return ElementMaterial(**rates)
        return ElementMaterial(self.walls.alpha, self.walls.dissipative_constant, **rates)

    @property
    def friction_material(self) -> FrictionMaterial | None:
        """The numbers of friction; None of smooth spheres."""
        if self.surface is None:
            return None
        found = FrictionMaterial(*self.surface)
        if self.walls is None:
            return found
        walls = self.walls
        return found._replace(wall_damping=walls.damping, wall_friction=walls.friction)

    def with_friction_material(self, material: FrictionMaterial | None) -> "SoftScene":
        """The same scene with other numbers of friction."""
        if material is None:
            return self
        *surface, damping, friction = material
        walls = self.walls
        if walls is not None:
            walls = dataclasses.replace(walls, damping=damping, friction=friction)
        return dataclasses.replace(self, surface=SoftSurface(*surface), walls=walls)

    @property
    def shortest_contact(self) -> Float[Array, ""]:
        """Mean duration of the shorter contacts, on spheres or walls, at T = 1."""
        if self.walls is None:
            return self.contact_duration
        # Durations go as alpha^(-2/5) v^(-1/5).
        on_wall = self.contact_duration * (self.alpha / self.walls.alpha) ** 0.4
        return jnp.minimum(self.contact_duration, on_wall)

    @property
    def filled_side(self) -> Float[Array, ""]:
        """Side of a cube (square) of the volume in which the spheres are."""
        if self.walls is None:
            return self.side
        return jnp.prod(self.walls.sides) ** (1 / len(self.walls.sides))

    def lossless(self) -> "SoftScene":
        """The same gas without losses: smooth spheres in a vacuum, between elastic walls."""
        walls, drag = self.walls, self.drag
        if walls is not None:
            none = 0.0 * walls.alpha
            walls = dataclasses.replace(
                walls, dissipative_constant=none, damping=None, friction=None
            )
        if drag is not None:
            drag = SoftDrag(*(0.0 * rate for rate in drag))
        zero = 0.0 * self.alpha
        return dataclasses.replace(
            self, dissipative_constant=zero, walls=walls, drag=drag, surface=None
        )


def overlap(
    x: Float[Array, "members d"],
    a: Int[Array, "contacts"],
    b: Int[Array, "contacts"],
    offset: Float[Array, "contacts d"],
) -> tuple[Float[Array, "contacts"], Float[Array, "contacts d"], Bool[Array, "contacts"]]:
    """The overlap xi (0 without contact), the normal from b to a, and which pairs touch."""
    r = x[a] - x[b] - offset
    distance2 = jnp.sum(r * r, -1)
    touching = distance2 < 1
    distance = jnp.sqrt(jnp.where(touching, distance2, 1.0))
    return 1 - distance, r / distance[:, None], touching


def elastic_energy(xi: Float[Array, "contacts"], alpha: ArrayLike) -> Float[Array, "contacts"]:
    """``(2/5) rho xi^(5/2)`` with ``rho = alpha / 2``, of spheres of mass 1."""
    return 0.2 * jnp.asarray(alpha) * xi**2.5


class ContactWork(NamedTuple):
    """Energies and contacts of a block, for each pair of its `Encounters`.

    Attributes:
        dissipated: energy lost to the dissipative force.
        exchanged: work of the elastic force, with all its parts counted as positive.
        begun: number of contacts that began.
        touched: whether the pair touched at any time.
        stored: elastic energy at the end.
        touching: whether the pair touches at the end.
    """

    dissipated: Float[Array, "contacts"]
    exchanged: Float[Array, "contacts"]
    begun: Int[Array, "contacts"]
    touched: Bool[Array, "contacts"]
    stored: Float[Array, "contacts"]
    touching: Bool[Array, "contacts"]


class PairKick(NamedTuple):
    """What the normal forces of pairs do in a time step.

    Attributes:
        xi, normal, touching: of the pairs, see `overlap`.
        force: normal force.
        viscous: dissipative force per overlap rate.
        v: velocities after it.
        work: dissipated and exchanged energy as in `ContactWork`, in all steps of the block so far.
    """

    xi: Float[Array, "contacts"]
    normal: Float[Array, "contacts d"]
    touching: Bool[Array, "contacts"]
    force: Float[Array, "contacts"]
    viscous: Float[Array, "contacts"]
    v: Float[Array, "members d"]
    work: tuple[Float[Array, "contacts"], Float[Array, "contacts"]]


def normal_kick(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    alpha: ArrayLike,
    rho: ArrayLike,
    dissipative_constant: ArrayLike,
    chosen: Encounters,
    dt: ArrayLike,
    clipped: bool,
    work: tuple[Float[Array, "contacts"], Float[Array, "contacts"]],
) -> PairKick:
    """The kick of a time step, the implicit midpoint rule of `midpoint_rate`; see `follow`.

    Args:
        rho: elastic constant, ``alpha / 2``.
        dt: time step.
        work: `PairKick.work` of the steps before.
    """
    a, b = chosen.a, chosen.b
    xi, normal, touching = overlap(x, a, b, chosen.offset)
    xi_dot = -jnp.sum((v[a] - v[b]) * normal, -1)
    rate = midpoint_rate(xi, xi_dot, alpha, dissipative_constant, dt)
    force = contact_force(xi, rate, rho, dissipative_constant, clipped=clipped)
    elastic = contact_force(xi, 0.0, rho, 0.0)
    kick = (dt * force)[:, None] * normal
    v = v.at[a].add(kick).at[b].add(-kick)
    # The midpoint and the trapezoidal sum of sqrt(xi) xi_dot^2 err to opposite sides.
    mean = xi_dot - dt * force
    viscous = contact_force(xi, 1.0, rho, dissipative_constant) - elastic
    lost = (force - elastic) * mean + 0.5 * viscous * (dt * force) ** 2
    dissipated, exchanged = work
    dissipated += dt * lost
    exchanged += dt * elastic * jnp.abs(mean)
    return PairKick(xi, normal, touching, force, viscous, v, (dissipated, exchanged))


def integrate_smooth(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    chosen: Encounters,
    duration: ArrayLike,
    num_steps: int,
    clipped: bool,
) -> tuple[Float[Array, "members d"], Float[Array, "members d"], ContactWork]:
    """Positions and velocities of the members of a block after its time steps.

    Drift-kick-drift steps of equal length, second order; for the kick see `kicked`.

    Args:
        x, v: positions and velocities of the members.
        alpha: elastic constant over effective mass, one number or one per pair.
        dissipative_constant: A, likewise.
        chosen: the pairs.
        duration: of the block.
        num_steps: number of steps.
        clipped: whether contacts end at zero force, as in `contact_force`.
    """
    rho, dt = 0.5 * alpha, duration / num_steps
    a, b, offset = chosen.a, chosen.b, chosen.offset

    def step(_, carry):
        x, v, *work, begun, before = carry
        kick = normal_kick(x, v, alpha, rho, dissipative_constant, chosen, dt, clipped, (*work,))
        begun += kick.touching & ~before
        return x + dt * kick.v, kick.v, *kick.work, begun, kick.touching

    zeros, first = jnp.zeros(len(a), x.dtype), overlap(x, a, b, offset)[2]
    carry = x + 0.5 * dt * v, v, zeros, zeros, jnp.zeros(len(a), jnp.int32), first
    end = jax.lax.fori_loop(0, num_steps, step, carry)
    x, v, dissipated, exchanged, begun, touching = end
    x = x - 0.5 * dt * v
    xi, _, last = overlap(x, a, b, offset)
    work = ContactWork(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=begun + (last & ~touching),  # contacts that begin in the last half drift
        touched=(begun > 0) | first,
        stored=elastic_energy(xi, alpha),
        touching=last,
    )
    return x, v, work


class FrictionKick(NamedTuple):
    """Velocities and spins after the tangential kick of a time step, and the energy lost in it, of
    each contact or member."""

    v: Float[Array, "members d"]
    spin: Float[Array, "members spins"]
    dissipated: Float[Array, "..."]


def tangential_kick(
    slip: Float[Array, "contacts d"],
    viscous: Float[Array, "contacts"],
    limit: Float[Array, "contacts"],
    response: Float[Array, "contacts"],
    dt: ArrayLike,
) -> tuple[Float[Array, "contacts d"], Float[Array, "contacts"]]:
    """The kick ``-dt min(viscous |u|, limit) u/|u|`` at the mean slip u, and the energy lost.

    The mean is that of the slips before and after a viscous kick, as in `midpoint_rate`; the energy
    lost is exactly the change of the kinetic energy.

    Args:
        slip: before.
        viscous: force per slip.
        limit: the largest force.
        response: change of the slip over the kick.
        dt: time step.
    """
    dt = jnp.asarray(dt)
    mean = slip / (1 + 0.5 * dt * viscous * response)[:, None]
    square = jnp.sum(mean * mean, -1)
    slips = square > 0
    size = jnp.sqrt(jnp.where(slips, square, 1.0))
    force = jnp.where(slips, jnp.minimum(viscous * size, limit) / size, 0.0)
    kick = -(dt * force)[:, None] * mean
    return kick, -jnp.sum(kick * (slip + 0.5 * response[:, None] * kick), -1)


def friction_kick(
    surface: SoftSurface,
    spin: Float[Array, "members spins"],
    normal: PairKick,
    chosen: Encounters,
    dt: ArrayLike,
) -> FrictionKick:
    """The tangential kick of a time step, which follows the normal one.

    The two commute for one contact: neither changes the velocity that the other depends on.

    Args:
        surface: of the spheres.
        spin: of the members.
        normal: the normal kick.
        chosen: the pairs.
        dt: time step.
    """
    a, b, v, towards = chosen.a, chosen.b, normal.v, -normal.normal
    lever = 1 - normal.xi  # distance of the centres
    relative = v[a] - v[b]
    sideways = relative - jnp.sum(relative * towards, -1, keepdims=True) * towards
    slip = sideways + lever[:, None] * surface_direction(spin[a] + spin[b], towards)
    kick, lost = tangential_kick(
        slip,
        surface.damping * normal.viscous,
        surface.friction * normal.force,
        2 * (1 + lever**2 / surface.inertia),
        dt,
    )
    spin_change = (lever / surface.inertia)[:, None] * torque(towards, kick)
    return FrictionKick(
        v=v.at[a].add(kick).at[b].add(-kick),
        spin=spin.at[a].add(spin_change).at[b].add(spin_change),
        dissipated=lost,
    )


def wall_friction_kick(
    walls: SoftWalls,
    surface: SoftSurface,
    spin: Float[Array, "members spins"],
    normal: WallKick,
    dt: ArrayLike,
) -> FrictionKick:
    """The tangential kicks of a time step by walls, one axis after the other.

    Args:
        walls: which rub.
        surface: of the spheres.
        spin: of the members.
        normal: the normal kicks.
        dt: time step.
    """
    assert walls.damping is not None and walls.friction is not None
    v, lost = normal.v, jnp.zeros(len(spin), spin.dtype)
    for axis, along in enumerate(jnp.eye(v.shape[1], dtype=v.dtype)):
        towards = normal.overlaps.outwards[:, axis, None] * along[None]
        lever = 1 - 2 * normal.overlaps.xi[:, axis]  # distance from the wall
        sideways = v * (1 - along)[None]
        kick, taken = tangential_kick(
            sideways + lever[:, None] * surface_direction(spin, towards),
            walls.damping * normal.viscous[:, axis],
            walls.friction * normal.force[:, axis],
            1 + lever**2 / surface.inertia,
            dt,
        )
        v, lost = v + kick, lost + taken
        spin = spin + (lever / surface.inertia)[:, None] * torque(towards, kick)
    return FrictionKick(v, spin, lost)


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


class Spheres(NamedTuple):
    """Spheres that move: positions, velocities, and spins of those that have some."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    spin: Float[Array, "n spins"] | None


def block_members(scene: SoftScene, everyone: Spheres, slots: Int[Array, "members"]) -> Spheres:
    """The members of a block; an empty slot is at rest, and not in a wall."""

    def rows(rest: Array) -> Array:
        return rest.at[slots].get(mode="fill", fill_value=0.0)

    x, v = rows(everyone.x), rows(everyone.v)
    spin = None if everyone.spin is None else rows(everyone.spin)
    if scene.walls is not None:
        real = (slots < len(everyone.x))[:, None]
        x = jnp.where(real, x, 0.5 * scene.walls.sides[None])
    return Spheres(x, v, spin)


def fly(
    scene: SoftScene, now: Spheres, duration: ArrayLike, material: ElementMaterial
) -> tuple[Spheres, ArrayLike]:
    """Spheres after a flight, and the energy that each lost to drag.

    Args:
        scene: for the inertia of spins.
        now: the spheres.
        duration: of the flight; negative backwards.
        material: with the rates of drag, one number or one for each sphere; None without drag.
    """
    (x, v, spin), rate = now, material.drag
    if rate is None:
        return Spheres(x + v * duration, v, spin), 0.0
    path, left = flight_time(rate, duration), velocity_factor(rate, duration)
    path, left = (f[:, None] if jnp.ndim(f) else f for f in (path, left))
    lost = lost_to_drag(jnp.sum(v * v, -1), rate, duration)
    x, v = x + v * path, v * left
    if spin is not None and scene.surface is not None:
        slowing, q = material.spin_drag, scene.surface.inertia
        lost = lost + q * lost_to_drag(jnp.sum(spin * spin, -1), slowing, duration)
        left = velocity_factor(slowing, duration)
        spin = spin * (left[:, None] if jnp.ndim(left) else left)
    return Spheres(x, v, spin), lost


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
    now: Spheres,
    sums: _Sums,
    own: tuple[ArrayLike, ArrayLike, ArrayLike],
    material: ElementMaterial,
    scene: SoftScene,
    chosen: Encounters,
    dt: ArrayLike,
) -> tuple[Spheres, _Sums]:
    """A kick and a drift; `own` is (alpha, rho, A) of pairs."""
    x, v, spin = now
    kick = normal_kick(x, v, *own, chosen, dt, scene.clipped, sums[:2])
    v, (dissipated, exchanged) = kick.v, kick.work
    if scene.walls is not None:
        wall = wall_kick(scene.walls, x, v, *material.of_walls(), dt)
        v = wall.v
        sums = sums._replace(
            to_walls=sums.to_walls + wall.dissipated,
            by_walls=sums.by_walls + wall.exchanged,
            touched=sums.touched | wall.touching,
        )
        if scene.walls.friction is not None and scene.surface is not None and spin is not None:
            by_wall = wall_friction_kick(scene.walls, scene.surface, spin, wall, dt)
            v, spin = by_wall.v, by_wall.spin
            sums = sums._replace(to_walls=sums.to_walls + by_wall.dissipated)
    if scene.surface is not None and spin is not None:
        rubbed = friction_kick(scene.surface, spin, kick._replace(v=v), chosen, dt)
        v, spin, dissipated = rubbed.v, rubbed.spin, dissipated + rubbed.dissipated
    moved, dragged = fly(scene, Spheres(x, v, spin), dt, material)
    return moved, sums._replace(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=sums.begun + (kick.touching & ~sums.before),
        before=kick.touching,
        to_drag=sums.to_drag + dragged,
    )


def integrate_with_elements(
    now: Spheres,
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    material: ElementMaterial,
    scene: SoftScene,
    chosen: Encounters,
    duration: ArrayLike,
    num_steps: int,
) -> tuple[Spheres, ContactWork, ElementWork]:
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

    def step(_, carry: tuple[Spheres, _Sums]) -> tuple[Spheres, _Sums]:
        return _step(*carry, own, material, scene, chosen, dt)

    first = overlap(now.x, chosen.a, chosen.b, chosen.offset)[2]
    sums = _Sums.none(chosen, now.x, first)
    if scene.walls is not None:
        sums = sums._replace(touched=jnp.any(wall_overlaps(scene.walls, now.x).xi > 0, axis=-1))
    now, dragged = fly(scene, now, 0.5 * dt, material)
    sums = sums._replace(to_drag=sums.to_drag + dragged)
    now, sums = jax.lax.fori_loop(0, num_steps, step, (now, sums))
    now, dragged = fly(scene, now, -0.5 * dt, material)
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
    xi, _, last = overlap(x, chosen.a, chosen.b, chosen.offset)
    stored, touching = jnp.zeros(len(x), x.dtype), jnp.zeros(len(x), bool)
    if scene.walls is not None:
        stored = wall_energy(scene.walls, x)
        touching = jnp.any(wall_overlaps(scene.walls, x).xi > 0, axis=-1)
    pairs = ContactWork(
        dissipated=sums.dissipated,
        exchanged=sums.exchanged,
        begun=sums.begun + (last & ~sums.before),  # contacts that begin in the last half drift
        touched=(sums.begun > 0) | first,
        stored=elastic_energy(xi, alpha),
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

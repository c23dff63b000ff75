"""Forces on soft spheres, and the time steps of the spheres that may touch within a block.

Units here: the diameter and the mass are 1. Spins are (sigma/2) w.

Without drag a sphere flies freely between contacts. With drag ``dv/dt = -gamma v``, so that
``v(t) = v exp(-gamma t)`` and ``x(t) = x + v (1 - exp(-gamma t))/gamma``: the path is that of free
flight, and only the time along it differs.

In a container positions are coordinates from a corner, and the centre of a sphere that touches no
wall lies between 1/2 and the container's side less 1/2. The periodic box is a cube longer than the
container by a diameter, so that no sphere meets another one through its boundary.
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

BOX_MARGIN = 1.0
"""Diameters by which the periodic box is longer than the container."""


class SoftWalls(eqx.Module):
    """Walls of a container.

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


class SoftDrag(NamedTuple):
    """`jaxgran.StokesDrag` in reduced units.

    Attributes:
        per_collision: gamma over the collision frequency at T = 1.
        rotational_per_collision: rotational drag rate over the same frequency.
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
        clipped: whether a contact ends where the force vanishes; otherwise it ends where the
            overlap does.
        walls, drag, surface: elements of the scene; None for an element that the scene does not
            have.
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
    def has_elements(self) -> bool:
        """True unless the scene has only smooth spheres in free flight."""
        return not (self.walls is None and self.drag is None and self.surface is None)

    @property
    def galilean_invariant(self) -> bool:
        """True if any frame at constant velocity will do: there are no walls and no drag."""
        return self.walls is None and self.drag is None

    @property
    def material(self) -> tuple[Any, ...]:
        """The numbers in which derivatives are taken.

        They are (alpha, A); in a scene with elements also the numbers of walls and drag, with the
        rates over the collision frequency, and those of friction. Tangents have the same structure.
        """
        pair_material = self.alpha, self.dissipative_constant
        if not self.has_elements:
            return pair_material
        numbers = *pair_material, self._element_material(self.drag)
        return numbers if self.surface is None else (*numbers, self.friction_material)

    def with_material(self, material: tuple[Array, Array]) -> "SoftScene":
        """Return this scene of smooth spheres in free flight with another (alpha, A)."""
        alpha, constant = material
        return dataclasses.replace(self, alpha=alpha, dissipative_constant=constant)

    def log_loss(self, material: tuple[Array, Array]) -> Float[Array, ""]:
        """Return ln of an impact's loss, ``A alpha^(2/5)`` up to a constant factor."""
        alpha, constant = material
        return jnp.log(constant) + 0.4 * jnp.log(alpha)

    @property
    def element_material(self) -> ElementMaterial:
        """The numbers of walls and drag, with rates in units of the time of the scene."""
        drag = self.drag
        if drag is not None:
            drag = SoftDrag(*(rate * self.collision_frequency for rate in drag))
        return self._element_material(drag)

    def _element_material(self, drag: SoftDrag | None) -> ElementMaterial:
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
        material = FrictionMaterial(*self.surface)
        if self.walls is None:
            return material
        walls = self.walls
        return material._replace(wall_damping=walls.damping, wall_friction=walls.friction)

    def with_friction_material(self, material: FrictionMaterial | None) -> "SoftScene":
        """Return this scene with other numbers of friction."""
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
        """Side of a cube (square) with the volume that is open to the spheres."""
        if self.walls is None:
            return self.side
        return jnp.prod(self.walls.sides) ** (1 / len(self.walls.sides))

    def lossless(self) -> "SoftScene":
        """Return the gas without losses: smooth spheres in a vacuum, between elastic walls."""
        walls, drag = self.walls, self.drag
        if walls is not None:
            no_constant = 0.0 * walls.alpha
            walls = dataclasses.replace(
                walls, dissipative_constant=no_constant, damping=None, friction=None
            )
        if drag is not None:
            drag = SoftDrag(*(0.0 * rate for rate in drag))
        zero = 0.0 * self.alpha
        return dataclasses.replace(
            self, dissipative_constant=zero, walls=walls, drag=drag, surface=None
        )


class ContactCandidates(NamedTuple):
    """Pairs that may touch in a block, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        a, b: the slots of the two particles of each pair.
        offset: of the pair, as in `Pairs`.
        replica: to which the pair belongs.
        expected: whether all neighbours of both particles are included, so that a contact of this
            pair cannot make one of them hit a particle outside the selection.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
        expected_at_walls: whether all neighbours of a member are included; None without walls.
    """

    members: Int[Array, "members"]
    a: Int[Array, "contacts"]
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]
    needed: Int[Array, "kinds"]
    expected_at_walls: Bool[Array, "members"] | None = None

    def sum_by_replica(self, values: Array, replicas: int) -> Shaped[Array, "replicas"]:
        """Return the sums of values of pairs over each replica."""
        return jnp.zeros(replicas, values.dtype).at[self.replica].add(values)


def select_contact_candidates(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    margin: ArrayLike,
    extra: Bool[Array, "n"],
    replicas: int,
    capacities: tuple[int, int, int],
    near_walls: Bool[Array, "n"] | None = None,
) -> ContactCandidates:
    """Select the pairs that would touch in free flight, and the pairs near those.

    Args:
        position, velocity: of all particles.
        pairs: a neighbour list, with all pairs closer than 1 + margin.
        duration: of the block.
        margin: largest change of a pair's distance during the block.
        extra: further particles that are known to touch another one.
        replicas: number of boxes, whose particles follow one another.
        capacities: for the near pairs, the contacts and the members.
        near_walls: particles that may touch a wall, which are members even without a pair.
    """
    n = len(position)
    max_near, max_contacts, max_members = capacities
    near, real, num_near = _near_pairs(position, pairs, margin, max_near)
    i, j, offset = near.i, near.j, near.offset
    touching = real & _touches_in_flight(near.displacement, velocity[i] - velocity[j], duration)

    def mark_ends(active, mask):
        ends = jnp.where(mask[None], jnp.stack([i, j]), n)
        return active.at[ends].set(True, mode="drop")

    # The particles that would touch, those near them, and all pairs near these.
    active = mark_ends(extra if near_walls is None else extra | near_walls, touching)
    active = mark_ends(active, real & (active[i] | active[j]))
    selected = real & (active[i] | active[j])
    is_member = mark_ends(
        jnp.zeros(n, bool) if near_walls is None else extra | near_walls, selected
    )
    rows, num_contacts = rows_where(selected, max_contacts)
    real = jnp.arange(max_contacts) < num_contacts
    rows = jnp.where(real, rows, 0)
    i, j, offset = i[rows], j[rows], offset[rows]
    members, num_members = rows_where(is_member, max_members)
    slot = jnp.cumsum(is_member, dtype=jnp.int32) - 1
    expected_at_walls = None
    if near_walls is not None:
        expected_at_walls = active.at[members].get(mode="fill", fill_value=True)
    return ContactCandidates(
        members=members,
        a=jnp.where(real, slot[i], 0),
        b=jnp.where(real, slot[j], 0),
        offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair out of reach
        replica=i // (n // replicas),
        expected=active[i] & active[j],
        needed=jnp.stack([pairs.count, pairs.lookahead, num_near, num_contacts, num_members]),
        expected_at_walls=expected_at_walls,
    )


class _NearPairs(NamedTuple):
    """Pairs that are close enough to touch within the block."""

    i: Int[Array, "near"]
    j: Int[Array, "near"]
    offset: Float[Array, "near d"]
    displacement: Float[Array, "near d"]  # of i from j


def _near_pairs(
    position: Float[Array, "n d"], pairs: Pairs, margin: ArrayLike, capacity: int
) -> tuple[_NearPairs, Bool[Array, "{capacity}"], Int[Array, ""]]:
    """Return the listed pairs closer than 1 + margin, which rows hold a pair, and their number."""
    displacement = position[pairs.i] - position[pairs.j] - pairs.offset
    near = jnp.sum(displacement * displacement, -1) < (1 + margin) ** 2
    near &= jnp.arange(near.size) < pairs.count
    rows, count = rows_where(near, capacity)
    real = jnp.arange(capacity) < count
    near_pairs = _NearPairs(pairs.i[rows], pairs.j[rows], pairs.offset[rows], displacement[rows])
    return near_pairs, real, count


def _touches_in_flight(
    displacement: Float[Array, "near d"], relative: Float[Array, "near d"], duration: ArrayLike
) -> Bool[Array, "near"]:
    """Return whether pairs come closer than a diameter in free flight of this duration."""
    distance2 = jnp.sum(displacement * displacement, -1)
    approach, speed2 = jnp.sum(displacement * relative, -1), jnp.sum(relative * relative, -1)
    closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
    return distance2 + (2 * approach + speed2 * closest) * closest < 1.0


class Spheres(NamedTuple):
    """Positions, velocities and spins of spheres; smooth spheres have no spins."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    spin: Float[Array, "n spins"] | None


def block_members(scene: SoftScene, spheres: Spheres, slots: Int[Array, "members"]) -> Spheres:
    """Return the members of a block; an empty slot is at rest, and not in a wall."""

    def take_rows(values: Array) -> Array:
        return values.at[slots].get(mode="fill", fill_value=0.0)

    x, v = take_rows(spheres.x), take_rows(spheres.v)
    spin = None if spheres.spin is None else take_rows(spheres.spin)
    if scene.walls is not None:
        real = (slots < len(spheres.x))[:, None]
        x = jnp.where(real, x, 0.5 * scene.walls.sides[None])
    return Spheres(x, v, spin)


SERIES_LIMIT = 0.01
"""Largest gamma t for which `flight_time` uses a series, which keeps derivatives accurate."""


def flight_time(rate: ArrayLike, duration: ArrayLike) -> Array:
    """Return ``(1 - exp(-gamma t))/gamma``, the duration of free flight over the same distance."""
    z = jnp.asarray(rate * duration)
    small = jnp.abs(z) < SERIES_LIMIT
    large = jnp.where(small, 1.0, z)
    series = jnp.ones_like(z)
    for k in (6, 5, 4, 3, 2):  # to z^5: the next term is 1e-15
        series = 1 - z / k * series
    return jnp.asarray(duration) * jnp.where(small, series, -jnp.expm1(-large) / large)


def velocity_factor(rate: ArrayLike, duration: ArrayLike) -> Array:
    """Return ``exp(-gamma t)``, the velocity after a duration over that before."""
    return jnp.exp(-jnp.asarray(rate * duration))


def drag_loss(square: Float[Array, "n"], rate: ArrayLike, duration: ArrayLike) -> Float[Array, "n"]:
    """Return the energy lost in a duration, ``(1 - exp(-2 gamma t))/2`` of the velocity squared."""
    return -0.5 * jnp.expm1(-2 * jnp.asarray(rate * duration)) * square


def fly(
    scene: SoftScene, spheres: Spheres, duration: ArrayLike, material: ElementMaterial
) -> tuple[Spheres, ArrayLike]:
    """Return spheres after a flight, and the energy that each lost to drag.

    Args:
        scene: for the inertia of spins.
        spheres: before the flight.
        duration: of the flight; negative for a flight backwards in time.
        material: with the rates of drag, one number or one for each sphere; None without drag.
    """
    (x, v, spin), rate = spheres, material.drag
    if rate is None:
        return Spheres(x + v * duration, v, spin), 0.0
    path, factor = flight_time(rate, duration), velocity_factor(rate, duration)
    path, factor = (f[:, None] if jnp.ndim(f) else f for f in (path, factor))
    lost = drag_loss(jnp.sum(v * v, -1), rate, duration)
    x, v = x + v * path, v * factor
    if spin is not None and scene.surface is not None:
        spin_rate, q = material.spin_drag, scene.surface.inertia
        lost = lost + q * drag_loss(jnp.sum(spin * spin, -1), spin_rate, duration)
        factor = velocity_factor(spin_rate, duration)
        spin = spin * (factor[:, None] if jnp.ndim(factor) else factor)
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


def elastic_energy(xi: Float[Array, "contacts"], alpha: ArrayLike) -> Float[Array, "contacts"]:
    """Return ``(2/5) rho xi^(5/2)`` with ``rho = alpha / 2``, for spheres of mass 1."""
    return 0.2 * jnp.asarray(alpha) * xi**2.5


class ContactWork(NamedTuple):
    """Energies and contacts of a block, for each pair of its `ContactCandidates`.

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
    """Effect of the normal forces of pairs in a time step.

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
    candidates: ContactCandidates,
    dt: ArrayLike,
    clipped: bool,
    work: tuple[Float[Array, "contacts"], Float[Array, "contacts"]],
) -> PairKick:
    """Return the kick of pairs in a time step, by the implicit midpoint rule of `midpoint_rate`.

    See `integrate_smooth` for the other arguments.

    Args:
        rho: elastic constant, ``alpha / 2``.
        dt: time step.
        work: `PairKick.work` of the steps before.
    """
    a, b = candidates.a, candidates.b
    xi, normal, touching = overlap(x, a, b, candidates.offset)
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
    candidates: ContactCandidates,
    duration: ArrayLike,
    num_steps: int,
    clipped: bool,
) -> tuple[Float[Array, "members d"], Float[Array, "members d"], ContactWork]:
    """Integrate the members of a block of smooth spheres over its time steps.

    Drift-kick-drift steps of equal length, second order; for the kick see `normal_kick`.

    Args:
        x, v: positions and velocities of the members.
        alpha: elastic constant over effective mass, one number or one per pair.
        dissipative_constant: A, likewise.
        candidates: the pairs.
        duration: of the block.
        num_steps: number of steps.
        clipped: whether contacts end at zero force, as in `contact_force`.

    Returns:
        Positions and velocities at the end, and energies and contacts of the pairs.
    """
    rho, dt = 0.5 * alpha, duration / num_steps
    a, b, offset = candidates.a, candidates.b, candidates.offset

    def step(_, carry):
        x, v, *work, num_begun, was_touching = carry
        kick = normal_kick(
            x, v, alpha, rho, dissipative_constant, candidates, dt, clipped, (*work,)
        )
        num_begun += kick.touching & ~was_touching
        return x + dt * kick.v, kick.v, *kick.work, num_begun, kick.touching

    zeros, touching_at_start = jnp.zeros(len(a), x.dtype), overlap(x, a, b, offset)[2]
    carry = x + 0.5 * dt * v, v, zeros, zeros, jnp.zeros(len(a), jnp.int32), touching_at_start
    final_carry = jax.lax.fori_loop(0, num_steps, step, carry)
    x, v, dissipated, exchanged, num_begun, touching = final_carry
    x = x - 0.5 * dt * v
    xi, _, touching_at_end = overlap(x, a, b, offset)
    work = ContactWork(
        dissipated=dissipated,
        exchanged=exchanged,
        # Contacts may also begin in the last half drift.
        begun=num_begun + (touching_at_end & ~touching),
        touched=(num_begun > 0) | touching_at_start,
        stored=elastic_energy(xi, alpha),
        touching=touching_at_end,
    )
    return x, v, work


class WallOverlaps(NamedTuple):
    """Overlaps with the nearer wall across each axis.

    Attributes:
        xi: the overlap; negative without contact.
        outwards: 1 or -1, the direction to the wall.
    """

    xi: Float[Array, "n d"]
    outwards: Float[Array, "n d"]


def wall_overlaps(walls: SoftWalls, x: Float[Array, "n d"]) -> WallOverlaps:
    """Return the overlaps of spheres with the nearer wall across each axis."""
    below, above = 0.5 - x, x - (walls.sides - 0.5)[None]
    return WallOverlaps(
        jnp.maximum(below, above), jnp.where(above > below, 1.0, -1.0).astype(x.dtype)
    )


def wall_energy(walls: SoftWalls, x: Float[Array, "n d"]) -> Float[Array, "n"]:
    """Return the elastic energy of each sphere at walls, ``(2/5) rho xi^(5/2)``, rho = alpha."""
    xi = wall_overlaps(walls, x).xi
    touching = xi > 0
    energy = 0.4 * walls.alpha * jnp.where(touching, xi, 1.0) ** 2.5
    return jnp.sum(jnp.where(touching, energy, 0.0), axis=-1)


def near_walls(
    walls: SoftWalls | None, x: Float[Array, "n d"], v: Float[Array, "n d"], duration: ArrayLike
) -> Bool[Array, "n"] | None:
    """Return which spheres touch a wall now or after free flight; None without walls."""
    if walls is None:
        return None
    deepest = jnp.maximum(wall_overlaps(walls, x).xi, wall_overlaps(walls, x + v * duration).xi)
    return jnp.any(deepest > 0, axis=-1)


class WallKick(NamedTuple):
    """Effect of the normal forces of walls in a time step.

    Attributes:
        v: velocities after it.
        overlaps: before it.
        force, viscous: normal force across each axis, and its change by a unit of speed.
        dissipated, exchanged: as in `ContactWork`, of each sphere.
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
    """Return the kick of walls in a time step, by the implicit midpoint rule of `midpoint_rate`.

    Args:
        walls: for their sides.
        x, v: positions and velocities of the spheres.
        alpha, dissipative_constant: of the walls, one number or one for each sphere, (n, 1).
        dt: time step.
    """
    dt = jnp.asarray(dt)
    xi, outwards = wall_overlaps(walls, x)
    xi_dot, A = outwards * v, dissipative_constant
    rate = midpoint_rate(xi, xi_dot, alpha, A, dt)
    force = contact_force(xi, rate, alpha, A, clipped=walls.clipped)
    elastic = contact_force(xi, 0.0, alpha, 0.0)
    mean_rate, half_change = xi_dot - 0.5 * dt * force, 0.5 * dt * force
    viscous = contact_force(xi, 1.0, alpha, A) - elastic
    # The mean of the midpoint and the trapezoidal sum, as for pairs.
    lost = (force - elastic) * mean_rate + 0.5 * viscous * half_change**2
    return WallKick(
        v=v - dt * force * outwards,
        overlaps=WallOverlaps(xi, outwards),
        force=force,
        viscous=viscous,
        dissipated=dt * jnp.sum(lost, axis=-1),
        exchanged=dt * jnp.sum(elastic * jnp.abs(mean_rate), axis=-1),
        touching=jnp.any(xi > 0, axis=-1),
    )


class FrictionKick(NamedTuple):
    """Effect of the tangential forces in a time step.

    Attributes:
        v, spin: velocities and spins after it.
        dissipated: energy lost in each contact, or by each member at walls.
    """

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
    """Return the kick ``-dt min(viscous |u|, limit) u/|u|`` at the mean slip u, and the energy
    lost.

    The mean is that of the slips before and after a viscous kick, as in `midpoint_rate`. The energy
    lost is exactly the change of the kinetic energy. See `jaxgran.Frictional` for the force.

    Args:
        slip: before the kick.
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
    candidates: ContactCandidates,
    dt: ArrayLike,
) -> FrictionKick:
    """Return the tangential kick of pairs in a time step, after the normal one.

    The two kicks commute for one contact: neither changes the velocity that the other depends on.

    Args:
        surface: of the spheres.
        spin: of the members.
        normal: the normal kick.
        candidates: the pairs.
        dt: time step.
    """
    a, b, v, towards = candidates.a, candidates.b, normal.v, -normal.normal
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
    """Return the tangential kicks of walls in a time step, one axis after the other.

    Args:
        walls: with friction.
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
        lost_to_walls: energy lost in contacts with walls.
        lost_to_drag: energy lost to drag.
        exchanged, stored, touched, touching: of contacts with walls, as in `ContactWork`.
    """

    lost_to_walls: Float[Array, "members"]
    lost_to_drag: Float[Array, "members"]
    exchanged: Float[Array, "members"]
    stored: Float[Array, "members"]
    touched: Bool[Array, "members"]
    touching: Bool[Array, "members"]


class ElementSums(NamedTuple):
    """Energies of a block by walls and drag, summed over each replica.

    Attributes:
        lost_to_walls, lost_to_drag, exchanged, stored: as in `ElementWork`, but of all particles.
        touches_wall: whether a particle touches a wall after the block.
    """

    lost_to_walls: Float[Array, "replicas"]
    lost_to_drag: Float[Array, "replicas"]
    exchanged: Float[Array, "replicas"]
    stored: Float[Array, "replicas"]
    touches_wall: Bool[Array, "n"]

    @classmethod
    def from_work(
        cls,
        work: ElementWork,
        members: Int[Array, "members"],
        lost_to_drag: ArrayLike,
        replicas: int,
        n: int,
    ) -> "ElementSums":
        """Sum the work on the members, and the drag on all other particles, which fly freely.

        Args:
            work: on the members.
            members: the particle in each slot.
            lost_to_drag: energy that each particle would lose to drag in free flight.
            replicas: number of boxes.
            n: number of particles in all of them.
        """

        def sum_by_replica(values: Array) -> Array:
            all_particles = jnp.zeros(n, values.dtype).at[members].set(values, mode="drop")
            return jnp.sum(all_particles.reshape(replicas, -1), axis=1)

        lost_by_all = jnp.broadcast_to(lost_to_drag, (n,)).astype(work.lost_to_drag.dtype)
        lost_by_all = lost_by_all.at[members].set(work.lost_to_drag, mode="drop")
        return cls(
            sum_by_replica(work.lost_to_walls),
            jnp.sum(lost_by_all.reshape(replicas, -1), axis=1),
            sum_by_replica(work.exchanged),
            sum_by_replica(work.stored),
            jnp.zeros(n, bool).at[members].set(work.touching, mode="drop"),
        )

    @property
    def lost(self) -> Float[Array, "replicas"]:
        """Energy lost to walls and drag."""
        return self.lost_to_walls + self.lost_to_drag


class _BlockSums(NamedTuple):
    """Sums over the steps of a block: first over pairs, then over members."""

    dissipated: Array
    exchanged: Array
    begun: Array
    was_touching: Array
    lost_to_walls: Array
    lost_to_drag: Array
    exchanged_at_walls: Array
    touched: Array

    @classmethod
    def zeros(cls, candidates: ContactCandidates, x: Array, touching: Array) -> "_BlockSums":
        pairs, members = jnp.zeros(len(candidates.a), x.dtype), jnp.zeros(len(x), x.dtype)
        zero_counts, nowhere = jnp.zeros(len(candidates.a), jnp.int32), jnp.zeros(len(x), bool)
        return cls(pairs, pairs, zero_counts, touching, members, members, members, nowhere)


def integrate_with_elements(
    members: Spheres,
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    material: ElementMaterial,
    scene: SoftScene,
    candidates: ContactCandidates,
    duration: ArrayLike,
    num_steps: int,
) -> tuple[Spheres, ContactWork, ElementWork]:
    """Integrate the members of a block in a scene with elements over its time steps.

    Drift-kick-drift steps of equal length, second order. The drift is exact, with drag too. The
    kick is by the normal forces of pairs, then by those of walls, then by tangential forces of
    walls and of pairs, each an implicit midpoint rule at fixed positions.

    Args:
        members: empty slots are at rest inside the container.
        alpha, dissipative_constant: of pairs, one number or one per pair.
        material: of walls and drag, one number or one per member.
        scene: the gas.
        candidates: the pairs.
        duration: of the block.
        num_steps: number of steps.

    Returns:
        The members at the end, and energies and contacts of the pairs and of the members.
    """
    dt, pair_material = duration / num_steps, (alpha, 0.5 * alpha, dissipative_constant)

    def step(_, carry: tuple[Spheres, _BlockSums]) -> tuple[Spheres, _BlockSums]:
        return _step(*carry, pair_material, material, scene, candidates, dt)

    touching_at_start = overlap(members.x, candidates.a, candidates.b, candidates.offset)[2]
    sums = _BlockSums.zeros(candidates, members.x, touching_at_start)
    if scene.walls is not None:
        sums = sums._replace(touched=jnp.any(wall_overlaps(scene.walls, members.x).xi > 0, axis=-1))
    members, lost_to_drag = fly(scene, members, 0.5 * dt, material)
    sums = sums._replace(lost_to_drag=sums.lost_to_drag + lost_to_drag)
    members, sums = jax.lax.fori_loop(0, num_steps, step, (members, sums))
    members, lost_to_drag = fly(scene, members, -0.5 * dt, material)
    sums = sums._replace(lost_to_drag=sums.lost_to_drag + lost_to_drag)
    return members, *_block_work(members.x, alpha, scene, candidates, sums, touching_at_start)


def _step(
    members: Spheres,
    sums: _BlockSums,
    pair_material: tuple[ArrayLike, ArrayLike, ArrayLike],
    material: ElementMaterial,
    scene: SoftScene,
    candidates: ContactCandidates,
    dt: ArrayLike,
) -> tuple[Spheres, _BlockSums]:
    x, v, spin = members
    kick = normal_kick(x, v, *pair_material, candidates, dt, scene.clipped, sums[:2])
    v, (dissipated, exchanged) = kick.v, kick.work
    if scene.walls is not None:
        wall = wall_kick(scene.walls, x, v, *material.wall_material(), dt)
        v = wall.v
        sums = sums._replace(
            lost_to_walls=sums.lost_to_walls + wall.dissipated,
            exchanged_at_walls=sums.exchanged_at_walls + wall.exchanged,
            touched=sums.touched | wall.touching,
        )
        if scene.walls.friction is not None and scene.surface is not None and spin is not None:
            wall_friction = wall_friction_kick(scene.walls, scene.surface, spin, wall, dt)
            v, spin = wall_friction.v, wall_friction.spin
            sums = sums._replace(lost_to_walls=sums.lost_to_walls + wall_friction.dissipated)
    if scene.surface is not None and spin is not None:
        tangential = friction_kick(scene.surface, spin, kick._replace(v=v), candidates, dt)
        v, spin, dissipated = tangential.v, tangential.spin, dissipated + tangential.dissipated
    members, lost_to_drag = fly(scene, Spheres(x, v, spin), dt, material)
    return members, sums._replace(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=sums.begun + (kick.touching & ~sums.was_touching),
        was_touching=kick.touching,
        lost_to_drag=sums.lost_to_drag + lost_to_drag,
    )


def _block_work(
    x: Array,
    alpha: ArrayLike,
    scene: SoftScene,
    candidates: ContactCandidates,
    sums: _BlockSums,
    touching_at_start: Array,
) -> tuple[ContactWork, ElementWork]:
    """Return the energies of a block that ends with members at x."""
    xi, _, touching_at_end = overlap(x, candidates.a, candidates.b, candidates.offset)
    stored, touching = jnp.zeros(len(x), x.dtype), jnp.zeros(len(x), bool)
    if scene.walls is not None:
        stored = wall_energy(scene.walls, x)
        touching = jnp.any(wall_overlaps(scene.walls, x).xi > 0, axis=-1)
    pairs = ContactWork(
        dissipated=sums.dissipated,
        exchanged=sums.exchanged,
        # Contacts may also begin in the last half drift.
        begun=sums.begun + (touching_at_end & ~sums.was_touching),
        touched=(sums.begun > 0) | touching_at_start,
        stored=elastic_energy(xi, alpha),
        touching=touching_at_end,
    )
    members = ElementWork(
        lost_to_walls=sums.lost_to_walls,
        lost_to_drag=sums.lost_to_drag,
        exchanged=sums.exchanged_at_walls,
        stored=stored,
        touched=sums.touched | touching,
        touching=touching,
    )
    return pairs, members

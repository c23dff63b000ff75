"""Soft spheres in blocks of time steps, with records and tangents.

Spheres that may touch are integrated by time steps; all others fly freely, which is exact. The
pairs that may touch are selected once a block. Indices are thus fixed within a block, which keeps
them out of the derivative.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, Shaped

from jaxgran._utils import status
from jaxgran.gradients.rule import Records
from jaxgran.gradients.tangents import ContactTangents, RateSums, component_along
from jaxgran.particles import neighbours, observables
from jaxgran.particles.bit_masks import rows_where
from jaxgran.particles.capacity import Capacity, max_skin
from jaxgran.particles.dynamics import time_left
from jaxgran.particles.neighbours import Pairs, select_members
from jaxgran.particles.soft.forces import (
    PAIR,
    WALL,
    ContactCandidates,
    Spheres,
    block_members,
    elastic_energy,
    fly,
    integrate,
    overlap,
    wall_overlap,
)
from jaxgran.particles.spheres import (
    FATAL,
    AbstractSphereDynamics,
    Segment,
    SphereState,
    advance_to_end,
    centred,
    common_values,
    fastest,
    kinetic_energy,
    peculiar_velocity,
    repeat_until,
    with_dissipated_energy,
)
from jaxgran.particles.start import initial_spins
from jaxgran.scene.gas import ReducedContact, ReducedScene, SphereScene
from jaxgran.theory.equations import COOLING_CORRECTION

WORK_TOLERANCE = 0.1
"""Allowed energy error of a block, over the work done by elastic forces in it."""

ENERGY_TOLERANCE = 1e-3
"""Allowed energy error in addition, over all energy.

A contact that began after the last kick holds energy that is not yet accounted for.
"""

MAX_REFINEMENT = 4096.0
"""Largest `SoftState.refinement` before the run fails."""

DRIFT_TOLERANCE = 0.05
"""Largest allowed sum of the relative energy errors of all blocks, an error of ln T."""

RECOVERY_BLOCKS = 200
"""Good blocks after which a step that was halved is doubled again."""

REACH_MARGIN = 1.5
"""Largest distance of a sphere in a block, over the free flight of the fastest sphere."""

LOSS, COLLISIONS, ROTATION = range(3)
"""Changes of which tangents have rates: energy lost, collisions, energy gained by rotation."""


class SoftState(NamedTuple):
    """Internal state of soft spheres, see `SphereState`.

    Attributes:
        elastic: energy in contacts.
        refinement: factor by which steps are shorter than `SoftDynamics.steps_per_contact` says.
        num_good: number of blocks since the step was last changed.
        drift: sum of the relative energy errors of all blocks.
        spin: of spheres with friction; None for smooth ones.
    """

    elastic: Float[Array, "replicas"]
    refinement: Float[Array, ""]
    num_good: Int[Array, ""]
    drift: Float[Array, "replicas"]
    spin: Float[Array, "n spins"] | None = None


class SoftRetry(NamedTuple):
    """What changes when a block is repeated, see `Segment`.

    Attributes:
        extra: particles whose contacts were detected only after a block had been integrated.
        reach_factor: factor by which the reach of the next block is enlarged.
    """

    extra: Bool[Array, "n"]
    reach_factor: Float[Array, ""]


class IntegratedBlock(NamedTuple):
    """A block, and what decides whether it is accepted.

    Attributes:
        state: after the block, at the time before it.
        lost: energy lost in contacts and to drag.
        exchanged: work of the elastic forces, with all its parts counted as positive.
        unexpected: particles that touched another one or a wall, although not all of their
            neighbours belong to the candidates.
        max_square_move: square of the largest distance that a member moved.
    """

    state: SphereState
    lost: Float[Array, "replicas"]
    exchanged: Float[Array, "replicas"]
    unexpected: Bool[Array, "n"]
    max_square_move: Float[Array, ""]


class SoftDynamics(AbstractSphereDynamics):
    """Viscoelastic spheres in blocks of equal time steps.

    Attributes:
        scene, shape, capacity, crowded, listed_by_skin, engine, compiled_engine: see
            `AbstractSphereDynamics`.
        steps_per_contact: steps in the mean contact duration at the current temperature.
        steps_per_block: steps for which the candidates for contact are fixed.
        projection: mean free times between thermal projections of tangents.
    """

    scene: SphereScene
    shape: tuple[int, int, int] = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    crowded: Capacity = eqx.field(static=True)
    listed_by_skin: float = eqx.field(static=True)
    engine: str = eqx.field(static=True)
    compiled_engine: str = eqx.field(static=True)
    steps_per_contact: int = eqx.field(static=True)
    steps_per_block: int = eqx.field(static=True)
    projection: Float[Array, ""]

    def elastic(self) -> "SoftDynamics":
        """Return the dynamics of smooth spheres without drag, between elastic walls."""

        def lossless(law: ReducedContact) -> ReducedContact:
            return ReducedContact(law.alpha, 0.0 * law.alpha, law.clipped)

        material = _with_surfaces(_with_laws(self.scene.material, lossless), None)
        material = material._replace(drag=jax.tree.map(lambda x: 0.0 * x, material.drag))
        return dataclasses.replace(self, scene=self.scene._replace(material=material))

    def initial_internal(self, velocity: Float[Array, "n d"], key: PRNGKeyArray) -> SoftState:
        surface = self.scene.material.surface
        spin = None
        if surface is not None:
            mean_square = (surface.ratio / surface.inertia).astype(velocity.dtype)
            spin = initial_spins(key, self.shape, mean_square)
        zeros = jnp.zeros(self.replicas, velocity.dtype)
        return SoftState(
            elastic=zeros,  # counted by the first segment
            refinement=jnp.ones((), velocity.dtype),
            num_good=jnp.zeros((), jnp.int32),
            drift=zeros,
            spin=spin,
        )

    def initial_tangents(self, state: SphereState, directions: ReducedScene) -> ContactTangents:
        spin = state.internal.spin
        changes = [LOSS, COLLISIONS]
        spin_tangent = None
        if spin is not None:
            changes.append(ROTATION)
            # Spins of q s^2 = ratio: nan along a ratio that is 0, of which they are a square root.
            ratio_tangents = directions.surface.ratio
            ratio = self.scene.material.surface.ratio
            growth = jnp.where(ratio_tangents == 0, 0.0, ratio_tangents / ratio)
            spin_tangent = 0.5 * growth[:, None, None] * spin[None]
        rates = RateSums.zero(len(changes), self.replicas, state.velocity.dtype)
        return ContactTangents.initial(directions, state.velocity, rates, spin_tangent)

    def true_velocities(self, state: SphereState) -> tuple[Array, Array | None]:
        return state.velocity, state.internal.spin

    def observe(self, state: SphereState) -> Records:
        return soft_records(state, self.scene, self.replicas)

    @jax.jit
    def prepare(self, state: SphereState, end: ArrayLike) -> tuple[SphereState, Array, ArrayLike]:
        side = self.scene.side
        inside = neighbours.wrap(side, state.position)
        image = state.image + jnp.round((state.position - inside) / side).astype(jnp.int32)
        return state._replace(position=inside, image=image), inside, end

    def run_blocks(
        self, state: SphereState, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Segment:
        x = state.position
        material = self.scene.material
        xi, _, touching = overlap(x, pairs.i, pairs.j, pairs.offset)
        touching &= jnp.arange(len(xi), dtype=jnp.int32) < pairs.count
        replica = pairs.i // (len(x) // self.replicas)
        law = _of_rows(material.law, replica)
        stored = elastic_energy(jnp.where(touching, xi, 0.0), law, PAIR)
        elastic = jnp.zeros_like(state.internal.elastic).at[replica].add(stored)
        if self.scene.container is not None:
            depth = wall_overlap(self.scene.container, x)[0]
            stored = jnp.sum(elastic_energy(depth, material.walls.law, WALL), axis=-1)
            elastic += jnp.sum(stored.reshape(self.replicas, -1), axis=1)
        state = state._replace(internal=state.internal._replace(elastic=elastic))
        retry = SoftRetry(jnp.zeros(len(x), bool), jnp.ones((), x.dtype))
        first = Segment(state, jnp.zeros((), bool), retry)
        block = partial(self._run_block, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, block, first)

    def _run_block(self, now: Segment, listed: Array, pairs: Pairs, end: ArrayLike) -> Segment:
        """Run one block, and accept it if all its contacts were expected and no check failed."""
        old = now.state
        retry = now.retry
        duration, num_left, hottest = self._block_duration(old, end)
        # The fastest sphere of all replicas, which share their blocks.
        speed = jnp.max(fastest(old.velocity, self.replicas))
        # At rest the first reach is 0, and the next one is given by the energy in contacts.
        from_contacts = (retry.reach_factor - 1) * jnp.sqrt(hottest)
        reach = (REACH_MARGIN * speed * retry.reach_factor + from_contacts) * duration
        candidates = self._select_candidates(old, pairs, duration, 2 * reach, retry.extra)
        block = self._integrate_block(old, candidates, duration)
        new = advance_to_end(block.state, duration, end, num_left <= 1)

        # A sphere outside the candidates was hit, or one went farther than the reach.
        too_far = block.max_square_move > reach**2
        repeat = too_far | jnp.any(block.unexpected)
        displacement = jnp.sqrt(jnp.max(jnp.sum((new.position - listed) ** 2, -1)))
        before = self._energy(old)
        after = self._energy(new)
        total = jnp.where(before > 0, before, 1.0)
        error = (after - before + block.lost) / total
        allowed = WORK_TOLERANCE * block.exchanged / total + ENERGY_TOLERANCE
        settings = new.internal
        num_good = settings.num_good + 1
        drift = settings.drift + error
        # The step is doubled again after enough good blocks.
        recovers = (num_good >= RECOVERY_BLOCKS) & (settings.refinement > 1)
        settings = settings._replace(
            num_good=jnp.where(recovers, 0, num_good),
            refinement=jnp.where(recovers, 0.5 * settings.refinement, settings.refinement),
            drift=drift,
        )
        energy_wrong = jnp.any(jnp.abs(error) > allowed)
        drifted = jnp.any(jnp.abs(drift) > DRIFT_TOLERANCE)
        fault = status.flag(status.SKIN_EXCEEDED, displacement > 0.5 * old.skin)
        fault |= status.flag(status.STEP_TOO_LARGE, energy_wrong)
        fault |= status.flag(status.ENERGY_DRIFT, drifted & ~energy_wrong)
        invalid = self.invalid_block(new, candidates.needed)
        fault = jnp.where(invalid > 0, invalid, fault)
        new = new._replace(internal=settings)
        accepted = (fault == status.OK) & ~repeat
        enlarged = jnp.where(too_far, 2 * retry.reach_factor, retry.reach_factor)
        state = jax.tree.map(partial(jnp.where, accepted), new, old)
        needed = jnp.maximum(old.needed, candidates.needed)
        return Segment(
            state=state._replace(status=fault, needed=needed),
            stale=accepted & (displacement + 2 * speed * duration > 0.5 * old.skin),
            retry=SoftRetry(
                extra=jnp.where(accepted, False, retry.extra | block.unexpected),
                reach_factor=jnp.where(accepted, 1.0, enlarged),
            ),
        )

    def _select_candidates(
        self,
        state: SphereState,
        pairs: Pairs,
        duration: Array,
        margin: Array,
        extra: Bool[Array, "n"],
    ) -> ContactCandidates:
        """Select the pairs that would touch in free flight, and the pairs near those.

        Particles that touch a wall before or after free flight are members even without a pair.

        Args:
            state: at the beginning of the block.
            pairs: a neighbour list, with all pairs closer than 1 + margin.
            duration: of the block.
            margin: largest change of a pair's distance during the block.
            extra: further particles that are known to touch another one.
        """
        position = state.position
        velocity = state.velocity
        container = self.scene.container
        n = len(position)
        max_near = self.capacity.near
        displacement = position[pairs.i] - position[pairs.j] - pairs.offset
        near = jnp.sum(displacement * displacement, -1) < (1 + margin) ** 2
        near &= jnp.arange(near.size, dtype=jnp.int32) < pairs.count
        rows, num_near = rows_where(near, max_near)
        real = jnp.arange(max_near, dtype=jnp.int32) < num_near
        i = pairs.i[rows]
        j = pairs.j[rows]
        offset = pairs.offset[rows]
        displacement = displacement[rows]

        # Which of them come closer than a diameter in free flight.
        relative = velocity[i] - velocity[j]
        approach = jnp.sum(displacement * relative, -1)
        speed2 = jnp.sum(relative * relative, -1)
        closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
        distance2 = jnp.sum(displacement * displacement, -1)
        touching = real & (distance2 + (2 * approach + speed2 * closest) * closest < 1.0)

        def mark_ends(active, mask):
            ends = jnp.where(mask[None], jnp.stack([i, j]), n)
            return active.at[ends].set(True, mode="drop")

        # The particles that would touch, those near them, and all pairs near these.
        alone = jnp.zeros(n, bool)
        if container is not None:
            before = position
            after = position + velocity * duration
            alone = extra | wall_overlap(container, before)[2] | wall_overlap(container, after)[2]
        active = mark_ends(extra | alone, touching)
        active = mark_ends(active, real & (active[i] | active[j]))
        selected = real & (active[i] | active[j])
        rows, real, members, (a, b), counts = select_members(
            selected, i, j, alone, self.capacity[3:]
        )
        i = i[rows]
        j = j[rows]
        offset = offset[rows]
        return ContactCandidates(
            members=members,
            a=a,
            b=b,
            offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair out of reach
            replica=i // (n // self.replicas),
            expected=active[i] & active[j],
            expected_at_walls=active.at[members].get(mode="fill", fill_value=True),
            needed=jnp.stack([pairs.count, pairs.lookahead, num_near, *counts]),
        )

    def _block_duration(self, state: SphereState, end: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the duration of the next block, the number of blocks of this length until the end,
        and the temperature of the hottest replica, with the energy in its contacts."""
        scene = self.scene
        velocity = centred(state.velocity, self.replicas)
        if not scene.galilean_invariant:  # walls and drag do not move with the centre of mass
            velocity = state.velocity.reshape(velocity.shape)
        # Without the energy in contacts a step would lengthen while all energy is stored there.
        stored = 2 * self.replicas / state.position.size * state.internal.elastic
        hottest = jnp.max(observables.temperature(velocity) + stored)
        if state.internal.spin is not None:
            hottest_spins = rotational_temperature(scene, state.internal.spin, self.replicas)
            hottest = jnp.maximum(hottest, jnp.max(hottest_spins))
        shortest_contact = scene.contact_duration
        material = scene.material
        if material.walls is not None:  # durations go as alpha^(-2/5) v^(-1/5)
            on_wall = shortest_contact * (material.law.alpha / material.walls.law.alpha) ** 0.4
            shortest_contact = jnp.minimum(shortest_contact, on_wall)
        per_contact = self.steps_per_contact * state.internal.refinement
        longest_step = shortest_contact * hottest**-0.1 / per_contact
        longest = self.steps_per_block * longest_step
        time_until_end = time_left(state, end)
        num_left = jnp.maximum(jnp.ceil(time_until_end / longest * (1 - 1e-9)), 1.0)
        return time_until_end / num_left, num_left, hottest

    def _integrate_block(
        self, state: SphereState, candidates: ContactCandidates, duration: Array
    ) -> IntegratedBlock:
        """Integrate the candidates, and let all others fly."""
        scene = self.scene
        replicas = self.replicas
        members = candidates.members
        n = len(state.position)
        replica_of_particle = jnp.arange(n) // (n // replicas)
        replica_of_member = jnp.minimum(members // (n // replicas), replicas - 1)

        def move(spheres: Spheres, material: ReducedScene):
            """Return all spheres after free flight, the members after the block, and energies."""
            material = _with_surfaces(material, scene.material)
            walls = material.walls
            if walls is not None:
                walls = walls._replace(law=_of_rows(walls.law, replica_of_member))
            stepped, work = integrate(
                scene,
                block_members(scene, spheres, members),
                material._replace(
                    law=_of_rows(material.law, candidates.replica),
                    walls=walls,
                    drag=_of_rows(material.drag, replica_of_member),
                ),
                candidates,
                duration,
                self.steps_per_block,
            )
            drag = _of_rows(material.drag, replica_of_particle)
            flown, lost_to_drag = fly(scene, spheres, duration, material._replace(drag=drag))
            return (flown, stepped), (work, lost_to_drag)

        def put_members(values: Array, new: Array) -> Array:
            return values.at[members].set(new, mode="drop")

        def sum_members(values: Array, others: ArrayLike = 0.0) -> Float[Array, "replicas"]:
            all_particles = put_members(jnp.broadcast_to(others, (n,)).astype(values.dtype), values)
            return jnp.sum(all_particles.reshape(replicas, -1), axis=1)

        spheres = Spheres(state.position, state.velocity, state.internal.spin)
        tangents = state.tangents
        if tangents is None or len(tangents.delay) == 0:
            ends, (work, lost_to_drag) = move(spheres, scene.material)
        else:
            material = _with_surfaces(scene.material)
            material, material_tangents = _material_by_replica(material, tangents)
            ends, end_tangents, (work, lost_to_drag) = jax.vmap(
                lambda *tangent: jax.jvp(move, (spheres, material), tangent, has_aux=True),
                out_axes=(None, 0, None),
            )(Spheres(tangents.position, tangents.velocity, tangents.spin), material_tangents)
            x, v, spin = jax.tree.map(jax.vmap(put_members), *end_tangents)
            tangents = tangents._replace(position=x, velocity=v, spin=spin)
        pairs, walls, member_loss = work
        x, v, spin = jax.tree.map(put_members, *ends)

        def mark(particles: Bool[Array, "n"], mask: Array, rows: Int[Array, "..."]) -> Array:
            return particles.at[jnp.where(mask, rows, n)].set(True, mode="drop")

        def sum_pairs(values: Array) -> Shaped[Array, "replicas"]:
            return jnp.zeros(replicas, values.dtype).at[candidates.replica].add(values)

        lost = sum_pairs(pairs.dissipated)
        exchanged = sum_pairs(pairs.exchanged)
        stored = sum_pairs(pairs.stored)
        partners = members[jnp.stack([candidates.a, candidates.b], 1)]
        nowhere = jnp.zeros(n, bool)
        surprise = pairs.touched & ~candidates.expected
        touching = mark(nowhere, pairs.touching[:, None], partners)
        unexpected = mark(nowhere, surprise[:, None], partners)
        if walls is not None:
            lost += sum_members(walls.dissipated)
            exchanged += sum_members(walls.exchanged)
            stored += sum_members(walls.stored)
            touching = mark(touching, walls.touching, members)
            surprise = walls.touched & ~candidates.expected_at_walls
            unexpected = mark(unexpected, surprise, members)
        lost_with_drag = lost
        if member_loss is not None and lost_to_drag is not None:
            lost_with_drag = lost + sum_members(member_loss, lost_to_drag)
        begun = sum_pairs(pairs.begun)
        moved = ends[1].x - block_members(scene, spheres, members).x
        new = state._replace(
            position=x,
            velocity=v,
            dissipated=state.dissipated + lost_with_drag,
            collisions=state.collisions + begun.astype(state.collisions.dtype),
            internal=state.internal._replace(elastic=stored, spin=spin),
        )
        if tangents is not None:
            new = new._replace(tangents=tangents._replace(free=~touching))
            new = new._replace(tangents=self._project_if_due(state, new, lost, begun, duration))
        return IntegratedBlock(
            state=new,
            lost=lost_with_drag,
            exchanged=exchanged,
            unexpected=unexpected,
            max_square_move=jnp.max(jnp.sum(moved**2, -1)),
        )

    def _energy(self, state: SphereState) -> Float[Array, "replicas"]:
        energy = kinetic_energy(state.velocity, self.replicas)
        if state.internal.spin is not None:
            inertia = self.scene.material.surface.inertia
            energy += inertia * kinetic_energy(state.internal.spin, self.replicas)
        return energy + state.internal.elastic

    def _project_if_due(
        self, old: SphereState, new: SphereState, lost: Array, begun: Array, duration: Array
    ) -> ContactTangents:
        """Return the tangents after a block, projected if a projection is due.

        `lost` and `begun` are the energy lost in contacts, and the number of those that began.
        """
        scene = self.scene
        replicas = self.replicas
        tangents = new.tangents
        velocity = peculiar_velocity(scene, new.velocity, replicas)
        T = observables.temperature(velocity)
        velocity = velocity.reshape(new.velocity.shape)
        energy = kinetic_energy(velocity, replicas)
        passed = duration * jnp.sqrt(T)
        stored = new.internal.elastic
        trend = cooling_trend(scene, T)
        collisions = 2 * replicas / len(new.position) * begun.astype(lost.dtype)
        amounts = [lost, collisions]
        trends = [(energy + stored) * trend * duration, passed]
        spin = new.internal.spin
        if spin is not None:
            # In contacts rotation gained its change less that by drag.
            first = kinetic_energy(old.internal.spin, replicas)
            last = kinetic_energy(spin, replicas)
            gain = last - first
            if (drag := scene.drag_rates) is not None:
                gain += drag.rotational_rate * duration * (first + last)
            gain = scene.material.surface.inertia * gain
            amounts = [lost + gain, collisions, gain]
            trends.append(energy * passed)
        rates = tangents.rates.after(
            jnp.stack(amounts), jnp.stack(trends), passed * scene.collision_frequency
        )
        tangents = tangents._replace(rates=rates, elapsed=tangents.elapsed + duration)
        since = tangents.elapsed * jnp.sqrt(jnp.mean(T))
        due = since * scene.collision_frequency >= self.projection
        projected = tangents.projected(velocity, spin)
        return jax.tree.map(lambda new, old: jnp.where(due, new, old), projected, tangents)

    def recover(self, now: Segment, before: SphereState) -> SphereState:
        """Halve a step that was too large, and lengthen a skin that was exceeded."""
        state = now.state
        longest = max_skin(self.scene.side)
        fresh = state.time == before.time  # otherwise a new neighbour list is enough
        exceeded = status.has(state.status, status.SKIN_EXCEEDED) & fresh
        shorten = status.has(state.status, status.STEP_TOO_LARGE)
        shorten |= exceeded & (state.skin >= longest)
        unrecoverable = shorten & (state.internal.refinement >= MAX_REFINEMENT)
        halve = shorten & ~unrecoverable
        finer = jnp.where(halve, 2 * state.internal.refinement, state.internal.refinement)
        num_good = jnp.where(halve, 0, state.internal.num_good)
        return state._replace(
            skin=jnp.where(exceeded, jnp.minimum(1.5 * state.skin, longest), state.skin),
            internal=state.internal._replace(refinement=finer, num_good=num_good),
            status=jnp.where(unrecoverable, state.status, state.status & FATAL),
        )


def _of_rows(numbers: Any, replica: Int[Array, "rows"]) -> Any:
    """Return numbers by replica as one number per row, and numbers of all replicas as they are."""
    return jax.tree.map(lambda x: x[replica] if jnp.ndim(x) else x, numbers)


def _with_laws(
    material: ReducedScene, change: Callable[[ReducedContact], ReducedContact]
) -> ReducedScene:
    walls = material.walls and material.walls._replace(law=change(material.walls.law))
    return material._replace(law=change(material.law), walls=walls)


def _faster(material: ReducedScene, factor: ArrayLike) -> ReducedScene:
    """Return the material in which spheres take the same paths a factor faster."""

    def faster(law: ReducedContact) -> ReducedContact:
        return ReducedContact(law.alpha * factor**2, law.dissipative_constant / factor, law.clipped)

    drag = jax.tree.map(lambda x: x * factor, material.drag)
    return _with_laws(material, faster)._replace(drag=drag)


def _with_surfaces(material: ReducedScene, source: ReducedScene | None = None) -> ReducedScene:
    """Return a material with the surfaces of spheres and walls of another one, or without any.

    Derivatives in the numbers of surfaces are refused, so that they have no tangents.
    """
    walls = material.walls
    if walls is not None:
        walls = walls._replace(surface=source and source.walls.surface)
    return material._replace(surface=source and source.surface, walls=walls)


def _material_by_replica(
    material: ReducedScene, tangents: ContactTangents
) -> tuple[ReducedScene, ReducedScene]:
    """Return a material without surfaces and its tangents, by replica.

    In the same material spheres that are (1 + c/2) times as fast take the paths of the original
    spheres in the material ``_faster(material, 1 - c/2)``. Only their clocks differ.
    """
    c = tangents.log_temperature
    one = jnp.ones_like(tangents.elapsed)
    by_delay = jax.jvp(partial(_faster, material), (one,), (-0.5 * one,))[1]
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, c.shape[1:]), material)
    slopes = jax.tree.map(
        lambda direction, change: direction[:, None] + c * change,
        _with_surfaces(tangents.directions),
        by_delay,
    )
    return rows, slopes


def cooling_trend(
    scene: SphereScene, temperature: Float[Array, "replicas"]
) -> Float[Array, "replicas"]:
    """Return the dependence of the cooling rate on T, ``T^(3/5) / (1 + q delta T^(1/10))``.

    It has the first two terms of the rate in the dissipation delta.
    """
    law = scene.material.law
    damping = COOLING_CORRECTION * law.dissipative_constant * law.alpha**0.4
    return temperature**0.6 / (1 + damping * temperature**0.1)


def cooling_rate(
    scene: SphereScene, tangents: ContactTangents, temperature: Float[Array, "replicas"]
) -> Float[Array, "replicas"]:
    """Return ``-d ln T/dt`` at a temperature, by contacts and drag."""
    by_contacts = tangents.rates.rate(LOSS, cooling_trend(scene, temperature))
    drag = scene.drag_rates
    return by_contacts if drag is None else by_contacts + 2 * drag.rate


def rotational_temperature(
    scene: SphereScene, spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "replicas"]:
    """Return T_rot of each replica, ``q <s^2>/d_rot``."""
    spin_by_replica = spin.reshape(replicas, -1, spin.shape[-1])
    return scene.material.surface.inertia * observables.temperature(spin_by_replica)


@partial(jax.jit, static_argnames="replicas")
def soft_records(state: SphereState, scene: SphereScene, replicas: int) -> Records:
    """Return the records of a state.

    The derivative of T is the projected tangent of the run; the derivatives of the other records
    are estimated from it. The elastic energy goes as ``T^(7/5) alpha^(-2/5)``.
    """
    values, velocity = common_values(state, scene, replicas)
    num_particles, d = velocity.shape[1:]
    values["elastic_energy"] = state.internal.elastic / num_particles
    spin = state.internal.spin
    if spin is not None:  # it is None during equilibration
        values["rotational_temperature"] = rotational_temperature(scene, spin, replicas)
    if state.tangents is None:
        return Records(values, {}, {})
    tangents = state.tangents
    T = values["temperature"]
    U = values["elastic_energy"]
    cooling = cooling_rate(scene, tangents, T)
    projected = tangents.projected(velocity.reshape(state.velocity.shape))
    c = projected.log_temperature
    stiffer = (tangents.directions.law.alpha / scene.material.law.alpha)[:, None]
    rates = {
        "temperature": -cooling * T,
        "collisions": tangents.rates.rate(COLLISIONS, jnp.sqrt(T)),
        "elastic_energy": -1.4 * cooling * U,
    }
    at_place = {
        "temperature": c * T[None],
        "collisions": jnp.zeros_like(c),
        "elastic_energy": (1.4 * c - 0.4 * stiffer) * U[None],
    }
    if spin is not None:
        T_rot = values["rotational_temperature"]
        logs = tangents.log_temperature + 2 * component_along(tangents.spin, spin, replicas)
        energy = 0.5 * d * num_particles * T
        gain = tangents.rates.rate(ROTATION, energy * jnp.sqrt(T))
        rate = 2 / (num_particles * spin.shape[1]) * gain
        if (drag := scene.drag_rates) is not None:
            rate -= 2 * drag.rotational_rate * T_rot
        at_place["rotational_temperature"] = logs * T_rot[None]
        rates["rotational_temperature"] = rate
    slopes = {name: x - rates[name][None] * projected.delay for name, x in at_place.items()}
    return Records(values, with_dissipated_energy(rates, d), with_dissipated_energy(slopes, d))

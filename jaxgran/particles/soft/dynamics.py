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
from jaxgran.particles import observables
from jaxgran.particles.bit_masks import rows_where
from jaxgran.particles.capacity import Capacity, max_skin
from jaxgran.particles.neighbours.pairs import Pairs
from jaxgran.particles.neighbours.selection import marked, select_members
from jaxgran.particles.soft.forces import (
    PAIR,
    WALL,
    BlockWork,
    ContactCandidates,
    ContactWork,
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
    next_block,
    peculiar_velocity,
    repeat_until,
    with_dissipated_energy,
)
from jaxgran.particles.start import initial_spins
from jaxgran.scene.geometry import wrap
from jaxgran.scene.reduced import ReducedContact, ReducedScene, SphereScene
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


class BlockContacts(NamedTuple):
    """Contacts of a block, and energies of each replica.

    Attributes:
        lost: energy lost in contacts.
        exchanged: see `IntegratedBlock`.
        stored: elastic energy at the end.
        begun: number of contacts that began.
        touching: particles in contact at the end.
        unexpected: see `IntegratedBlock`.
    """

    lost: Float[Array, "replicas"]
    exchanged: Float[Array, "replicas"]
    stored: Float[Array, "replicas"]
    begun: Int[Array, "replicas"]
    touching: Bool[Array, "n"]
    unexpected: Bool[Array, "n"]


class SoftDynamics(AbstractSphereDynamics):
    """Viscoelastic spheres in blocks of equal time steps.

    Attributes:
        scene, shape, capacity, equilibration_capacity, listed_by_skin, engine, compiled_engine: see
            `AbstractSphereDynamics`.
        steps_per_contact: steps in the mean contact duration at the current temperature.
        steps_per_block: steps for which the candidates for contact are fixed.
        projection: mean free times between thermal projections of tangents.
    """

    scene: SphereScene
    shape: tuple[int, int, int] = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    equilibration_capacity: Capacity = eqx.field(static=True)
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
        inside = wrap(state.position, side)
        image = state.image + jnp.round((state.position - inside) / side).astype(jnp.int32)
        return state._replace(position=inside, image=image), inside, end

    def run_blocks(
        self, state: SphereState, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Segment:
        x = state.position
        material = self.scene.material
        xi, _, touching = overlap(x, pairs.i, pairs.j, pairs.offset)
        touching &= pairs.in_use
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
        hottest = self._hottest(old)
        longest = self._longest_block(old.internal.refinement, hottest)
        duration, is_last = next_block(old, longest, end)
        # The fastest sphere of all replicas, which share their blocks.
        speed = jnp.max(fastest(old.velocity, self.replicas))
        # At rest the first reach is 0, and the next one is given by the energy in contacts.
        from_contacts = (retry.reach_factor - 1) * jnp.sqrt(hottest)
        reach = (REACH_MARGIN * speed * retry.reach_factor + from_contacts) * duration
        candidates = self._select_candidates(old, pairs, duration, 2 * reach, retry.extra)
        block = self._integrate_block(old, candidates, duration)
        new = advance_to_end(block.state, duration, end, is_last)

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
        displacement = position[pairs.i] - position[pairs.j] - pairs.offset
        near = jnp.sum(displacement * displacement, -1) < (1 + margin) ** 2
        near &= pairs.in_use
        rows, real, num_near = rows_where(near, self.capacity.near)
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

        ends = jnp.stack([i, j])
        # The particles that would touch, those near them, and all pairs near these.
        alone = jnp.zeros(n, bool)
        if container is not None:
            before = position
            after = position + velocity * duration
            alone = extra | wall_overlap(container, before)[2] | wall_overlap(container, after)[2]
        active = marked(extra | alone, ends, touching[None])
        active = marked(active, ends, (real & (active[i] | active[j]))[None])
        selected = real & (active[i] | active[j])
        max_rows = self.capacity.contacts
        max_members = self.capacity.members
        found = select_members(selected, i, j, alone, max_rows=max_rows, max_members=max_members)
        i = i[found.rows]
        j = j[found.rows]
        # An empty row is a pair out of reach.
        offset = jnp.where(found.real[:, None], offset[found.rows], 2.0)
        return ContactCandidates(
            members=found.members,
            a=found.first,
            b=found.second,
            offset=offset,
            replica=i // (n // self.replicas),
            expected=active[i] & active[j],
            expected_at_walls=active.at[found.members].get(mode="fill", fill_value=True),
            needed=jnp.stack(
                [pairs.count, pairs.lookahead, num_near, found.num_rows, found.num_members]
            ),
        )

    def _hottest(self, state: SphereState) -> Float[Array, ""]:
        """Return the temperature of the hottest replica, with the energy in its contacts."""
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
        return hottest

    def _longest_block(
        self, refinement: Float[Array, ""], hottest: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Return the duration of a block of the longest steps at a temperature."""
        shortest_contact = self.scene.contact_duration
        material = self.scene.material
        if material.walls is not None:  # durations go as alpha^(-2/5) v^(-1/5)
            on_wall = shortest_contact * (material.law.alpha / material.walls.law.alpha) ** 0.4
            shortest_contact = jnp.minimum(shortest_contact, on_wall)
        longest_step = shortest_contact * hottest**-0.1 / (self.steps_per_contact * refinement)
        return self.steps_per_block * longest_step

    def _integrate_block(
        self, state: SphereState, candidates: ContactCandidates, duration: Array
    ) -> IntegratedBlock:
        """Integrate the candidates, and let all others fly."""
        members = candidates.members
        spheres = Spheres(state.position, state.velocity, state.internal.spin)
        tangents = state.tangents
        if tangents is None or len(tangents.delay) == 0:
            ends, energies = self._moved(spheres, self.scene.material, candidates, duration)
        else:
            ends, energies, tangents = self._moved_tangents(spheres, tangents, candidates, duration)
        after = jax.tree.map(partial(_put, members), *ends)
        (pair_work, wall_work, member_loss), flight_loss = energies
        contacts = self._contacts(candidates, pair_work, wall_work)
        lost = contacts.lost
        if member_loss is not None and flight_loss is not None:
            lost = lost + self._sum_members(members, member_loss, flight_loss)
        _, stepped = ends
        moved = stepped.x - block_members(self.scene, spheres, members).x
        new = state._replace(
            position=after.x,
            velocity=after.v,
            dissipated=state.dissipated + lost,
            collisions=state.collisions + contacts.begun.astype(state.collisions.dtype),
            internal=state.internal._replace(elastic=contacts.stored, spin=after.spin),
        )
        if tangents is not None:
            new = new._replace(tangents=tangents._replace(free=~contacts.touching))
            new = new._replace(tangents=self._tangents_after(state, new, contacts, duration))
        return IntegratedBlock(
            state=new,
            lost=lost,
            exchanged=contacts.exchanged,
            unexpected=contacts.unexpected,
            max_square_move=jnp.max(jnp.sum(moved**2, -1)),
        )

    def _moved(
        self,
        spheres: Spheres,
        material: ReducedScene,
        candidates: ContactCandidates,
        duration: Array,
    ) -> tuple[tuple[Spheres, Spheres], tuple[BlockWork, Float[Array, "n"] | None]]:
        """Return all spheres after free flight, the members after a block, and energies.

        The energies are those of the block, and what each sphere lost to drag in free flight.
        """
        scene = self.scene
        replicas, size, _ = self.shape
        replica_of_particle = jnp.arange(replicas * size) // size
        replica_of_member = jnp.minimum(candidates.members // size, replicas - 1)
        material = _with_surfaces(material, scene.material)
        walls = material.walls
        if walls is not None:
            walls = walls._replace(law=_of_rows(walls.law, replica_of_member))
        stepped, work = integrate(
            scene,
            block_members(scene, spheres, candidates.members),
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
        flown, flight_loss = fly(scene, spheres, duration, material._replace(drag=drag))
        return (flown, stepped), (work, flight_loss)

    def _moved_tangents(
        self,
        spheres: Spheres,
        tangents: ContactTangents,
        candidates: ContactCandidates,
        duration: Array,
    ) -> tuple[tuple[Spheres, Spheres], tuple[BlockWork, Any], ContactTangents]:
        """Return what `_moved` returns, and the tangents of all spheres after the block."""
        material = _with_surfaces(self.scene.material)
        material, material_tangents = _material_by_replica(material, tangents)

        def tangents_along(*direction: Any) -> tuple[Any, Any, Any]:
            move = partial(self._moved, candidates=candidates, duration=duration)
            return jax.jvp(move, (spheres, material), direction, has_aux=True)

        along_all = jax.vmap(tangents_along, out_axes=(None, 0, None))
        sphere_tangents = Spheres(tangents.position, tangents.velocity, tangents.spin)
        ends, end_tangents, energies = along_all(sphere_tangents, material_tangents)
        after = jax.tree.map(jax.vmap(partial(_put, candidates.members)), *end_tangents)
        tangents = tangents._replace(position=after.x, velocity=after.v, spin=after.spin)
        return ends, energies, tangents

    def _contacts(
        self,
        candidates: ContactCandidates,
        pair_work: ContactWork,
        wall_work: ContactWork | None,
    ) -> BlockContacts:
        """Return the contacts in a block, of pairs and at walls."""
        members = candidates.members
        partners = members[jnp.stack([candidates.a, candidates.b], 1)]
        replicas, size, _ = self.shape
        none = jnp.zeros(replicas * size, bool)

        def sum_pairs(values: Array) -> Shaped[Array, "replicas"]:
            return jnp.zeros(replicas, values.dtype).at[candidates.replica].add(values)

        surprise = pair_work.touched & ~candidates.expected
        contacts = BlockContacts(
            lost=sum_pairs(pair_work.dissipated),
            exchanged=sum_pairs(pair_work.exchanged),
            stored=sum_pairs(pair_work.stored),
            begun=sum_pairs(pair_work.begun),
            touching=marked(none, partners, pair_work.touching[:, None]),
            unexpected=marked(none, partners, surprise[:, None]),
        )
        if wall_work is None:
            return contacts
        surprise = wall_work.touched & ~candidates.expected_at_walls
        return contacts._replace(
            lost=contacts.lost + self._sum_members(members, wall_work.dissipated),
            exchanged=contacts.exchanged + self._sum_members(members, wall_work.exchanged),
            stored=contacts.stored + self._sum_members(members, wall_work.stored),
            touching=marked(contacts.touching, members, wall_work.touching),
            unexpected=marked(contacts.unexpected, members, surprise),
        )

    def _sum_members(
        self, members: Int[Array, "members"], values: Array, others: ArrayLike = 0.0
    ) -> Float[Array, "replicas"]:
        """Return the sums over each replica of values of its members and of all others."""
        replicas, size, _ = self.shape
        others = jnp.broadcast_to(others, (replicas * size,)).astype(values.dtype)
        return jnp.sum(_put(members, others, values).reshape(replicas, -1), axis=1)

    def _energy(self, state: SphereState) -> Float[Array, "replicas"]:
        energy = kinetic_energy(state.velocity, self.replicas)
        if state.internal.spin is not None:
            inertia = self.scene.material.surface.inertia
            energy += inertia * kinetic_energy(state.internal.spin, self.replicas)
        return energy + state.internal.elastic

    def _tangents_after(
        self, old: SphereState, new: SphereState, contacts: BlockContacts, duration: Array
    ) -> ContactTangents:
        """Return the tangents after a block with their rates, projected if that is due."""
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
        lost = contacts.lost
        collisions = 2 * replicas / len(new.position) * contacts.begun.astype(lost.dtype)
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
        has_not_moved = state.time == before.time  # otherwise a new neighbour list is enough
        exceeded = status.has(state.status, status.SKIN_EXCEEDED) & has_not_moved
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


def _put(rows: Int[Array, "rows"], values: Array, new: Array) -> Array:
    """Return values with new ones in some rows; rows beyond the last one are left out."""
    return values.at[rows].set(new, mode="drop")


def _of_rows(numbers: Any, replica: Int[Array, "rows"]) -> Any:
    """Return numbers by replica as one number per row, and numbers of all replicas as they are."""
    return jax.tree.map(lambda x: x[replica] if jnp.ndim(x) else x, numbers)


def _with_laws(
    material: ReducedScene, change: Callable[[ReducedContact], ReducedContact]
) -> ReducedScene:
    walls = material.walls
    if walls is not None:
        walls = walls._replace(law=change(walls.law))
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
        walls = walls._replace(surface=None if source is None else source.walls.surface)
    return material._replace(surface=None if source is None else source.surface, walls=walls)


def _material_by_replica(
    material: ReducedScene, tangents: ContactTangents
) -> tuple[ReducedScene, ReducedScene]:
    """Return a material without surfaces and its tangents, by replica.

    In the same material spheres that are (1 + c/2) times as fast take the paths of the original
    spheres in the material ``_faster(material, 1 - c/2)``. Only their clocks differ.
    """
    c = tangents.log_temperature
    one = jnp.ones_like(tangents.elapsed)
    by_log_temperature = jax.jvp(partial(_faster, material), (one,), (-0.5 * one,))[1]
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, c.shape[1:]), material)
    slopes = jax.tree.map(
        lambda direction, change: direction[:, None] + c * change,
        _with_surfaces(tangents.directions),
        by_log_temperature,
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

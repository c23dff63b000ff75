"""Dynamics of soft spheres in blocks of time steps, with records and tangents.

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
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran.gradients import rule
from jaxgran.gradients.tangents import (
    ElementMaterial,
    FrictionMaterial,
    RotationTangents,
    ThermalTangents,
    initial_tangents,
    project_if_due,
    ratio_or_zero,
    thermal_projection,
    update_rates,
)
from jaxgran.particles import observables
from jaxgran.particles.capacity import Capacity, max_skin
from jaxgran.particles.dynamics import (
    AbstractDynamics,
    Progress,
    accept_if,
    initial_progress,
    repeat_until,
)
from jaxgran.particles.neighbours import Pairs
from jaxgran.particles.soft.forces import (
    ContactCandidates,
    ContactWork,
    ElementSums,
    ElementWork,
    SoftScene,
    Spheres,
    block_members,
    elastic_energy,
    fly,
    integrate_smooth,
    integrate_with_elements,
    near_walls,
    overlap,
    select_contact_candidates,
    wall_energy,
)
from jaxgran.particles.state import (
    State,
    advance_time,
    centred,
    common_records,
    derivatives_of_records,
    fastest,
    initial_spins,
    kinetic_energy,
    temperature,
    time_left,
    wrap_positions,
)
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


class SoftState(NamedTuple):
    """Internal state of soft spheres, see `State`.

    Attributes:
        elastic: energy in contacts.
        refinement: factor by which steps are shorter than `SoftDynamics.steps_per_contact` says.
        num_good: number of blocks since the step was last changed.
        drift: sum of the relative energy errors of all blocks.
        spin: of spheres with friction; None of smooth ones.
    """

    elastic: Float[Array, "replicas"]
    refinement: Float[Array, ""]
    num_good: Int[Array, ""]
    drift: Float[Array, "replicas"]
    spin: Float[Array, "n spins"] | None = None


class SoftProgress(NamedTuple):
    """Progress of soft spheres within one neighbour list, see `Progress`.

    Attributes:
        extra: particles whose contacts were detected only after a block had been integrated.
        reach_factor: factor by which the reach of the next block is enlarged.
        num_blocks: number of blocks with this neighbour list.
    """

    extra: Bool[Array, "n"]
    reach_factor: Float[Array, ""]
    num_blocks: Int[Array, ""]


class _BlockResult(NamedTuple):
    """Result of one block, not yet accepted."""

    state: State
    work: ContactWork
    max_square_move: Array  # square of the largest distance that a member moved
    sums: ElementSums | None  # energies by walls and drag
    hit_walls: Array | None  # particles that touched a wall without being expected to


class SoftDynamics(AbstractDynamics):
    """Dynamics of viscoelastic spheres in blocks of equal time steps.

    Attributes:
        scene, replicas, capacity: see `AbstractDynamics`.
        steps_per_contact: steps in the mean contact duration at the current temperature.
        steps_per_block: steps for which the candidates for contact are fixed.
        projection: mean free times between thermal projections of tangents.
    """

    scene: SoftScene
    replicas: int = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    steps_per_contact: int = eqx.field(static=True)
    steps_per_block: int = eqx.field(static=True)
    projection: Float[Array, ""]

    def initial_internal(self, num_rows, dtype) -> SoftState:
        # The elastic energy of the start is counted by the first `advance`.
        zeros = jnp.zeros(self.replicas, dtype)
        return SoftState(zeros, jnp.ones((), dtype), jnp.zeros((), jnp.int32), zeros)

    def elastic(self) -> "SoftDynamics":
        return dataclasses.replace(self, scene=self.scene.lossless())

    def with_tangents(self, state: State, directions: tuple[Any, ...]) -> State:
        tangents = initial_soft_tangents(self.scene, state, directions, self.projection)
        return state._replace(tangents=tangents)

    @property
    def region(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def galilean_invariant(self) -> bool:
        return self.scene.galilean_invariant

    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        return velocity, state.internal.spin

    def sample_spins(self, state: State, key: PRNGKeyArray, equilibrated: State) -> State:
        surface = self.scene.surface
        if surface is None:
            return state
        spin = initial_spins(key, state.velocity, self.replicas, surface.ratio / surface.inertia)
        return state._replace(internal=state.internal._replace(spin=spin))

    def observe(self, state: State) -> dict[str, Array]:
        return soft_records(state, self.scene, self.replicas)

    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, ArrayLike]:
        wrapped = wrap_positions(state, self.scene.side)
        return wrapped, wrapped.position, end

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        xi, _, touching = overlap(state.position, pairs.i, pairs.j, pairs.offset)
        touching &= jnp.arange(len(xi)) < pairs.count
        stored = elastic_energy(jnp.where(touching, xi, 0.0), self.scene.alpha)
        replica = pairs.i // (len(state.position) // self.replicas)
        elastic = jnp.zeros_like(state.internal.elastic).at[replica].add(stored)
        if self.scene.walls is not None:
            wall_energies = wall_energy(self.scene.walls, state.position)
            elastic += jnp.sum(wall_energies.reshape(self.replicas, -1), axis=1)
        internal = SoftProgress(
            extra=jnp.zeros(len(state.position), bool),
            reach_factor=jnp.ones((), state.position.dtype),
            num_blocks=jnp.zeros((), jnp.int32),
        )
        state = state._replace(internal=state.internal._replace(elastic=elastic))
        first = initial_progress(state, pairs, self.capacity, internal)
        block = partial(self._advance_block, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, block, first)

    def _advance_block(
        self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike
    ) -> Progress:
        """Run one block, and accept it if all its contacts were expected and no check failed."""
        old, internal = now.state, now.internal
        duration, num_left, hottest = self._block_duration(old, end)
        # The fastest sphere of all replicas, which share their blocks.
        speed = jnp.max(fastest(old.velocity, self.replicas))
        # At rest the first reach is 0, and the next one is given by the energy in contacts.
        from_contacts = (internal.reach_factor - 1) * jnp.sqrt(hottest)
        reach = REACH_MARGIN * speed * internal.reach_factor + from_contacts
        reach = reach * duration
        candidates = select_contact_candidates(
            old.position,
            old.velocity,
            pairs,
            duration,
            2 * reach,
            internal.extra,
            self.replicas,
            self.capacity[2:],
            near_walls(self.scene.walls, old.position, old.velocity, duration),
        )
        result = self._integrate_block(old, candidates, duration)
        new = result.state
        new = advance_time(new, duration, end, num_left <= 1)
        if old.tangents is not None:
            old_spin = old.internal.spin
            tangents = tangents_after_block(
                new, old_spin, candidates, result.work, result.sums, duration, self.scene
            )
            new = new._replace(tangents=tangents)
        work = result.work

        # A sphere outside the candidates was hit, or one went farther than the reach.
        unexpected = work.touched & ~candidates.expected
        partners = candidates.members[jnp.stack([candidates.a, candidates.b], 1)]
        hit_particles = jnp.where(unexpected[:, None], partners, len(old.position))
        extra = internal.extra.at[hit_particles].set(True, mode="drop")
        too_far = result.max_square_move > reach**2
        repeat = jnp.any(unexpected) | too_far
        if result.hit_walls is not None:
            extra = extra.at[result.hit_walls].set(True, mode="drop")
            repeat |= jnp.any(result.hit_walls < len(old.position))

        displacement = jnp.sqrt(jnp.max(jnp.sum((new.position - listed) ** 2, -1)))
        sum_by_replica = partial(candidates.sum_by_replica, replicas=self.replicas)
        error, allowed = energy_error(self.scene, old, new, work, sum_by_replica, result.sums)
        new = self._record_energy_error(new, error)
        fault = self._block_status(old, new, error, allowed, candidates, displacement)
        accepted = (fault == status.OK) & ~repeat
        enlarged = jnp.where(too_far, 2 * internal.reach_factor, internal.reach_factor)
        return Progress(
            state=accept_if(accepted, new, old),
            stale=accepted & (displacement + 2 * speed * duration > 0.5 * old.skin),
            status=fault,
            needed=jnp.maximum(now.needed, candidates.needed),
            internal=SoftProgress(
                extra=jnp.where(accepted, False, extra),
                reach_factor=jnp.where(accepted, 1.0, enlarged),
                num_blocks=internal.num_blocks + 1,
            ),
        )

    def _block_duration(self, state: State, end: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the duration of the next block, the number of blocks of this length until the end,
        and the temperature of the hottest replica, with the energy in its contacts."""
        # Without the energy in contacts a step would lengthen while all energy is stored there.
        stored = 2 * self.replicas / state.position.size * state.internal.elastic
        hottest = jnp.max(temperature_lab_frame(self.scene, state.velocity, self.replicas) + stored)
        if state.internal.spin is not None:
            hottest_spins = rotational_temperature(self.scene, state.internal.spin, self.replicas)
            hottest = jnp.maximum(hottest, jnp.max(hottest_spins))
        per_contact = self.steps_per_contact * state.internal.refinement
        longest_step = self.scene.shortest_contact * hottest**-0.1 / per_contact
        longest = self.steps_per_block * longest_step
        time_until_end = time_left(state, end)
        num_left = jnp.maximum(jnp.ceil(time_until_end / longest * (1 - 1e-9)), 1.0)
        return time_until_end / num_left, num_left, hottest

    def _integrate_block(
        self, state: State, candidates: ContactCandidates, duration: Array
    ) -> _BlockResult:
        """Return the state after the block, at its old time and with tangents not yet projected."""
        all_spheres = Spheres(state.position, state.velocity, state.internal.spin)
        members = block_members(self.scene, all_spheres, candidates.members)
        update = integrate_with_tangents(
            members,
            all_spheres,
            self.scene,
            candidates,
            duration,
            self.steps_per_block,
            state.tangents,
        )

        def put_members(values, new):
            return values.at[candidates.members].set(new, mode="drop")

        sum_by_replica = partial(candidates.sum_by_replica, replicas=self.replicas)
        internal = state.internal._replace(elastic=sum_by_replica(update.work.stored))
        flown, drag_loss = fly(self.scene, all_spheres, duration, self.scene.element_material)
        new = state._replace(
            position=put_members(flown.x, update.x),
            velocity=put_members(flown.v, update.v),
            dissipated=state.dissipated + sum_by_replica(update.work.dissipated),
            collisions=state.collisions + sum_by_replica(update.work.begun),
            internal=internal,
            tangents=update.tangents,
        )
        sums = hit_walls = None
        if update.element_work is not None:
            sums = ElementSums.from_work(
                update.element_work, candidates.members, drag_loss, self.replicas, len(flown.x)
            )
            spin = None if flown.spin is None else put_members(flown.spin, update.spin)
            internal = internal._replace(elastic=internal.elastic + sums.stored, spin=spin)
            new = new._replace(internal=internal, dissipated=new.dissipated + sums.lost)
            if candidates.expected_at_walls is not None:
                hit_walls = jnp.where(
                    update.element_work.touched & ~candidates.expected_at_walls,
                    candidates.members,
                    len(flown.x),
                )
        max_square_move = jnp.max(jnp.sum((update.x - members.x) ** 2, -1))
        return _BlockResult(new, update.work, max_square_move, sums, hit_walls)

    def _record_energy_error(self, new: State, error: Float[Array, "replicas"]) -> State:
        """Add the energy error of a block, and double the step again after enough good blocks."""
        internal = new.internal
        num_good = internal.num_good + 1
        recovers = (num_good >= RECOVERY_BLOCKS) & (internal.refinement > 1)
        internal = internal._replace(
            num_good=jnp.where(recovers, 0, num_good),
            refinement=jnp.where(recovers, 0.5 * internal.refinement, internal.refinement),
            drift=internal.drift + error,
        )
        return new._replace(internal=internal)

    def _block_status(
        self,
        old: State,
        new: State,
        error: Float[Array, "replicas"],
        allowed: Float[Array, "replicas"],
        candidates: ContactCandidates,
        displacement: Array,
    ) -> Int[Array, ""]:
        """Return the status of a block.

        Args:
            old, new: the state before and after it.
            error, allowed: see `energy_error`.
            candidates: the pairs.
            displacement: largest distance that a sphere moved since the neighbour list was built.
        """
        energy_wrong = jnp.any(jnp.abs(error) > allowed)
        drifted = jnp.any(jnp.abs(new.internal.drift) > DRIFT_TOLERANCE)
        list_status = self.capacity.exceeded_by(candidates.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        exceeded = status.flag(status.SKIN_EXCEEDED, displacement > 0.5 * old.skin)
        fault = jnp.where(finite, exceeded, status.NOT_FINITE.bit)
        fault |= status.flag(status.STEP_TOO_LARGE, energy_wrong & finite)
        fault |= status.flag(status.ENERGY_DRIFT, drifted & ~energy_wrong & finite)
        # A block whose arrays were too short lacks pairs or particles.
        return jnp.where(list_status > 0, list_status, fault)

    def recover(self, now: Progress, before: State) -> tuple[State, Int[Array, ""]]:
        """Halve a step that was too large, and lengthen a skin that was exceeded."""
        state, longest = now.state, max_skin(self.scene.side)
        fresh = state.time == before.time  # otherwise a new neighbour list is enough
        exceeded = status.has(now.status, status.SKIN_EXCEEDED) & fresh
        shorten = status.has(now.status, status.STEP_TOO_LARGE)
        shorten |= exceeded & (state.skin >= longest)
        unrecoverable = shorten & (state.internal.refinement >= MAX_REFINEMENT)
        fatal = status.LIST_FULL.bit | status.CONTACTS_FULL.bit | status.NOT_FINITE.bit
        fatal |= status.STALLED.bit | status.ENERGY_DRIFT.bit
        halve = shorten & ~unrecoverable
        finer = jnp.where(halve, 2 * state.internal.refinement, state.internal.refinement)
        num_good = jnp.where(halve, 0, state.internal.num_good)
        skin = jnp.where(exceeded, jnp.minimum(1.5 * state.skin, longest), state.skin)
        recovered = state._replace(
            skin=skin, internal=state.internal._replace(refinement=finer, num_good=num_good)
        )
        return recovered, jnp.where(unrecoverable, now.status, now.status & fatal)


def peculiar_velocity(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "n d"]:
    """Return velocities in the frame of each centre of mass, or in that of the walls."""
    if scene.walls is not None:
        return velocity
    return centred(velocity, replicas).reshape(velocity.shape)


def scene_temperature(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """Return T of each replica, in the frame of `peculiar_velocity`."""
    if scene.walls is None:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def temperature_lab_frame(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """Return T of each replica for the choice of the time step.

    It includes the velocity of the centre of mass where there are walls or drag, which do not move
    with it.
    """
    if scene.galilean_invariant:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def rotational_temperature(
    scene: SoftScene, spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "replicas"]:
    """Return T_rot of each replica, ``q <s^2>/d_rot``."""
    assert scene.surface is not None
    spin_by_replica = spin.reshape(replicas, -1, spin.shape[-1])
    return scene.surface.inertia * observables.temperature(spin_by_replica)


def total_kinetic_energy(scene: SoftScene, state: State) -> Float[Array, "replicas"]:
    """Return the kinetic energy of translation and rotation of each replica."""
    replicas, spin = len(state.internal.elastic), state.internal.spin
    energy = kinetic_energy(state.velocity, replicas)
    if spin is None or scene.surface is None:
        return energy
    return energy + scene.surface.inertia * kinetic_energy(spin, replicas)


def energy_error(
    scene: SoftScene,
    old: State,
    new: State,
    work: ContactWork,
    sum_by_replica: Callable[[Array], Array],
    sums: ElementSums | None,
) -> tuple[Float[Array, "replicas"], Float[Array, "replicas"]]:
    """Return the energy that a block added over all energy, and the allowed value.

    Args:
        scene: the gas.
        old, new: the state before and after the block.
        work: energies of pairs in it.
        sum_by_replica: sums values of pairs over each replica.
        sums: energies by walls and drag; None where the gas has no elements.
    """
    before = total_kinetic_energy(scene, old) + old.internal.elastic
    after = total_kinetic_energy(scene, new) + new.internal.elastic
    gain = after - before + sum_by_replica(work.dissipated)
    total = jnp.where(before > 0, before, 1.0)
    exchanged = sum_by_replica(work.exchanged) / total
    if sums is not None:
        gain, exchanged = gain + sums.lost, exchanged + sums.exchanged / total
    return gain / total, WORK_TOLERANCE * exchanged + ENERGY_TOLERANCE


class MemberUpdate(NamedTuple):
    """The members after the steps of a block.

    Attributes:
        x, v: positions and velocities.
        spin: spins; None of smooth spheres.
        work: energies and contacts of pairs.
        element_work: energies by walls and drag; None where the gas has no elements.
        tangents: tangents of all particles; None in a run without tangents.
    """

    x: Float[Array, "members d"]
    v: Float[Array, "members d"]
    spin: Float[Array, "members spins"] | None
    work: ContactWork
    element_work: ElementWork | None
    tangents: ThermalTangents | None


def integrate_with_tangents(
    members: Spheres,
    all_spheres: Spheres,
    scene: SoftScene,
    candidates: ContactCandidates,
    duration: Array,
    num_steps: int,
    tangents: ThermalTangents | None,
) -> MemberUpdate:
    """Return the members after the steps of a block, with the exact tangents of all particles.

    The tangents of members are pushed forward through the steps; those of all other particles are
    pushed through free flight.

    Args:
        members: the spheres to step.
        all_spheres: all particles before the block.
        scene: the gas.
        candidates: the pairs that may touch, and their particles.
        duration: of the block.
        num_steps: number of steps in the block.
        tangents: tangents of all particles; None in a run without tangents.
    """
    take_steps = partial(
        _take_steps, scene=scene, candidates=candidates, duration=duration, num_steps=num_steps
    )
    if tangents is None or len(tangents.alpha) == 0:
        stepped, energies = take_steps(
            members,
            scene.alpha,
            scene.dissipative_constant,
            scene.element_material,
            scene.friction_material,
        )
        return MemberUpdate(*stepped, *energies, tangents)
    stepped, energies, stepped_tangents = _step_with_tangents(
        take_steps, members, all_spheres, scene, candidates, duration, tangents
    )
    rotation = tangents.rotation
    if rotation is not None:
        rotation = rotation._replace(spin=stepped_tangents.spin)
    tangents = tangents._replace(
        position=stepped_tangents.x, velocity=stepped_tangents.v, rotation=rotation
    )
    return MemberUpdate(*stepped, *energies, tangents)


def _step_with_tangents(
    take_steps: Callable[..., tuple[Spheres, tuple[ContactWork, ElementWork | None]]],
    members: Spheres,
    all_spheres: Spheres,
    scene: SoftScene,
    candidates: ContactCandidates,
    duration: Array,
    tangents: ThermalTangents,
) -> tuple[Spheres, tuple[ContactWork, ElementWork | None], Spheres]:
    """Return the members after a block, the energies, and the tangents of all particles."""
    ones = jnp.ones(len(candidates.a), members.x.dtype)
    to_members = partial(_broadcast_to_members, size=len(members.x))
    pair_material = scene.alpha, scene.dissipative_constant
    primals = (
        members,
        *(number * ones for number in pair_material),
        to_members(scene.element_material),
        scene.friction_material,
    )
    take_rows = jax.vmap(lambda v: v.at[candidates.members].get(mode="fill", fill_value=0.0))
    pair_tangents = (
        tangent[:, candidates.replica] for tangent in tangents.material(*pair_material)
    )
    element_tangents, by_replica = ElementMaterial(), ElementMaterial()
    if tangents.elements is not None:
        by_replica = tangents.element_material(scene.element_material)
        size = len(tangents.free) // tangents.log_temperature.shape[1]
        replica = jnp.minimum(candidates.members // size, tangents.log_temperature.shape[1] - 1)
        element_tangents = jax.vmap(to_members, axis_size=len(tangents.alpha))(
            jax.tree.map(lambda x: x[:, replica], by_replica)
        )

    def push(*tangent):
        return jax.jvp(take_steps, primals, tangent, has_aux=True)

    rotation = tangents.rotation
    spin = None if rotation is None else rotation.spin
    particle_tangents = Spheres(tangents.position, tangents.velocity, spin)
    friction_tangents = None if rotation is None else rotation.directions
    stepped, stepped_tangents, energies = jax.vmap(push, out_axes=(None, 0, None))(
        jax.tree.map(take_rows, particle_tangents),
        *pair_tangents,
        element_tangents,
        friction_tangents,
    )
    put_rows = jax.vmap(lambda v, new: v.at[candidates.members].set(new, mode="drop"))
    if by_replica.drag is None:
        flown = particle_tangents._replace(x=tangents.position + duration * tangents.velocity)
    else:
        flown = _fly_tangents(particle_tangents, all_spheres, scene, duration, by_replica)
    return stepped, energies, jax.tree.map(put_rows, flown, stepped_tangents)


def _fly_tangents(
    tangents: Spheres,
    all_spheres: Spheres,
    scene: SoftScene,
    duration: Array,
    material_tangents: ElementMaterial,
) -> Spheres:
    """Return the tangents of all particles after a flight with drag.

    Args:
        tangents: of the particles before the flight.
        all_spheres: the particles before it.
        scene: the gas.
        duration: of the flight.
        material_tangents: of the rates of drag, by replica. Those of the inertia do not matter: it
            is not in the equation of a free spin.
    """
    material = scene.element_material

    def fly_with_rates(spheres: Spheres, drag: Array, spin_drag: Array | None) -> Spheres:
        rates = ElementMaterial(drag=drag, spin_drag=spin_drag)
        return fly(scene, spheres, duration, rates)[0]

    def push(tangent: Spheres, drag: Array, spin_drag: Array | None) -> Spheres:
        num_spheres = len(all_spheres.x)
        rate_tangents = jax.tree.map(
            lambda x: jnp.repeat(x, num_spheres // len(x)), (drag, spin_drag)
        )
        rates = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (num_spheres,)), (material.drag, material.spin_drag)
        )
        primals, tangent_in = (all_spheres, *rates), (tangent, *rate_tangents)
        return jax.jvp(fly_with_rates, primals, tangent_in)[1]

    return jax.vmap(push)(tangents, material_tangents.drag, material_tangents.spin_drag)


def _broadcast_to_members(material: ElementMaterial, size: int) -> ElementMaterial:
    """Return numbers of walls as columns with one row per member, and rates of drag as vectors."""
    vectors = jax.tree.map(lambda value: jnp.broadcast_to(value, (size,)), material)
    columns = jax.tree.map(lambda value: value[:, None], vectors)
    return columns._replace(drag=vectors.drag, spin_drag=vectors.spin_drag)


def _take_steps(
    members: Spheres,
    alpha: Any,
    dissipative_constant: Any,
    element_material: ElementMaterial,
    friction_material: FrictionMaterial | None,
    scene: SoftScene,
    candidates: ContactCandidates,
    duration: Array,
    num_steps: int,
) -> tuple[Spheres, tuple[ContactWork, ElementWork | None]]:
    if not scene.has_elements:
        x, v, work = integrate_smooth(
            members.x,
            members.v,
            alpha,
            dissipative_constant,
            candidates,
            duration,
            num_steps,
            scene.clipped,
        )
        return Spheres(x, v, None), (work, None)
    members, work, element_work = integrate_with_elements(
        members,
        alpha,
        dissipative_constant,
        element_material,
        scene.with_friction_material(friction_material),
        candidates,
        duration,
        num_steps,
    )
    return members, (work, element_work)


def initial_soft_tangents(
    scene: SoftScene, state: State, directions: tuple[Any, ...], interval: ArrayLike
) -> ThermalTangents:
    """Return the tangents of an initial state, along directions in `SoftScene.material`."""
    alpha, constant, *element_directions = directions
    damping = COOLING_CORRECTION * scene.dissipative_constant * scene.alpha**0.4
    replicas, elements, drag = len(state.internal.elastic), None, scene.element_material.drag
    if element_directions:
        elements, *element_directions = element_directions
        # Convert rates over the collision frequency into rates.
        rates = {"drag": elements.drag, "spin_drag": elements.spin_drag}
        rates = jax.tree.map(lambda rate: rate * scene.collision_frequency, rates)
        elements = elements._replace(**rates)
    tangents = initial_tangents(
        alpha, constant, state.velocity, replicas, interval, damping, elements, drag
    )
    if scene.surface is None:
        return tangents
    (friction_material,), surface = element_directions, scene.surface
    rotation = RotationTangents.initial(
        friction_material, surface.inertia, surface.ratio, state.internal.spin, replicas
    )
    return tangents._replace(rotation=rotation)


def tangents_after_block(
    new: State,
    old_spin: Array | None,
    candidates: ContactCandidates,
    work: ContactWork,
    sums: ElementSums | None,
    duration: ArrayLike,
    scene: SoftScene,
) -> ThermalTangents:
    """Return the tangents after a block, projected if a projection is due.

    Args:
        new: the state after the block, with tangents integrated over it but not projected.
        old_spin: spins before it; None of smooth spheres.
        candidates: the pairs of the block.
        work: energies and contacts of the pairs.
        sums: energies by walls and drag; None where the gas has no elements.
        duration: of the block.
        scene: the gas.
    """
    tangents, replicas = new.tangents, len(new.internal.elastic)
    partners = candidates.members[jnp.stack([candidates.a, candidates.b], 1)]
    touching_members = jnp.where(work.touching[:, None], partners, len(new.position))
    velocity = peculiar_velocity(scene, new.velocity, replicas)
    T = scene_temperature(scene, velocity, replicas)
    lost, energy = (
        candidates.sum_by_replica(work.dissipated, replicas),
        kinetic_energy(velocity, replicas),
    )
    lost = lost if sums is None else lost + sums.lost_to_walls
    if tangents.rotation is not None:
        rotational_gain = _rotational_gain(scene, old_spin, new.internal.spin, duration, replicas)
        lost += rotational_gain
        passed = duration * jnp.sqrt(T) * scene.collision_frequency
        temperature_ratio = ratio_or_zero(
            rotational_temperature(scene, new.internal.spin, replicas), T
        )
        gain_ratio = tangents.rotation.rotational_gain.after(
            passed, rotational_gain, energy * passed, temperature_ratio
        )
        tangents = tangents._replace(
            rotation=tangents.rotation._replace(rotational_gain=gain_ratio)
        )
    rates = update_rates(
        tangents.rates,
        lost=lost,
        collisions=2
        * replicas
        / len(new.position)
        * candidates.sum_by_replica(work.begun, replicas),
        energy=energy + new.internal.elastic,
        temperature=T,
        trend=tangents.trend(T),
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    free = jnp.ones_like(tangents.free).at[touching_members].set(False, mode="drop")
    if sums is not None:
        free &= ~sums.touches_wall
    tangents = tangents._replace(
        free=free,
        rates=rates,
        elapsed=tangents.elapsed + duration,
        thermal_elapsed=tangents.thermal_elapsed + duration * jnp.sqrt(T),
    )
    passed = tangents.elapsed * jnp.sqrt(jnp.mean(T))
    due = passed * scene.collision_frequency >= tangents.interval
    return project_if_due(tangents, velocity, due, new.internal.spin)


def _rotational_gain(
    scene: SoftScene, before: Array | None, after: Array, duration: ArrayLike, replicas: int
) -> Float[Array, "replicas"]:
    """Return the energy that rotation gained in contacts: its change less that by drag."""
    assert before is not None and scene.surface is not None
    old, new = kinetic_energy(before, replicas), kinetic_energy(after, replicas)
    gain = new - old
    if (rate := scene.element_material.spin_drag) is not None:
        gain += rate * duration * (old + new)
    return scene.surface.inertia * gain


@partial(jax.jit, static_argnames="replicas")
def soft_records(state: State, scene: SoftScene, replicas: int) -> dict[str, Array]:
    """Return the records of a state; with tangents, also those that `rule.with_tangents` adds.

    The derivative of T is that of the run up to the projection; those of the other records are
    estimated from it. The elastic energy goes as ``T^(7/5) alpha^(-2/5)``.
    """
    values, travelled, velocity = common_records(state, scene.side, replicas)
    values["elastic_energy"] = state.internal.elastic / velocity.shape[1]
    if scene.walls is not None:  # the frame is that of the walls
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        values["velocity_correlation"] = observables.velocity_correlation(
            state.first_velocity.reshape(velocity.shape), velocity
        )
    if state.internal.spin is not None:  # it is None during equilibration
        values["rotational_temperature"] = rotational_temperature(
            scene, state.internal.spin, replicas
        )
    tangents = state.tangents
    if tangents is None:
        return _drop_undefined(values, scene)
    T, U = values["temperature"], values["elastic_energy"]
    cooling, collision_rate = tangents.cooling(T), tangents.rates.collision(T)
    c, clock, paths = thermal_projection(tangents, velocity.reshape(state.velocity.shape))
    derivatives, rates = derivatives_of_records(
        values, travelled, velocity, c, paths, cooling, collision_rate
    )
    stiffer = (tangents.alpha / scene.alpha)[:, None]
    derivatives["elastic_energy"] = (1.4 * c - 0.4 * stiffer) * U[None]
    rates["elastic_energy"] = -1.4 * cooling * U
    values, unknown = _drop_undefined(values, scene), {}
    if tangents.rotation is not None:
        known = "rotational_temperature"
        derivatives[known], rates[known] = _rotation_derivatives(state, scene, values)
        # The tangents of paths are known only for smooth spheres.
        names = {"displacement", "velocity_correlation"} & set(values)
        unknown = {name: values.pop(name) for name in names}
    return rule.with_tangents(values, derivatives, rates, clock) | unknown


def _rotation_derivatives(
    state: State, scene: SoftScene, values: dict[str, Array]
) -> tuple[Array, Array]:
    """Return the derivatives of T_rot along the directions at a fixed place, and in time."""
    tangents, spin, T = state.tangents, state.internal.spin, values["temperature"]
    assert scene.surface is not None and spin is not None
    rotation, T_rot = tangents.rotation, values["rotational_temperature"]
    logs = rotation.log_temperature(spin, scene.surface.inertia, tangents.log_temperature)
    d, d_rot = state.velocity.shape[1], spin.shape[1]
    rate = (
        d
        / d_rot
        * rotation.rotational_gain.at(ratio_or_zero(T_rot, T))
        * scene.collision_frequency
        * T**1.5
    )
    if (spin_drag := scene.element_material.spin_drag) is not None:
        rate -= 2 * spin_drag * T_rot
    return logs * T_rot[None], rate


def _drop_undefined(values: dict[str, Array], scene: SoftScene) -> dict[str, Array]:
    """Drop the records that a container leaves undefined.

    Walls bound the displacement of a sphere, and there are no periodic waves between them.
    """
    if scene.walls is None:
        return values
    undefined = "displacement", "flow_share"
    return {name: value for name, value in values.items() if name not in undefined}

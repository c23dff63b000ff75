"""Soft spheres in blocks of time steps: those that may touch are stepped, the rest flies freely.

Free flight is exact, and which spheres may touch is decided once a block: indices are fixed within
it, which keeps them out of the derivative.

The energy balance of a block of time steps.

The frame in which a gas is at rest: that of its centre of mass, or of its walls.

The tangents of a gas of soft spheres after a block of time steps.

Time steps of soft spheres together with the tangents of all particles.

The records of soft spheres, with their derivatives where tangents are followed.

What soft spheres have besides the state and the progress of all kinds of spheres.
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
    project,
    projected,
    ratio_or_zero,
    update_rates,
)
from jaxgran.particles import observables
from jaxgran.particles.capacity import Capacity, longest_skin
from jaxgran.particles.dynamics import (
    AbstractDynamics,
    Progress,
    first_progress,
    kept_if,
    repeat_until,
)
from jaxgran.particles.neighbours import Pairs
from jaxgran.particles.soft.forces import (
    ContactWork,
    ElementSums,
    ElementWork,
    Encounters,
    SoftScene,
    Spheres,
    block_members,
    elastic_energy,
    fly,
    integrate_smooth,
    integrate_with_elements,
    near_walls,
    overlap,
    select_encounters,
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
"""Energy error of a block that is allowed, over the work done by elastic forces in it."""

ENERGY_TOLERANCE = 1e-3
"""And over all energy: a contact that began after the last kick holds energy not yet accounted."""


def moving_energy(scene: SoftScene, state: State) -> Float[Array, "replicas"]:
    """Kinetic energy of translation and rotation of each replica."""
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
    by_replica: Callable[[Array], Array],
    sums: ElementSums | None,
) -> tuple[Float[Array, "replicas"], Float[Array, "replicas"]]:
    """The energy that a block added over all energy, and how much is allowed.

    Args:
        scene: the gas.
        old, new: the state before and after the block.
        work: done in it.
        by_replica: sums values of pairs over each replica.
        sums: energies by walls and drag; None where the gas has no elements.
    """
    before = moving_energy(scene, old) + old.internal.elastic
    after = moving_energy(scene, new) + new.internal.elastic
    gain = after - before + by_replica(work.dissipated)
    total = jnp.where(before > 0, before, 1.0)
    exchanged = by_replica(work.exchanged) / total
    if sums is not None:
        gain, exchanged = gain + sums.lost, exchanged + sums.exchanged / total
    return gain / total, WORK_TOLERANCE * exchanged + ENERGY_TOLERANCE


def peculiar_velocity(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "n d"]:
    """Velocities in the frame in which each replica is at rest."""
    if scene.walls is not None:
        return velocity
    return centred(velocity, replicas).reshape(velocity.shape)


def scene_temperature(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """T of each replica."""
    if scene.walls is None:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def temperature_lab_frame(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """T of each replica by all velocities that matter for the length of a step: with those of its
    centre of mass, unless it is at rest."""
    if scene.inertial:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def rotational_temperature(
    scene: SoftScene, spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "replicas"]:
    """T_rot of each replica, ``q <s^2>/d_rot``."""
    assert scene.surface is not None
    each = spin.reshape(replicas, -1, spin.shape[-1])
    return scene.surface.inertia * observables.temperature(each)


def initial_soft_tangents(
    scene: SoftScene, state: State, directions: tuple[Any, ...], interval: ArrayLike
) -> ThermalTangents:
    """The tangents of an initial state, along directions in `SoftScene.material`."""
    alpha, constant, *more = directions
    damping = COOLING_CORRECTION * scene.dissipative_constant * scene.alpha**0.4
    replicas, along, drag = len(state.internal.elastic), None, scene.of_elements.drag
    if more:
        along, *more = more
        # Rates, of which the material has those over the collision frequency.
        of_drag = {"drag": along.drag, "spin_drag": along.spin_drag}
        of_drag = jax.tree.map(lambda rate: rate * scene.collision_frequency, of_drag)
        along = along._replace(**of_drag)
    found = initial_tangents(
        *(alpha, constant, state.velocity, replicas, interval, damping, along, drag)
    )
    if scene.surface is None:
        return found
    (friction_material,), surface = more, scene.surface
    at = friction_material, surface.inertia, surface.ratio, state.internal.spin, replicas
    return found._replace(rotation=RotationTangents.at_start(*at))


def tangents_after_block(
    new: State,
    spin: Array | None,
    chosen: Encounters,
    work: ContactWork,
    sums: ElementSums | None,
    duration: ArrayLike,
    scene: SoftScene,
) -> ThermalTangents:
    """The tangents after a block, projected if it is time to.

    Args:
        new: the state after the block; its tangents are followed, not projected.
        spin: before it; None of smooth spheres.
        chosen: the pairs of the block.
        work: of the pairs.
        sums: energies by walls and drag; None where the gas has no elements.
        duration: of the block.
        scene: the gas.
    """
    along, replicas = new.tangents, len(new.internal.elastic)
    partners = chosen.members[jnp.stack([chosen.a, chosen.b], 1)]
    ends = jnp.where(work.touching[:, None], partners, len(new.position))
    velocity = peculiar_velocity(scene, new.velocity, replicas)
    warmth = scene_temperature(scene, velocity, replicas)
    lost, energy = chosen.by_replica(work.dissipated, replicas), kinetic_energy(velocity, replicas)
    lost = lost if sums is None else lost + sums.to_walls
    if along.rotation is not None:
        rotational_gain = _rotational_gain(scene, spin, new.internal.spin, duration, replicas)
        lost += rotational_gain
        passed = duration * jnp.sqrt(warmth) * scene.collision_frequency
        share = ratio_or_zero(rotational_temperature(scene, new.internal.spin, replicas), warmth)
        line = along.rotation.rotational_gain.after(passed, rotational_gain, energy * passed, share)
        along = along._replace(rotation=along.rotation._replace(rotational_gain=line))
    found = update_rates(
        along.rates,
        lost=lost,
        met=2 * replicas / len(new.position) * chosen.by_replica(work.begun, replicas),
        energy=energy + new.internal.elastic,
        temperature=warmth,
        trend=along.trend(warmth),
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    free = jnp.ones_like(along.free).at[ends].set(False, mode="drop")
    if sums is not None:
        free &= ~sums.at_walls
    along = along._replace(
        free=free,
        rates=found,
        elapsed=along.elapsed + duration,
        own_elapsed=along.own_elapsed + duration * jnp.sqrt(warmth),
    )
    passed = along.elapsed * jnp.sqrt(jnp.mean(warmth))
    due = passed * scene.collision_frequency >= along.interval
    return project(along, velocity, due, new.internal.spin)


def _rotational_gain(
    scene: SoftScene, before: Array | None, after: Array, duration: ArrayLike, replicas: int
) -> Float[Array, "replicas"]:
    """Energy that rotation gained in contacts, all that it gained but for what drag took."""
    assert before is not None and scene.surface is not None
    old, new = kinetic_energy(before, replicas), kinetic_energy(after, replicas)
    gained = new - old
    if (rate := scene.of_elements.spin_drag) is not None:
        gained += rate * duration * (old + new)
    return scene.surface.inertia * gained


class SteppedMembers(NamedTuple):
    """The members after the steps of a block.

    Attributes:
        x, v: positions and velocities.
        spin: of spheres that have some; else None.
        work: of pairs.
        more: energies by walls and drag; None where the gas has no elements.
        along: tangents of all particles; None if they are not followed.
    """

    x: Float[Array, "members d"]
    v: Float[Array, "members d"]
    spin: Float[Array, "members spins"] | None
    work: ContactWork
    more: ElementWork | None
    along: ThermalTangents | None


def integrate_with_tangents(
    now: Spheres,
    everyone: Spheres,
    scene: SoftScene,
    chosen: Encounters,
    duration: Array,
    num_steps: int,
    along: ThermalTangents | None,
) -> SteppedMembers:
    """The members after the steps of a block, and the exact tangents of all particles.

    Members are stepped and their tangents pushed forward through the steps; the tangents of all
    others fly freely.

    Args:
        now: the members.
        everyone: all particles before the block.
        scene: the gas.
        chosen: the pairs that may touch, and their particles.
        duration: of the block.
        num_steps: in the block.
        along: the tangents of all particles; None if they are not followed.
    """
    take = partial(
        _take_steps,
        scene=scene,
        settings={"chosen": chosen, "duration": duration, "num_steps": num_steps},
    )
    if along is None or len(along.alpha) == 0:
        internal = scene.alpha, scene.dissipative_constant
        moved, energies = take(now, *internal, scene.of_elements, scene.friction_material)
        return SteppedMembers(*moved, *energies, along)
    run = take, now, everyone, scene, chosen, duration, along
    moved, energies, tangents = _with_pushforward(*run)
    rotation = along.rotation
    if rotation is not None:
        rotation = rotation._replace(spin=tangents.spin)
    along = along._replace(position=tangents.x, velocity=tangents.v, rotation=rotation)
    return SteppedMembers(*moved, *energies, along)


def _with_pushforward(
    take: Callable[..., tuple[Spheres, tuple[ContactWork, ElementWork | None]]],
    now: Spheres,
    everyone: Spheres,
    scene: SoftScene,
    chosen: Encounters,
    duration: Array,
    along: ThermalTangents,
) -> tuple[Spheres, tuple[ContactWork, ElementWork | None], Spheres]:
    """The members after a block, the energies, and the tangents of all particles."""
    one, of_members = jnp.ones(len(chosen.a), now.x.dtype), partial(_of_members, size=len(now.x))
    internal = scene.alpha, scene.dissipative_constant
    at = (
        now,
        *(number * one for number in internal),
        of_members(scene.of_elements),
        scene.friction_material,
    )
    rows = jax.vmap(lambda rest: rest.at[chosen.members].get(mode="fill", fill_value=0.0))
    material = (tangent[:, chosen.replica] for tangent in along.material(*internal))
    further, each = ElementMaterial(), ElementMaterial()
    if along.elements is not None:
        each = along.of_elements(scene.of_elements)
        size = len(along.free) // along.log_temperature.shape[1]
        replica = jnp.minimum(chosen.members // size, along.log_temperature.shape[1] - 1)
        further = jax.vmap(of_members, axis_size=len(along.alpha))(
            jax.tree.map(lambda x: x[:, replica], each)
        )

    def push(*tangent):
        return jax.jvp(take, at, tangent, has_aux=True)

    rotation = along.rotation
    tangents = Spheres(along.position, along.velocity, None if rotation is None else rotation.spin)
    friction_material = None if rotation is None else rotation.directions
    moved, along_moved, energies = jax.vmap(push, out_axes=(None, 0, None))(
        jax.tree.map(rows, tangents), *material, further, friction_material
    )
    put = jax.vmap(lambda rest, new: rest.at[chosen.members].set(new, mode="drop"))
    if each.drag is None:
        flown = tangents._replace(x=along.position + duration * along.velocity)
    else:
        flown = _fly_tangents(tangents, everyone, scene, duration, each)
    return moved, energies, jax.tree.map(put, flown, along_moved)


def _fly_tangents(
    tangents: Spheres, everyone: Spheres, scene: SoftScene, duration: Array, each: ElementMaterial
) -> Spheres:
    """The tangents of all particles after a flight with drag, whose tangents are given by replica.

    Those of the inertia do not matter: it is not in the equation of a free spin.
    """
    here = scene.of_elements

    def flown(now: Spheres, drag: Array, spin_drag: Array | None) -> Spheres:
        rates = ElementMaterial(drag=drag, spin_drag=spin_drag)
        return fly(scene, now, duration, rates)[0]

    def push(tangent: Spheres, drag: Array, spin_drag: Array | None) -> Spheres:
        internal = (here.drag, here.spin_drag), (drag, spin_drag)
        change = jax.tree.map(lambda x: jnp.repeat(x, len(everyone.x) // len(x)), internal[1])
        rates = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(everyone.x),)), internal[0])
        return jax.jvp(flown, (everyone, *rates), (tangent, *change))[1]

    return jax.vmap(push)(tangents, each.drag, each.spin_drag)


def _of_members(material: ElementMaterial, size: int) -> ElementMaterial:
    """Numbers of walls as columns, one row for each member; those of drag one for each."""

    each = jax.tree.map(lambda value: jnp.broadcast_to(value, (size,)), material)
    columns = jax.tree.map(lambda value: value[:, None], each)
    return columns._replace(drag=each.drag, spin_drag=each.spin_drag)


def _take_steps(
    now: Spheres,
    alpha: Any,
    dissipative_constant: Any,
    material: ElementMaterial,
    friction_material: FrictionMaterial | None,
    scene: SoftScene,
    settings: dict[str, Any],
) -> tuple[Spheres, tuple[ContactWork, ElementWork | None]]:
    """The members after the steps of a block; and energies."""
    internal = alpha, dissipative_constant
    if scene.plain:
        x, v, work = integrate_smooth(now.x, now.v, *internal, clipped=scene.clipped, **settings)
        return Spheres(x, v, None), (work, None)
    scene = scene.with_friction_material(friction_material)
    now, work, more = integrate_with_elements(now, *internal, material, scene, **settings)
    return now, (work, more)


@partial(jax.jit, static_argnames="replicas")
def soft_records(state: State, scene: SoftScene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds.

    T is followed but for the projection; the rest is estimated from it. The elastic energy goes as
    ``T^(7/5) alpha^(-2/5)``.
    """
    values, travelled, velocity = common_records(state, scene.side, replicas)
    values["elastic_energy"] = state.internal.elastic / velocity.shape[1]
    if scene.walls is not None:  # which stop what moves as a whole, and keep spheres from going far
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        values["velocity_correlation"] = observables.velocity_correlation(
            state.first_velocity.reshape(velocity.shape), velocity
        )
    if state.internal.spin is not None:  # not so in the melt
        values["rotational_temperature"] = rotational_temperature(
            scene, state.internal.spin, replicas
        )
    along = state.tangents
    if along is None:
        return _meaningful(values, scene)
    T, U = values["temperature"], values["elastic_energy"]
    cooling, meeting = along.cooling(T), along.rates.collision(T)
    c, clock, paths = projected(along, velocity.reshape(state.velocity.shape))
    kept, rates = derivatives_of_records(values, travelled, velocity, c, paths, cooling, meeting)
    stiffer = (along.alpha / scene.alpha)[:, None]
    kept["elastic_energy"] = (1.4 * c - 0.4 * stiffer) * U[None]
    rates["elastic_energy"] = -1.4 * cooling * U
    values, unknown = _meaningful(values, scene), {}
    if along.rotation is not None:
        known = "rotational_temperature"
        kept[known], rates[known] = _of_rotation(state, scene, values)
        # The paths are known of smooth spheres.
        names = {"displacement", "velocity_correlation"} & set(values)
        unknown = {name: values.pop(name) for name in names}
    return rule.with_tangents(values, kept, rates, clock) | unknown


def _of_rotation(state: State, scene: SoftScene, values: dict[str, Array]) -> tuple[Array, Array]:
    """Derivatives of T_rot along the directions at a fixed place, and in time."""
    along, spin, T = state.tangents, state.internal.spin, values["temperature"]
    assert scene.surface is not None and spin is not None
    rotation, T_rot = along.rotation, values["rotational_temperature"]
    logs = rotation.log_temperature(spin, scene.surface.inertia, along.log_temperature)
    d, d_rot = state.velocity.shape[1], spin.shape[1]
    rate = (
        d
        / d_rot
        * rotation.rotational_gain.at(ratio_or_zero(T_rot, T))
        * scene.collision_frequency
        * T**1.5
    )
    if (slowing := scene.of_elements.spin_drag) is not None:
        rate -= 2 * slowing * T_rot
    return logs * T_rot[None], rate


def _meaningful(values: dict[str, Array], scene: SoftScene) -> dict[str, Array]:
    """The records without those that mean nothing in a scene: between walls no sphere goes far, and
    there are no periodic waves."""
    if scene.walls is None:
        return values
    unknown = "displacement", "flow_share"
    return {name: value for name, value in values.items() if name not in unknown}


class SoftState(NamedTuple):
    """What soft spheres have besides `State`.

    Attributes:
        elastic: energy in contacts.
        refine: factor by which steps are shorter than asked.
        good: number of blocks since the step was last changed.
        drift: sum of the relative energy errors of all blocks.
        spin: of spheres with friction; else None.
    """

    elastic: Float[Array, "replicas"]
    refine: Float[Array, ""]
    good: Int[Array, ""]
    drift: Float[Array, "replicas"]
    spin: Float[Array, "n spins"] | None = None


class SoftProgress(NamedTuple):
    """What soft spheres have besides `Progress`.

    Attributes:
        extra: particles found to take part only when a block had been stepped.
        widen: factor by which the next block looks farther.
        num_blocks: made with this neighbour list.
    """

    extra: Bool[Array, "n"]
    widen: Float[Array, ""]
    num_blocks: Int[Array, ""]


MAX_REFINE = 4096.0
"""Largest factor by which the step may become shorter than asked before the run fails."""

DRIFT_TOLERANCE = 0.05
"""Sum of the relative energy errors of all blocks, which is an error of ln T, that is allowed."""

RECOVERY = 200
"""Good blocks after which a step that was halved is doubled again."""

REACH_MARGIN = 1.5
"""How much farther than the fastest sphere would fly a sphere may get in a block."""


class _BlockResult(NamedTuple):
    """The result of one block, not yet accepted."""

    state: State
    work: ContactWork
    distance: Array  # square of the largest distance that a member moved
    sums: ElementSums | None  # energies by walls and drag
    hit_walls: Array | None  # particles that touched a wall without being expected to


class SoftDynamics(AbstractDynamics):
    """Viscoelastic spheres in blocks of equal time steps.

    Attributes:
        scene, replicas, capacity: see `AbstractDynamics`.
        steps_per_contact: steps in the mean contact duration at the current temperature.
        steps_per_block: steps in which the candidates for contact are fixed.
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
        along = initial_soft_tangents(self.scene, state, directions, self.projection)
        return state._replace(tangents=along)

    @property
    def room(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def inertial(self) -> bool:
        return self.scene.inertial

    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        return velocity, state.internal.spin

    def sample_spins(self, state: State, key: PRNGKeyArray, melted: State) -> State:
        surface = self.scene.surface
        if surface is None:
            return state
        spin = initial_spins(key, state.velocity, self.replicas, surface.ratio / surface.inertia)
        return state._replace(internal=state.internal._replace(spin=spin))

    def observe(self, state: State) -> dict[str, Array]:
        return soft_records(state, self.scene, self.replicas)

    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, ArrayLike]:
        began = wrap_positions(state, self.scene.side)
        return began, began.position, end

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        xi, _, touching = overlap(state.position, pairs.i, pairs.j, pairs.offset)
        touching &= jnp.arange(len(xi)) < pairs.count
        stored = elastic_energy(jnp.where(touching, xi, 0.0), self.scene.alpha)
        replica = pairs.i // (len(state.position) // self.replicas)
        elastic = jnp.zeros_like(state.internal.elastic).at[replica].add(stored)
        if self.scene.walls is not None:
            at_walls = wall_energy(self.scene.walls, state.position)
            elastic += jnp.sum(at_walls.reshape(self.replicas, -1), axis=1)
        internal = SoftProgress(
            extra=jnp.zeros(len(state.position), bool),
            widen=jnp.ones((), state.position.dtype),
            num_blocks=jnp.zeros((), jnp.int32),
        )
        state = state._replace(internal=state.internal._replace(elastic=elastic))
        first = first_progress(state, pairs, self.capacity, internal)
        block = partial(self._block, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, block, first)

    def _block(self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike) -> Progress:
        """One block, accepted if all that took part in it was expected and nothing went wrong."""
        old, more = now.state, now.internal
        duration, num_left, hottest = self._duration(old, end)
        # Of all replicas: they share their blocks.
        speed = jnp.max(fastest(old.velocity, self.replicas))
        # From rest the first reach is 0, and the next one is that of the energy in contacts.
        reach = REACH_MARGIN * speed * more.widen + (more.widen - 1) * jnp.sqrt(hottest)
        reach = reach * duration
        chosen = select_encounters(
            old.position,
            old.velocity,
            pairs,
            duration,
            2 * reach,
            more.extra,
            self.replicas,
            self.capacity[2:],
            near_walls(self.scene.walls, old.position, old.velocity, duration),
        )
        stepped = self._stepped(old, chosen, duration)
        new = stepped.state
        new = advance_time(new, duration, end, num_left <= 1)
        if old.tangents is not None:
            spin = old.internal.spin
            along = tangents_after_block(
                new, spin, chosen, stepped.work, stepped.sums, duration, self.scene
            )
            new = new._replace(tangents=along)
        work = stepped.work

        # A sphere outside the chosen ones was hit, or one went farther than was looked.
        surprise = work.touched & ~chosen.expected
        partners = chosen.members[jnp.stack([chosen.a, chosen.b], 1)]
        hit = jnp.where(surprise[:, None], partners, len(old.position))
        extra = more.extra.at[hit].set(True, mode="drop")
        too_far = stepped.distance > reach**2
        again = jnp.any(surprise) | too_far
        if stepped.hit_walls is not None:
            extra = extra.at[stepped.hit_walls].set(True, mode="drop")
            again |= jnp.any(stepped.hit_walls < len(old.position))

        moved = jnp.sqrt(jnp.max(jnp.sum((new.position - listed) ** 2, -1)))
        by_replica = partial(chosen.by_replica, replicas=self.replicas)
        error, allowed = energy_error(self.scene, old, new, work, by_replica, stepped.sums)
        new = self._with_ledger(new, error)
        fault = self._fault(old, new, error, allowed, chosen, moved)
        done = (fault == status.OK) & ~again
        return Progress(
            state=kept_if(done, new, old),
            stale=done & (moved + 2 * speed * duration > 0.5 * old.skin),
            status=fault,
            needed=jnp.maximum(now.needed, chosen.needed),
            internal=SoftProgress(
                extra=jnp.where(done, False, extra),
                widen=jnp.where(done, 1.0, jnp.where(too_far, 2 * more.widen, more.widen)),
                num_blocks=more.num_blocks + 1,
            ),
        )

    def _duration(self, state: State, end: ArrayLike) -> tuple[Array, Array, Array]:
        """Duration of the next block, how many as long are left until the end, and the temperature
        of the hottest replica, with the energy in its contacts."""
        # With the energy in contacts, or a step would lengthen while all of it is stored there.
        stored = 2 * self.replicas / state.position.size * state.internal.elastic
        hottest = jnp.max(temperature_lab_frame(self.scene, state.velocity, self.replicas) + stored)
        if state.internal.spin is not None:
            spins = rotational_temperature(self.scene, state.internal.spin, self.replicas)
            hottest = jnp.maximum(hottest, jnp.max(spins))
        per_contact = self.steps_per_contact * state.internal.refine
        longest_step = self.scene.shortest_contact * hottest**-0.1 / per_contact
        longest = self.steps_per_block * longest_step
        left = time_left(state, end)
        num_left = jnp.maximum(jnp.ceil(left / longest * (1 - 1e-9)), 1.0)
        return left / num_left, num_left, hottest

    def _stepped(self, state: State, chosen: Encounters, duration: Array) -> _BlockResult:
        """The state after the block, but for its time; tangents are followed, not projected."""
        everyone = Spheres(state.position, state.velocity, state.internal.spin)
        before = block_members(self.scene, everyone, chosen.members)
        found = integrate_with_tangents(
            *(before, everyone, self.scene, chosen, duration, self.steps_per_block, state.tangents)
        )

        def put(values, new):
            return values.at[chosen.members].set(new, mode="drop")

        by_replica = partial(chosen.by_replica, replicas=self.replicas)
        internal = state.internal._replace(elastic=by_replica(found.work.stored))
        flown, dragged = fly(self.scene, everyone, duration, self.scene.of_elements)
        new = state._replace(
            position=put(flown.x, found.x),
            velocity=put(flown.v, found.v),
            dissipated=state.dissipated + by_replica(found.work.dissipated),
            collisions=state.collisions + by_replica(found.work.begun),
            internal=internal,
            tangents=found.along,
        )
        sums = hit = None
        if found.more is not None:
            sums = ElementSums.of(found.more, chosen.members, dragged, self.replicas, len(flown.x))
            spin = None if flown.spin is None else put(flown.spin, found.spin)
            internal = internal._replace(elastic=internal.elastic + sums.stored, spin=spin)
            new = new._replace(internal=internal, dissipated=new.dissipated + sums.lost)
            if chosen.sure is not None:
                hit = jnp.where(found.more.touched & ~chosen.sure, chosen.members, len(flown.x))
        moved = jnp.max(jnp.sum((found.x - before.x) ** 2, -1))
        return _BlockResult(new, found.work, moved, sums, hit)

    def _with_ledger(self, new: State, error: Float[Array, "replicas"]) -> State:
        """The state with the energy error of its last block, and its step, which recovers."""
        internal = new.internal
        good = internal.good + 1
        recovers = (good >= RECOVERY) & (internal.refine > 1)
        internal = internal._replace(
            good=jnp.where(recovers, 0, good),
            refine=jnp.where(recovers, 0.5 * internal.refine, internal.refine),
            drift=internal.drift + error,
        )
        return new._replace(internal=internal)

    def _fault(
        self,
        old: State,
        new: State,
        error: Float[Array, "replicas"],
        allowed: Float[Array, "replicas"],
        chosen: Encounters,
        moved: Array,
    ) -> Int[Array, ""]:
        """The status of a block that moved spheres by at most so much since the list was built."""
        wrong = jnp.any(jnp.abs(error) > allowed)
        drifted = jnp.any(jnp.abs(new.internal.drift) > DRIFT_TOLERANCE)
        full = self.capacity.exceeded_by(chosen.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        outrun = status.flag(status.SKIN_OUTRUN, moved > 0.5 * old.skin)
        fault = jnp.where(finite, outrun, status.NOT_FINITE.bit)
        fault |= status.flag(status.STEP_TOO_LARGE, wrong & finite)
        fault |= status.flag(status.ENERGY_DRIFT, drifted & ~wrong & finite)
        return jnp.where(full > 0, full, fault)  # a block with too short arrays is no block

    def recover(self, now: Progress, began: State) -> tuple[State, Int[Array, ""]]:
        """A step that is too large is halved, and a skin that was outrun lengthened."""
        state, longest = now.state, longest_skin(self.scene.side)
        fresh = state.time == began.time  # else a new list is all that an outrun skin needs
        outrun = status.has(now.status, status.SKIN_OUTRUN) & fresh
        shorten = status.has(now.status, status.STEP_TOO_LARGE)
        shorten |= outrun & (state.skin >= longest)
        hopeless = shorten & (state.internal.refine >= MAX_REFINE)
        beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit | status.NOT_FINITE.bit
        beyond |= status.STALLED.bit | status.ENERGY_DRIFT.bit
        halve = shorten & ~hopeless
        finer = jnp.where(halve, 2 * state.internal.refine, state.internal.refine)
        good = jnp.where(halve, 0, state.internal.good)
        longer = jnp.where(outrun, jnp.minimum(1.5 * state.skin, longest), state.skin)
        mended = state._replace(
            skin=longer, internal=state.internal._replace(refine=finer, good=good)
        )
        return mended, jnp.where(hopeless, now.status, now.status & beyond)

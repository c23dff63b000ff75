"""The effect of impacts of hard spheres, and the impacts of a window of time.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window. With drag, velocities, spins and time are transformed
(`jaxgran.particles.elements`), and drag does not change the transformed spins.

Tangents (`jaxgran.gradients.tangents`) follow the energy that each impact exchanges, as a function
of the numbers of the material and of the scale of all velocities and spins.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.elements import DragDecay, drag_decay, tangential_impulse
from jaxgran.particles.hard.prediction import (
    FirstImpacts,
    ImpactCandidates,
    PairRows,
    Paths,
    WallImpacts,
    first_impacts,
)
from jaxgran.particles.spheres import SphereState, temperature
from jaxgran.scene.elements import wall_impact_ratio
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedScene, SphereScene

MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window at which the run counts as stalled."""


class LawOfReplicas(ReducedLaw):
    """Another law in each replica, or in each row.

    Attributes:
        laws: its numbers have a first axis of replicas, or of rows.
    """

    laws: ReducedLaw

    def of_rows(self, replica: Int[Array, "rows"]) -> "LawOfReplicas":
        """Return the laws of the replicas to which some rows belong."""
        return LawOfReplicas(jax.tree.map(lambda x: x.at[replica].get(mode="clip"), self.laws))

    def restitution(self, normal_speed: Float[Array, "rows"]) -> Float[Array, "rows"]:
        return jax.vmap(lambda law, speed: law.restitution(speed))(self.laws, normal_speed)


class ImpactEvents(NamedTuple):
    """Spheres at impact, on others or on walls; rows without an impact have no meaning.

    Attributes:
        time: of the gas.
        normal: from the first sphere out into the second, or into the wall.
        relative: velocity of the first sphere relative to the second, v_1 - v_2; at a wall, the
            velocity of the sphere.
        speed: its normal part.
        spin: sum of the (transformed) spins of both spheres; at a wall, the spin of the sphere.
            None for smooth spheres.
        elastic: whether the impact is elastic and smooth.
        axis: across which the wall lies; None for impacts of two spheres.
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]
    axis: Int[Array, "rows"] | None = None

    @property
    def share(self) -> float:
        """Share of the first sphere in the change of velocity: half of two, all at a wall."""
        return 0.5 if self.axis is None else 1.0


class ImpactEffect(NamedTuple):
    """Effect of impacts on the first sphere.

    The second sphere gets the opposite kick and the same change of spin.

    Attributes:
        kick: change of velocity.
        lost: translational energy lost, by each sphere half of what both lose.
        spin_change: change of the (transformed) spin; None for smooth spheres.
        rotational_gain: gain of the energy of these spins, half of it for each sphere; None for
            smooth spheres.
    """

    kick: Float[Array, "rows d"]
    lost: Float[Array, "rows"]
    spin_change: Float[Array, "rows spins"] | None = None
    rotational_gain: Float[Array, "rows"] | None = None


def impact_effect(scene: SphereScene, impact: ImpactEvents) -> ImpactEffect:
    """Return the effect of impacts of two spheres, or on walls; see `jaxgran.Rough`."""
    material = scene.material
    law = material.law if impact.axis is None else material.walls.law
    share = impact.share
    decay = drag_decay(scene.drag_rates, impact.time)
    law_speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = law.restitution(law_speed * decay.velocity)
    eps = jnp.where(impact.elastic, 1.0, eps)
    push = share * (1 + eps) * impact.speed
    lost = share**2 / 2 * (1 - eps**2) * impact.speed**2
    effect = ImpactEffect(-push[:, None] * impact.normal, lost)
    if material.surface is not None and impact.spin is not None:
        effect = _with_tangential_part(effect, material, impact, impact.spin, push, decay)
    if impact.axis is None:
        return effect
    return _with_frequency(effect, material.walls.frequency[impact.axis], eps)


def _with_tangential_part(
    effect: ImpactEffect,
    material: ReducedScene,
    impact: ImpactEvents,
    spin: Float[Array, "rows spins"],
    push: Float[Array, "rows"],
    decay: DragDecay,
) -> ImpactEffect:
    """Return the effect of an impact of rough spheres from its normal part.

    With the share s of a sphere, 1/2 of two spheres and 1 at a wall, the tangential kick k changes
    the energy by ``s k (v + k/(2 s))`` for each sphere, v being the tangential part of the relative
    velocity, and the change c of the spin changes it by ``I c (2 s w + c)/2``, w being the spin, or
    the sum of both.

    Args:
        effect: of the normal part.
        material: of the scene.
        impact: see `impact_effect`.
        spin: of the impact.
        push: normal change of velocity of the first sphere.
        decay: by drag until the impact.
    """
    surface = material.surface
    share = impact.share
    eta = surface.eta
    if impact.axis is not None:
        if material.walls.surface is None:
            unchanged = jnp.zeros_like(spin)
            return effect._replace(spin_change=unchanged, rotational_gain=unchanged[:, 0])
        eta = surface.eta_on_wall(material.walls.surface)
    spin_factor = decay.spin_over_velocity[:, None]
    sideways, kick, added_spin = tangential_impulse(
        impact.relative,
        spin * spin_factor,
        impact.normal,
        ~impact.elastic,
        eta,
        surface,
        push,
    )
    with_half = sideways + 0.5 / share * kick
    spin_change = added_spin / spin_factor
    before_and_after = spin * 2 * share + spin_change
    gain = surface.inertia / 2 * jnp.sum(spin_change * before_and_after, -1)
    return ImpactEffect(
        kick=effect.kick + kick,
        lost=effect.lost - share * jnp.sum(kick * with_half, -1),
        spin_change=spin_change,
        rotational_gain=gain,
    )


def _with_frequency(
    effect: ImpactEffect, frequency: Float[Array, "rows"], eps: Float[Array, "rows"]
) -> ImpactEffect:
    """Return the effect of impacts on walls with the dependence of their frequency in tangents.

    Walls that are closer together or dissipate more are hit more often, see `wall_impact_ratio`. A
    tangent does not know where walls and spheres are, but only how often a gas meets the walls:
    energies at walls have a factor of value 1 that carries this dependence.
    """
    dimension = effect.kick.shape[1]
    frequency = frequency * wall_impact_ratio(eps, frequency, dimension)
    weight = frequency / jax.lax.stop_gradient(frequency)
    gain = effect.rotational_gain
    gain = None if gain is None else gain * weight
    return effect._replace(lost=effect.lost * weight, rotational_gain=gain)


def exchange_gains(
    scene: SphereScene,
    tangents: ExchangeTangents,
    impact: ImpactEvents,
    happens: Bool[Array, "rows"],
) -> Float[Array, "changes energies rows"]:
    """Return the tangents of the gain of each energy.

    They are along the directions of `tangents`, then in the logarithm of all velocities, and of all
    spins where spheres rotate, as `ExchangeTangents.after` takes them.

    Args:
        scene: the gas.
        tangents: which give the directions and the number of energies.
        impact: the spheres at impacts.
        happens: whether each impact does; the others gain nothing.
    """

    def energies(material: ReducedScene, log_scales: Float[Array, "energies"]) -> Array:
        factor = jnp.exp(log_scales[0])
        scaled = impact._replace(relative=impact.relative * factor, speed=impact.speed * factor)
        if material.surface is not None and impact.spin is not None:
            # At a given energy spins are smaller where the inertia is larger.
            inertia = scene.material.surface.inertia
            log_spin = log_scales[1] - 0.5 * jnp.log(material.surface.inertia / inertia)
            scaled = scaled._replace(spin=impact.spin * jnp.exp(log_spin))
        effect = impact_effect(scene._replace(material=material), scaled)
        gained = [-effect.lost]
        if effect.rotational_gain is not None:
            gained.append(effect.rotational_gain)
        return jnp.where(happens, jnp.stack(gained), 0.0)

    num_directions, num_energies, *_ = tangents.energies.shape
    unscaled = jnp.zeros(num_energies, impact.speed.dtype)
    _, linear = jax.linearize(energies, scene.material, unscaled)

    def padded(directions: Array) -> Array:
        return jnp.pad(directions, [(0, num_energies), *[(0, 0)] * (directions.ndim - 1)])

    # First the directions without a scale, then each scale without a direction.
    directions = jax.tree.map(padded, tangents.directions)
    scales = jnp.concatenate([jnp.zeros((num_directions, num_energies)), jnp.eye(num_energies)])
    return jax.vmap(linear)(directions, scales.astype(unscaled.dtype))


class IndependentPairs(NamedTuple):
    """The pairs whose impacts happen in one round.

    Attributes:
        happens: whether the impact of each row happens.
        row_of_slot: the row in which a sphere can have its next impact: the first of several at the
            same time; the number of rows if there is none.
    """

    happens: Bool[Array, "rows"]
    row_of_slot: Int[Array, "slots"]

    @property
    def unpaired(self) -> Bool[Array, "slots"]:
        """Which spheres no other may hit in this round."""
        return self.row_of_slot == len(self.happens)


def independent_pairs(rows: PairRows, upcoming: FirstImpacts) -> IndependentPairs:
    """Return the pairs whose impact is the first of both spheres, on paths that are final."""
    a = rows.a
    b = rows.b
    num_rows = len(a)
    index = jnp.arange(num_rows, dtype=jnp.int32)
    times = upcoming.times
    happens = jnp.isfinite(times)
    for k in (a, b):
        happens &= (times == upcoming.first[k]) & (times == upcoming.final[k])
    # Of several impacts at exactly the same time, a sphere takes the one in the first row.
    rank = jnp.where(happens, index, num_rows)
    row = jnp.full(len(upcoming.first), num_rows, jnp.int32).at[a].min(rank).at[b].min(rank)
    happens &= (row[a] == index) & (row[b] == index)
    return IndependentPairs(happens, row)


class RoundImpacts(NamedTuple):
    """Impacts of pairs or on walls in one round.

    Attributes:
        happens: whether each of them does.
        time: since the start of the window; 0 if it does not happen.
        too_soon: whether it follows the last one too soon.
        events: the spheres at these impacts.
    """

    happens: Bool[Array, "rows"]
    time: Float[Array, "rows"]
    too_soon: Bool[Array, "rows"]
    events: ImpactEvents


class SlotImpacts(NamedTuple):
    """The impact of each particle in one round; particles without one have a time and a kick of 0.

    Attributes:
        happens: whether it has one.
        time: its time.
        too_soon: whether it follows the last one too soon.
        x: position of the path after it, extrapolated back to the start of the window.
        effect: on the particle.
    """

    happens: Bool[Array, "slots"]
    time: Float[Array, "slots"]
    too_soon: Bool[Array, "slots"]
    x: Float[Array, "slots d"]
    effect: ImpactEffect


class ImpactWork(NamedTuple):
    """Particles after the impacts of a window, and sums over these impacts.

    Attributes:
        paths: of the particles.
        dissipated: translational energy lost, half of it counted for each of two spheres.
        rotational_gain: gain of the energy of the (transformed) spins; None for smooth spheres.
        impacts: number of impacts of each particle on others.
        wall_impacts: number of impacts on walls of each particle; None without walls.
        regularised: number of impacts that were elastic because they followed too soon; an impact
            of two spheres counts for both of them, an impact on a wall twice.
        max_distance2: largest squared distance of each particle, at its impacts, from the place for
            which the neighbour list was built.
        max_speed2: largest squared speed of each particle.
        executed: whether the last round executed an impact.
        num_rounds: number of rounds.
        gains: tangents of the energy gained in impacts of pairs, and of slots on walls if there are
            walls, see `exchange_gains`; without tangents, no changes.
    """

    paths: Paths
    dissipated: Float[Array, "slots"]
    rotational_gain: Float[Array, "slots"] | None
    impacts: Int[Array, "slots"]
    wall_impacts: Int[Array, "slots"] | None
    regularised: Int[Array, "slots"]
    max_distance2: Float[Array, "slots"]
    max_speed2: Float[Array, "slots"]
    executed: Bool[Array, ""]
    num_rounds: Int[Array, ""]
    gains: Float[Array, "changes energies rows"]


class ImpactWindow(NamedTuple):
    """A window of time, and what decides the impacts in it.

    Attributes:
        scene: the gas, with one law for all rows or one for each.
        rows: the pairs that may touch.
        listed: the places of the particles for which the neighbour list was built.
        start_time: of the window.
        duration: of the window.
        contact_duration: of each particle; an impact within this time of the last one is elastic.
        all_elastic: whether all impacts are elastic and smooth.
        tangents: at the beginning of the window; None without them.
    """

    scene: SphereScene
    rows: PairRows
    listed: Float[Array, "slots d"]
    start_time: Float[Array, ""]
    duration: ArrayLike
    contact_duration: Float[Array, "slots"]
    all_elastic: Bool[Array, ""]
    tangents: ExchangeTangents | None

    def no_work(self, paths: Paths) -> ImpactWork:
        """Return the particles before the first impact."""
        num_slots = len(paths.x)
        num_rows = len(self.rows.a)
        has_walls = self.scene.container is not None
        counts = jnp.zeros(num_slots, jnp.int32)
        zeros = jnp.zeros(num_slots, paths.x.dtype)
        shape = (0, 1, num_rows)
        if self.tangents is not None:
            num_directions, num_energies, _ = self.tangents.energies.shape
            num_wall_rows = num_slots if has_walls else 0
            shape = (num_directions + num_energies, num_energies, num_rows + num_wall_rows)
        return ImpactWork(
            paths=paths,
            dissipated=zeros,
            rotational_gain=None if paths.spin is None else zeros,
            impacts=counts,
            wall_impacts=counts if has_walls else None,
            regularised=counts,
            max_distance2=zeros,
            max_speed2=zeros,
            executed=jnp.array(True),
            num_rounds=jnp.int32(0),
            gains=jnp.zeros(shape, zeros.dtype),
        )

    def execute_round(self, work: ImpactWork) -> ImpactWork:
        """Execute every impact that is the first of its spheres, on paths that are final."""
        paths = work.paths
        upcoming = first_impacts(paths, self.rows, self.duration, self.scene.container)
        pairs = independent_pairs(self.rows, upcoming)
        of_pairs = self.pair_impacts(paths, upcoming, pairs)
        slots = self.slots_of_pairs(paths, pairs, of_pairs)
        impacts = work.impacts + slots.happens.astype(jnp.int32)
        regularised = work.regularised + (slots.happens & slots.too_soon).astype(jnp.int32)
        wall_impacts = work.wall_impacts
        at_walls = None
        if upcoming.walls is not None and wall_impacts is not None:
            at_walls = self.wall_impacts(paths, upcoming, upcoming.walls, pairs.unpaired)
            hits_wall = at_walls.happens
            slots_at_walls = self.slots_at_walls(paths, at_walls)
            slots = jax.tree.map(partial(_where_rows, hits_wall), slots_at_walls, slots)
            wall_impacts = wall_impacts + hits_wall.astype(jnp.int32)
            regularised = regularised + 2 * (hits_wall & at_walls.too_soon).astype(jnp.int32)
        gains = work.gains
        if self.tangents is not None:
            gains = gains + self.energy_gains(self.tangents, of_pairs, at_walls)

        happens = slots.happens
        s = slots.time
        effect = slots.effect
        v = paths.v + effect.kick
        distance2 = jnp.sum((paths.x + paths.v * s[:, None] - self.listed) ** 2, -1)
        return ImpactWork(
            paths=Paths(
                x=slots.x,
                v=v,
                last=jnp.where(happens, s, paths.last),
                spin=_added(paths.spin, happens, effect.spin_change),
            ),
            dissipated=work.dissipated + jnp.where(happens, effect.lost, 0.0),
            rotational_gain=_added(work.rotational_gain, happens, effect.rotational_gain),
            impacts=impacts,
            wall_impacts=wall_impacts,
            regularised=regularised,
            max_distance2=jnp.maximum(work.max_distance2, jnp.where(happens, distance2, 0.0)),
            max_speed2=jnp.maximum(work.max_speed2, jnp.sum(v * v, -1)),
            executed=jnp.any(happens),
            num_rounds=work.num_rounds + 1,
            gains=gains,
        )

    def pair_impacts(
        self, paths: Paths, upcoming: FirstImpacts, pairs: IndependentPairs
    ) -> RoundImpacts:
        """Return the impacts of the rows of pairs."""
        a = self.rows.a
        b = self.rows.b
        happens = pairs.happens
        s = jnp.where(happens, upcoming.times, 0.0)
        r = upcoming.r + upcoming.w * s[:, None]
        normal = r / jnp.where(happens, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
        too_soon = s - jnp.maximum(paths.last[a], paths.last[b]) < self.contact_duration[a]
        events = ImpactEvents(
            time=self.start_time + s,
            normal=-normal,
            relative=upcoming.w,
            speed=jnp.where(happens, -jnp.sum(upcoming.w * normal, -1), 1.0),
            spin=None if paths.spin is None else paths.spin[a] + paths.spin[b],
            elastic=too_soon | self.all_elastic | ~happens,
        )
        return RoundImpacts(happens, s, too_soon, events)

    def slots_of_pairs(
        self, paths: Paths, pairs: IndependentPairs, impacts: RoundImpacts
    ) -> SlotImpacts:
        """Return the impacts of pairs by the slots of their spheres."""
        slots = jnp.arange(len(paths.x), dtype=jnp.int32)
        row = jnp.minimum(pairs.row_of_slot, len(self.rows.a) - 1)
        is_first = self.rows.a[row] == slots
        happens = impacts.happens[row] & (is_first | (self.rows.b[row] == slots))
        sign = jnp.where(happens, jnp.where(is_first, 1.0, -1.0), 0.0)
        effect = jax.tree.map(lambda x: x[row], impact_effect(self.scene, impacts.events))
        effect = effect._replace(kick=sign[:, None] * effect.kick)
        time = jnp.where(happens, impacts.time[row], 0.0)
        x = paths.x - effect.kick * time[:, None]
        return SlotImpacts(happens, time, impacts.too_soon[row], x, effect)

    def wall_impacts(
        self,
        paths: Paths,
        upcoming: FirstImpacts,
        walls: WallImpacts,
        unpaired: Bool[Array, "slots"],
    ) -> RoundImpacts:
        """Return the impacts on walls of particles that no other may hit."""
        times = walls.times
        happens = unpaired & jnp.isfinite(times)
        happens &= (times == upcoming.first) & (times == upcoming.final)
        s = jnp.where(happens, times, 0.0)
        too_soon = s - paths.last < self.contact_duration
        is_axis = walls.axis[:, None] == jnp.arange(paths.v.shape[1])[None]
        outwards = jnp.where(is_axis, jnp.sign(paths.v), 0.0)
        events = ImpactEvents(
            time=self.start_time + s,
            normal=outwards,
            relative=paths.v,
            speed=jnp.where(happens, jnp.sum(paths.v * outwards, axis=1), 1.0),
            spin=paths.spin,
            elastic=too_soon | self.all_elastic | ~happens,
            axis=walls.axis,
        )
        return RoundImpacts(happens, s, too_soon, events)

    def slots_at_walls(self, paths: Paths, impacts: RoundImpacts) -> SlotImpacts:
        """Return the impacts on walls by the slots of the spheres, which are their rows."""
        effect = impact_effect(self.scene, impacts.events)
        s = impacts.time[:, None]
        x = paths.x + paths.v * s - (paths.v + effect.kick) * s
        return SlotImpacts(impacts.happens, impacts.time, impacts.too_soon, x, effect)

    def energy_gains(
        self, tangents: ExchangeTangents, of_pairs: RoundImpacts, at_walls: RoundImpacts | None
    ) -> Float[Array, "changes energies rows"]:
        """Return `ImpactWork.gains` of a round."""
        # Each of two spheres gains half of the energy.
        gains = 2 * exchange_gains(self.scene, tangents, of_pairs.events, of_pairs.happens)
        if at_walls is None:
            return gains
        wall_gains = exchange_gains(self.scene, tangents, at_walls.events, at_walls.happens)
        return jnp.concatenate([gains, wall_gains], axis=-1)


def execute_impacts(
    state: SphereState,
    listed: Float[Array, "n d"],
    candidates: ImpactCandidates,
    scene: SphereScene,
    duration: ArrayLike,
    contact_time: Float[Array, ""],
    all_elastic: Bool[Array, ""],
) -> ImpactWork:
    """Execute all impacts of a window, in rounds of independent impacts.

    A round executes every impact that is the first of both its spheres before either path can have
    changed. The earliest impact of all is always one of them.

    Args:
        state: at the beginning of the window; with tangents, gains of energy along their
            directions are computed.
        listed: the places for which the neighbour list was built.
        candidates: the pairs that may touch.
        scene: the gas.
        duration: of the window.
        contact_time: in mean free times; an impact of a sphere within this time of its last one is
            elastic.
        all_elastic: whether all impacts are elastic and smooth.
    """

    def of_members(values: Float[Array, "n ..."]) -> Float[Array, "slots ..."]:
        return values.at[candidates.members].get(mode="fill", fill_value=0.0)

    internal = state.internal
    paths = Paths(
        x=of_members(state.position),
        v=of_members(state.velocity),
        last=-of_members(internal.age),
        spin=None if internal.spin is None else of_members(internal.spin),
    )
    window = ImpactWindow(
        scene=_with_law_of_rows(scene, candidates),
        rows=candidates.rows,
        listed=of_members(listed),
        start_time=state.time + state.time_rest,
        duration=duration,
        contact_duration=_contact_durations(state, candidates, scene, contact_time),
        all_elastic=all_elastic,
        tangents=state.tangents,
    )

    def unfinished(work: ImpactWork) -> Bool[Array, ""]:
        return work.executed & (work.num_rounds < MAX_ROUNDS)

    return jax.lax.while_loop(unfinished, window.execute_round, window.no_work(paths))


def _with_law_of_rows(scene: SphereScene, candidates: ImpactCandidates) -> SphereScene:
    """Return the scene with a law for each row of pairs, if replicas have different laws."""
    law = scene.material.law
    if not isinstance(law, LawOfReplicas):
        return scene
    law = law.of_rows(candidates.replica[candidates.rows.a])
    return scene._replace(material=scene.material._replace(law=law))


def _contact_durations(
    state: SphereState,
    candidates: ImpactCandidates,
    scene: SphereScene,
    contact_time: Float[Array, ""],
) -> Float[Array, "slots"]:
    """Return the contact time of each member in the units of the run."""
    replicas = len(state.dissipated)
    T = temperature(state.velocity, replicas)
    T = jnp.maximum(T, jnp.finfo(T.dtype).tiny)
    duration = contact_time / (scene.collision_frequency * jnp.sqrt(T))
    return duration[jnp.minimum(candidates.replica, replicas - 1)]


def _added(total: Any, happens: Bool[Array, "rows"], change: Any) -> Any:
    """Return a sum with the changes of impacts; None, a sum that is not kept, remains None."""
    return None if total is None else total + _where_rows(happens, change, jnp.zeros_like(total))


def _where_rows(mask: Bool[Array, "rows"], x: Array, y: Array) -> Array:
    return jnp.where(mask if x.ndim == 1 else mask[:, None], x, y)

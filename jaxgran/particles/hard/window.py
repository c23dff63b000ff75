"""The impacts of hard spheres in a window of time, executed in rounds of independent impacts.

The arrays of a window have a row for each pair that may touch, and a slot for each sphere that may
be hit in the window, on another sphere or on a wall. A slot holds one sphere; further slots at the
end of the arrays are empty (`jaxgran.particles.hard.candidates.ImpactCandidates`). Units as in
`jaxgran.particles.hard.impacts`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.hard.candidates import ImpactCandidates
from jaxgran.particles.hard.impacts import (
    ImpactEffect,
    ImpactEvents,
    LawOfReplicas,
    exchange_gains,
    impact_effect,
)
from jaxgran.particles.hard.prediction import (
    FirstImpacts,
    PairRows,
    Paths,
    WallImpacts,
    first_impacts,
)
from jaxgran.particles.spheres import SphereState, temperature
from jaxgran.scene.reduced import SphereScene

MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window at which the run counts as stalled."""


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
    """Impacts of pairs or on walls in one round; rows are the pairs, or all slots.

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
    """The impact in each slot in one round; slots without one have a time and a kick of 0.

    Attributes:
        happens: whether there is one.
        time: of it.
        too_soon: whether it follows the last one too soon.
        x: position of the path after it, extrapolated back to the start of the window.
        effect: on the particle.
    """

    happens: Bool[Array, "slots"]
    time: Float[Array, "slots"]
    too_soon: Bool[Array, "slots"]
    x: Float[Array, "slots d"]
    effect: ImpactEffect


class WindowSums(NamedTuple):
    """Sums over the impacts of a window in each replica.

    Attributes:
        dissipated: translational energy lost.
        rotational_gain: gain of the energy of the (transformed) spins; None for smooth spheres.
        collisions: number of impacts of two spheres.
        regularised: number of impacts that were elastic because they followed too soon.
        gains: tangents of the energy gained, see `exchange_gains`; without tangents, no changes.
    """

    dissipated: Float[Array, "replicas"]
    rotational_gain: Float[Array, "replicas"] | None
    collisions: Int[Array, "replicas"]
    regularised: Int[Array, "replicas"]
    gains: Float[Array, "changes energies replicas"]


class WindowProgress(NamedTuple):
    """Particles after the impacts of a window, and sums over these impacts.

    Attributes:
        paths: of the particles.
        dissipated: translational energy lost, half of it counted for each of two spheres.
        rotational_gain: gain of the energy of the (transformed) spins; None for smooth spheres.
        num_impacts: number of impacts of each particle on others.
        num_wall_impacts: number of impacts on walls of each particle; None without walls.
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
    num_impacts: Int[Array, "slots"]
    num_wall_impacts: Int[Array, "slots"] | None
    regularised: Int[Array, "slots"]
    max_distance2: Float[Array, "slots"]
    max_speed2: Float[Array, "slots"]
    executed: Bool[Array, ""]
    num_rounds: Int[Array, ""]
    gains: Float[Array, "changes energies rows"]

    @property
    def total_impacts(self) -> Int[Array, ""]:
        """Number of impacts of all spheres; an impact of two spheres counts for both of them."""
        total = jnp.sum(self.num_impacts)
        if self.num_wall_impacts is None:
            return total
        return total + jnp.sum(self.num_wall_impacts)

    def sums(self, candidates: ImpactCandidates, replicas: int) -> WindowSums:
        """Return the sums over the impacts in each replica; an empty slot belongs to none."""
        replica = candidates.replica
        replica_of_gain = replica[candidates.rows.a]
        if self.num_wall_impacts is not None:
            replica_of_gain = jnp.concatenate([replica_of_gain, replica])

        def total(values: Array, replica: Int[Array, "rows"]) -> Array:
            zeros = jnp.zeros((*values.shape[:-1], replicas), values.dtype)
            return zeros.at[..., replica].add(values, mode="drop")

        rotational_gain = None
        if self.rotational_gain is not None:
            rotational_gain = total(self.rotational_gain, replica)
        return WindowSums(
            dissipated=total(self.dissipated, replica),
            rotational_gain=rotational_gain,
            collisions=total(self.num_impacts, replica) // 2,
            regularised=total(self.regularised, replica) // 2,
            gains=total(self.gains, replica_of_gain),
        )


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

    def initial_progress(self, paths: Paths) -> WindowProgress:
        """Return the particles before the first impact."""
        num_slots = len(paths.x)
        num_rows = len(self.rows.a)
        has_walls = self.scene.container is not None
        counts = jnp.zeros(num_slots, jnp.int32)
        zeros = jnp.zeros(num_slots, paths.x.dtype)
        num_changes = 0
        num_energies = 1
        if self.tangents is not None:
            num_directions, num_energies, _ = self.tangents.energies.shape
            num_changes = num_directions + num_energies
        num_gains = num_rows + num_slots if has_walls else num_rows
        return WindowProgress(
            paths=paths,
            dissipated=zeros,
            rotational_gain=None if paths.spin is None else zeros,
            num_impacts=counts,
            num_wall_impacts=counts if has_walls else None,
            regularised=counts,
            max_distance2=zeros,
            max_speed2=zeros,
            executed=jnp.array(True),
            num_rounds=jnp.int32(0),
            gains=jnp.zeros((num_changes, num_energies, num_gains), zeros.dtype),
        )

    def execute_round(self, progress: WindowProgress) -> WindowProgress:
        """Execute every impact that is the first of its spheres, on paths that are final."""
        paths = progress.paths
        upcoming = first_impacts(paths, self.rows, self.duration, self.scene.container)
        pairs = independent_pairs(self.rows, upcoming)
        pair_impacts = self.impacts_of_pairs(paths, upcoming, pairs)
        slots = self.pair_impacts_by_slot(paths, pairs, pair_impacts)
        num_impacts = progress.num_impacts + slots.happens.astype(jnp.int32)
        regularised = progress.regularised + (slots.happens & slots.too_soon).astype(jnp.int32)
        num_wall_impacts = progress.num_wall_impacts
        wall_impacts = None
        if upcoming.walls is not None and num_wall_impacts is not None:
            wall_impacts = self.impacts_on_walls(paths, upcoming, upcoming.walls, pairs.unpaired)
            hits_wall = wall_impacts.happens
            at_walls = self.wall_impacts_by_slot(paths, wall_impacts)
            slots = jax.tree.map(partial(_where_rows, hits_wall), at_walls, slots)
            num_wall_impacts = num_wall_impacts + hits_wall.astype(jnp.int32)
            regularised = regularised + 2 * (hits_wall & wall_impacts.too_soon).astype(jnp.int32)
        gains = progress.gains
        if self.tangents is not None:
            gains = gains + self.energy_gains(self.tangents, pair_impacts, wall_impacts)

        happens = slots.happens
        s = slots.time
        effect = slots.effect
        v = paths.v + effect.kick
        distance2 = jnp.sum((paths.x + paths.v * s[:, None] - self.listed) ** 2, -1)
        return WindowProgress(
            paths=Paths(
                x=slots.x,
                v=v,
                last=jnp.where(happens, s, paths.last),
                spin=_added(paths.spin, happens, effect.spin_change),
            ),
            dissipated=progress.dissipated + jnp.where(happens, effect.lost, 0.0),
            rotational_gain=_added(progress.rotational_gain, happens, effect.rotational_gain),
            num_impacts=num_impacts,
            num_wall_impacts=num_wall_impacts,
            regularised=regularised,
            max_distance2=jnp.maximum(progress.max_distance2, jnp.where(happens, distance2, 0.0)),
            max_speed2=jnp.maximum(progress.max_speed2, jnp.sum(v * v, -1)),
            executed=jnp.any(happens),
            num_rounds=progress.num_rounds + 1,
            gains=gains,
        )

    def impacts_of_pairs(
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

    def pair_impacts_by_slot(
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

    def impacts_on_walls(
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

    def wall_impacts_by_slot(self, paths: Paths, impacts: RoundImpacts) -> SlotImpacts:
        """Return the impacts on walls by the slots of their spheres: the rows are all slots."""
        effect = impact_effect(self.scene, impacts.events)
        s = impacts.time[:, None]
        x = paths.x + paths.v * s - (paths.v + effect.kick) * s
        return SlotImpacts(impacts.happens, impacts.time, impacts.too_soon, x, effect)

    def energy_gains(
        self,
        tangents: ExchangeTangents,
        pair_impacts: RoundImpacts,
        wall_impacts: RoundImpacts | None,
    ) -> Float[Array, "changes energies rows"]:
        """Return `WindowProgress.gains` of a round."""
        # Each of two spheres gains half of the energy.
        gains = 2 * exchange_gains(self.scene, tangents, pair_impacts.events, pair_impacts.happens)
        if wall_impacts is None:
            return gains
        wall_gains = exchange_gains(self.scene, tangents, wall_impacts.events, wall_impacts.happens)
        return jnp.concatenate([gains, wall_gains], axis=-1)


def execute_impacts(
    state: SphereState,
    listed: Float[Array, "n d"],
    candidates: ImpactCandidates,
    scene: SphereScene,
    duration: ArrayLike,
    contact_time: Float[Array, ""],
    all_elastic: Bool[Array, ""],
) -> WindowProgress:
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

    def unfinished(progress: WindowProgress) -> Bool[Array, ""]:
        return progress.executed & (progress.num_rounds < MAX_ROUNDS)

    return jax.lax.while_loop(unfinished, window.execute_round, window.initial_progress(paths))


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

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
    first_impacts,
)
from jaxgran.particles.spheres import SphereState, temperature
from jaxgran.scene.elements import wall_impact_ratio
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedScene, SphereScene


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
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]


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


def impact_effect(
    scene: SphereScene, impact: ImpactEvents, axis: Int[Array, "rows"] | None = None
) -> ImpactEffect:
    """Return the effect of impacts of two spheres, or on walls across an axis; see `jaxgran.Rough`.

    Walls that are closer together or dissipate more are hit more often, see `wall_impact_ratio`. A
    tangent does not know where walls and spheres are, but only how often a gas meets the walls:
    energies at walls have a factor of value 1 that carries this dependence.
    """
    material = scene.material
    law = material.law if axis is None else material.walls.law
    share = 0.5 if axis is None else 1.0  # a wall takes no part of the change of velocity
    decay = drag_decay(scene.drag_rates, impact.time)
    law_speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = law.restitution(law_speed * decay.velocity)
    eps = jnp.where(impact.elastic, 1.0, eps)
    push = share * (1 + eps) * impact.speed
    lost = share**2 / 2 * (1 - eps**2) * impact.speed**2
    effect = ImpactEffect(-push[:, None] * impact.normal, lost)
    if material.surface is not None and impact.spin is not None:
        effect = _with_tangential_part(effect, material, impact, impact.spin, axis, push, decay)
    if axis is None:
        return effect
    frequency = material.walls.frequency[axis]
    frequency = frequency * wall_impact_ratio(eps, frequency, impact.normal.shape[1])
    weight = frequency / jax.lax.stop_gradient(frequency)
    gain = effect.rotational_gain
    gain = None if gain is None else gain * weight
    return effect._replace(lost=effect.lost * weight, rotational_gain=gain)


def _with_tangential_part(
    effect: ImpactEffect,
    material: ReducedScene,
    impact: ImpactEvents,
    spin: Float[Array, "rows spins"],
    axis: Int[Array, "rows"] | None,
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
        material, impact, axis: see `impact_effect`.
        spin: of the impact.
        push: normal change of velocity of the first sphere.
        decay: by drag until the impact.
    """
    surface = material.surface
    spin_change = jnp.zeros_like(spin)
    gain = spin_change[:, 0]
    if axis is not None and material.walls.surface is None:
        return effect._replace(spin_change=spin_change, rotational_gain=gain)
    share = 0.5 if axis is None else 1.0
    eta = surface.eta if axis is None else surface.eta_on_wall(material.walls.surface)
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


def exchange_gains(
    scene: SphereScene,
    tangents: ExchangeTangents,
    impact: ImpactEvents,
    happens: Bool[Array, "rows"],
    axis: Int[Array, "rows"] | None = None,
) -> Float[Array, "changes energies rows"]:
    """Return the tangents of the gain of each energy.

    They are along the directions of `tangents`, then in the logarithm of all velocities, and of all
    spins where spheres rotate, as `ExchangeTangents.after` takes them.
    """

    def energies(material: ReducedScene, log_scales: Float[Array, "energies"]) -> Array:
        factor = jnp.exp(log_scales[0])
        scaled = impact._replace(relative=impact.relative * factor, speed=impact.speed * factor)
        if material.surface is not None and impact.spin is not None:
            # At a given energy spins are smaller where the inertia is larger.
            inertia = scene.material.surface.inertia
            log_spin = log_scales[1] - 0.5 * jnp.log(material.surface.inertia / inertia)
            scaled = scaled._replace(spin=impact.spin * jnp.exp(log_spin))
        effect = impact_effect(scene._replace(material=material), scaled, axis)
        gained = [-effect.lost]
        if effect.rotational_gain is not None:
            gained.append(effect.rotational_gain)
        return jnp.where(happens, jnp.stack(gained), 0.0)

    num_energies = tangents.energies.shape[1]
    none = jnp.zeros(num_energies, impact.speed.dtype)
    _, linear = jax.linearize(energies, scene.material, none)
    num_directions = len(tangents.energies)
    scales = jnp.concatenate([jnp.zeros((num_directions, num_energies)), jnp.eye(num_energies)])

    def padded(directions: Array) -> Array:
        return jnp.pad(directions, [(0, num_energies), *[(0, 0)] * (directions.ndim - 1)])

    return jax.vmap(linear)(jax.tree.map(padded, tangents.directions), scales.astype(none.dtype))


class SlotImpacts(NamedTuple):
    """The impact of each particle in one round; particles without one have a time and a kick of 0.

    Attributes:
        happens: whether it has one.
        time: its time.
        x: position of the path after it, extrapolated back to the start of the window.
        effect: on the particle.
        too_soon: whether it follows the last one too soon.
    """

    happens: Bool[Array, "slots"]
    time: Float[Array, "slots"]
    x: Float[Array, "slots d"]
    effect: ImpactEffect
    too_soon: Bool[Array, "slots"]


class ImpactRules(NamedTuple):
    """What decides the effect of impacts in a window.

    Attributes:
        scene: the gas, with one law for all rows or one for each.
        tangents: at the beginning of the window; None without them.
        start_time: of the window.
        contact_duration: of each particle; an impact within this time of the last one is elastic.
        all_elastic: whether all impacts are elastic and smooth.
        rows: the pairs that may touch.
    """

    scene: SphereScene
    tangents: ExchangeTangents | None
    start_time: Float[Array, ""]
    contact_duration: Float[Array, "slots"]
    all_elastic: Bool[Array, ""]
    rows: PairRows

    def pair_impacts(
        self, paths: Paths, upcoming: FirstImpacts
    ) -> tuple[SlotImpacts, Bool[Array, "slots"], Array | None]:
        """Return the impacts of pairs, which particles no pair may hit, and gains of the pairs."""
        a = self.rows.a
        b = self.rows.b
        num_rows = len(a)
        index = jnp.arange(num_rows, dtype=jnp.int32)
        slots = jnp.arange(len(paths.x), dtype=jnp.int32)
        times = upcoming.times
        executable = jnp.isfinite(times)
        for k in (a, b):
            executable &= (times == upcoming.first[k]) & (times == upcoming.final[k])
        # Of several impacts at exactly the same time, a sphere takes the one in the first row.
        rank = jnp.where(executable, index, num_rows)
        row = jnp.full(len(slots), num_rows, jnp.int32).at[a].min(rank).at[b].min(rank)
        executable &= (row[a] == index) & (row[b] == index)

        s = jnp.where(executable, times, 0.0)
        r = upcoming.r + upcoming.w * s[:, None]
        normal = r / jnp.where(executable, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
        speed = jnp.where(executable, -jnp.sum(upcoming.w * normal, -1), 1.0)
        too_soon = s - jnp.maximum(paths.last[a], paths.last[b]) < self.contact_duration[a]
        spin = None if paths.spin is None else paths.spin[a] + paths.spin[b]
        elastic = too_soon | self.all_elastic | ~executable
        events = ImpactEvents(self.start_time + s, -normal, upcoming.w, speed, spin, elastic)
        effect = impact_effect(self.scene, events)
        gains = None
        if self.tangents is not None:  # each of two loses half of the energy
            gains = 2 * exchange_gains(self.scene, self.tangents, events, executable)

        # From the rows of pairs to the slots of their spheres.
        row_or_last = jnp.minimum(row, num_rows - 1)
        is_first = a[row_or_last] == slots
        happens = executable[row_or_last] & (is_first | (b[row_or_last] == slots))
        sign = jnp.where(happens, jnp.where(is_first, 1.0, -1.0), 0.0)
        effect = jax.tree.map(lambda x: x[row_or_last], effect)
        effect = effect._replace(kick=sign[:, None] * effect.kick)
        time = jnp.where(happens, s[row_or_last], 0.0)
        x = paths.x - effect.kick * time[:, None]
        impacts = SlotImpacts(happens, time, x, effect, too_soon[row_or_last])
        return impacts, row == num_rows, gains

    def wall_impacts(
        self, paths: Paths, upcoming: FirstImpacts, unpaired: Bool[Array, "slots"]
    ) -> tuple[SlotImpacts, Array | None]:
        """Return the impacts on walls of particles that no pair may hit, and their gains."""
        times = upcoming.wall_times
        axis = upcoming.wall_axis
        assert times is not None and axis is not None
        happens = unpaired & jnp.isfinite(times)
        happens &= (times == upcoming.first) & (times == upcoming.final)
        s = jnp.where(happens, times, 0.0)
        too_soon = s - paths.last < self.contact_duration
        is_axis = axis[:, None] == jnp.arange(paths.v.shape[1])[None]
        outwards = jnp.where(is_axis, jnp.sign(paths.v), 0.0)
        speed = jnp.where(happens, jnp.sum(paths.v * outwards, axis=1), 1.0)
        elastic = too_soon | self.all_elastic | ~happens
        events = ImpactEvents(self.start_time + s, outwards, paths.v, speed, paths.spin, elastic)
        effect = impact_effect(self.scene, events, axis)
        gains = None
        if self.tangents is not None:
            gains = exchange_gains(self.scene, self.tangents, events, happens, axis)
        x = paths.x + paths.v * s[:, None] - (paths.v + effect.kick) * s[:, None]
        return SlotImpacts(happens, s, x, effect, too_soon), gains


MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window at which the run counts as stalled."""


class ImpactWork(NamedTuple):
    """Particles after the impacts of a window, and sums over these impacts.

    Attributes:
        paths: of the particles.
        dissipated: translational energy lost, half of it counted for each of two spheres.
        rotational_gain: gain of the energy of the (transformed) spins; None for smooth spheres.
        impacts: number of impacts of each particle on others.
        wall_impacts: number of impacts on walls of each particle; None without walls.
        regularised: number of impacts that were elastic because they followed too soon.
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

    def of_members(values):
        return values.at[candidates.members].get(mode="fill", fill_value=0.0)

    internal = state.internal
    tangents = state.tangents
    start_time = state.time + state.time_rest
    spin = None if internal.spin is None else of_members(internal.spin)
    x, v, listed = (of_members(values) for values in (state.position, state.velocity, listed))
    paths = Paths(x, v, -of_members(internal.age), spin)
    replicas = len(state.dissipated)
    T = temperature(state.velocity, replicas)
    T = jnp.maximum(T, jnp.finfo(T.dtype).tiny)
    contact_duration = contact_time / (scene.collision_frequency * jnp.sqrt(T))
    contact_duration = contact_duration[jnp.minimum(candidates.replica, replicas - 1)]
    rows = candidates.rows
    law = scene.material.law
    if isinstance(law, LawOfReplicas):
        law = law.of_rows(candidates.replica[rows.a])
        scene = scene._replace(material=scene.material._replace(law=law))
    rules = ImpactRules(scene, tangents, start_time, contact_duration, all_elastic, rows)

    def one_round(work: ImpactWork) -> ImpactWork:
        paths = work.paths
        upcoming = first_impacts(paths, rows, duration, scene.container)
        of_pairs, unpaired, gains = rules.pair_impacts(paths, upcoming)
        happening = of_pairs
        wall_impacts = work.wall_impacts
        regularised = work.regularised + (of_pairs.happens & of_pairs.too_soon).astype(jnp.int32)
        if wall_impacts is not None:
            at_walls, wall_gains = rules.wall_impacts(paths, upcoming, unpaired)
            happening = jax.tree.map(partial(_where_rows, at_walls.happens), at_walls, of_pairs)
            wall_impacts = wall_impacts + at_walls.happens.astype(jnp.int32)
            # An impact of two spheres counts twice.
            too_soon = at_walls.happens & at_walls.too_soon
            regularised = regularised + 2 * too_soon.astype(jnp.int32)
            if gains is not None and wall_gains is not None:
                gains = jnp.concatenate([gains, wall_gains], axis=-1)
        hit = happening.happens
        s = happening.time
        effect = happening.effect
        v = paths.v + effect.kick
        spin = paths.spin
        rotational_gain = work.rotational_gain
        if spin is not None and rotational_gain is not None and effect.rotational_gain is not None:
            spin = spin + _where_rows(hit, effect.spin_change, jnp.zeros_like(spin))
            rotational_gain = rotational_gain + jnp.where(hit, effect.rotational_gain, 0.0)
        distance2 = jnp.sum((paths.x + paths.v * s[:, None] - listed) ** 2, -1)
        return ImpactWork(
            paths=Paths(happening.x, v, jnp.where(hit, s, paths.last), spin),
            dissipated=work.dissipated + jnp.where(hit, effect.lost, 0.0),
            rotational_gain=rotational_gain,
            impacts=work.impacts + of_pairs.happens.astype(jnp.int32),
            wall_impacts=wall_impacts,
            regularised=regularised,
            max_distance2=jnp.maximum(work.max_distance2, jnp.where(hit, distance2, 0.0)),
            max_speed2=jnp.maximum(work.max_speed2, jnp.sum(v * v, -1)),
            executed=jnp.any(hit),
            num_rounds=work.num_rounds + 1,
            gains=work.gains if gains is None else work.gains + gains,
        )

    def unfinished(work: ImpactWork):
        return work.executed & (work.num_rounds < MAX_ROUNDS)

    num_slots = len(x)
    num_rows = len(rows.a)
    counts = jnp.zeros(num_slots, jnp.int32)
    zeros = jnp.zeros(num_slots, paths.x.dtype)
    shape = 0, 1, num_rows
    if tangents is not None:
        num_directions, num_energies, _ = tangents.energies.shape
        num_wall_rows = 0 if scene.container is None else num_slots
        shape = num_directions + num_energies, num_energies, num_rows + num_wall_rows
    work = ImpactWork(
        paths=paths,
        dissipated=zeros,
        rotational_gain=None if paths.spin is None else zeros,
        impacts=counts,
        wall_impacts=None if scene.container is None else counts,
        regularised=counts,
        max_distance2=zeros,
        max_speed2=zeros,
        executed=jnp.array(True),
        num_rounds=jnp.int32(0),
        gains=jnp.zeros(shape, zeros.dtype),
    )
    return jax.lax.while_loop(unfinished, one_round, work)


def _where_rows(mask: Bool[Array, "rows"], x: Any, y: Any) -> Array:
    return jnp.where(mask if x.ndim == 1 else mask[:, None], x, y)

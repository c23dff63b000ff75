"""Execution of the impacts of hard spheres within one window of time.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window.

A gas of hard spheres in reduced units.

What impacts of hard spheres do, to each other and to walls.

Units here: the diameter, the mass and the first temperature are 1. Where there is drag, velocities,
spins and time are transformed: see `jaxgran.particles.state`.

Tangents of hard spheres with elements: rough ones, between walls, with drag, driven.

See `jaxgran.gradients.tangents`. What is followed at each impact is the energy that it exchanges, as
a function of the numbers of the material and of the scale of all velocities and spins.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.gradients.tangents import ExchangeTangents, ImpactTangents
from jaxgran.particles.hard.prediction import (
    FirstImpacts,
    HardWalls,
    Rows,
    Selection,
    Slots,
    first_impacts,
)
from jaxgran.particles.state import DragDecay, TangentialImpulse, drag_decay, tangential_impulse
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, share_of_impacts
from jaxgran.scene.gas import mean_loss
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedDrag, ReducedDrive, ReducedRough


class Material(NamedTuple):
    """The numbers of a scene with elements that derivatives are followed in.

    Attributes:
        law, surface, drag, drive: as in `HardScene`.
        wall_law, wall_beta, wall_frequency: of `HardWalls`.
    """

    law: ReducedLaw
    surface: ReducedRough | None
    drag: ReducedDrag | None
    drive: ReducedDrive | None
    wall_law: ReducedLaw | None
    wall_beta: Float[Array, "..."] | None
    wall_frequency: Float[Array, "..."] | None


class HardScene(NamedTuple):
    """A gas of hard spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the periodic box.
        law: of restitution, for speeds in units of sqrt(2).
        collision_frequency: at T = 1.
        contact_time: in mean free times; the impact of a sphere within this time of its last one
            is elastic.
        elastic: whether all impacts are, and smooth.
        surface: of rough spheres; else None.
        walls: of a container; None where the box is periodic.
        drag: rates over the collision frequency; None in a vacuum. Time and velocities are then
            transformed, see `jaxgran.particles.state`.
        drive: growth of T over the collision frequency by white noise; None where there is none.
        prepared: () where the gas begins in the steady state of such a drive; else None.
    """

    side: Float[Array, ""]
    law: ReducedLaw
    collision_frequency: Float[Array, ""]
    contact_time: Float[Array, ""]
    elastic: Bool[Array, ""]
    surface: ReducedRough | None = None
    walls: HardWalls | None = None
    drag: ReducedDrag | None = None
    drive: ReducedDrive | None = None
    prepared: tuple[()] | None = None

    @property
    def has_elements(self) -> bool:
        """Whether there is more than smooth spheres in free flight."""
        return any(x is not None for x in (self.surface, self.walls, self.drag, self.drive))

    @property
    def material(self) -> ReducedLaw | Material:
        """The numbers that derivatives are followed in: those of the law, and of elements.

        All are per collision, so that a denser gas does the same sooner.
        """
        if not self.has_elements:
            return self.law
        found = Material(self.law, self.surface, self.drag, self.drive, None, None, None)
        if self.walls is None:
            return found
        _, law, beta, frequency = self.walls
        return found._replace(wall_law=law, wall_beta=beta, wall_frequency=frequency)

    def log_loss(self, material: ReducedLaw) -> Float[Array, ""]:
        """ln of ``I/(1 - I)`` with the share I of the normal energy that impacts take."""
        lost = mean_loss(material, self.side)
        return jnp.log(lost) - jnp.log1p(-lost)

    def with_material(self, material: Any) -> "HardScene":
        """The same scene with other numbers of its material."""
        if not self.has_elements:
            return self._replace(law=material)
        walls = self.walls
        if walls is not None:
            law: Any = material.wall_law
            frequency: Any = material.wall_frequency
            walls = walls._replace(law=law, beta=material.wall_beta, frequency=frequency)
        return self._replace(
            law=material.law,
            surface=material.surface,
            walls=walls,
            drag=material.drag,
            drive=material.drive,
        )

    def by_impacts(self, elastic: bool) -> "HardScene":
        """The scene of a melt, without drag and drive; with elastic and smooth impacts or not."""
        drag = None if self.drag is None else ReducedDrag(*(0 * x for x in self.drag))
        drive = None if self.drive is None else ReducedDrive(0 * self.drive.strength)
        return self._replace(elastic=self.elastic | elastic, drag=drag, drive=drive)

    @property
    def decay_rates(self) -> ReducedDrag:
        """The drag in the units of the scene's time."""
        assert self.drag is not None
        rate, nu = self.drag, self.collision_frequency
        return ReducedDrag(rate.rate * nu, rate.rotational_rate * nu)


class Impact(NamedTuple):
    """Spheres at impact, on others or on walls; rows without an impact have no meaning.

    Attributes:
        time: of the gas.
        normal: from the first sphere out into the second, or into the wall.
        relative: velocity of the first less that of the second, or of the sphere.
        speed: its normal part.
        spin: sum of the spins that are kept, or the sphere's; None of smooth spheres.
        elastic: the impact is elastic and smooth.
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]

    def faster(self, velocity: Float[Array, ""], spin: Float[Array, ""]) -> "Impact":
        """The same with all velocities and all spins greater by factors exp(...)."""
        factor = jnp.exp(velocity)
        return self._replace(
            relative=self.relative * factor,
            speed=self.speed * factor,
            spin=None if self.spin is None else self.spin * jnp.exp(spin),
        )


class Effect(NamedTuple):
    """What impacts do to the first sphere; the second gets the opposite kick and the same twist.

    Attributes:
        kick: change of velocity.
        lost: translational energy lost, by each sphere half of what both lose.
        twist: change of the spin that is kept; None of smooth spheres.
        turned: gain of the energy of the spins that are kept, likewise; None of smooth spheres.
    """

    kick: Float[Array, "rows d"]
    lost: Float[Array, "rows"]
    spin_change: Float[Array, "rows spins"] | None = None
    rotational_gain: Float[Array, "rows"] | None = None


def pair_effect(scene: HardScene, impact: Impact) -> Effect:
    """The effect of impacts of two spheres, see `jaxgran.Rough`."""
    left = None if scene.drag is None else drag_decay(scene.decay_rates, impact.time)
    eps = _restitution(scene, impact, left)
    kick = (-0.5 * (1 + eps) * impact.speed)[:, None] * impact.normal
    effect = Effect(kick, 0.125 * (1 - eps * eps) * impact.speed**2)
    if scene.surface is None or impact.spin is None:
        return effect
    return _with_tangential(
        effect, impact, left, scene.surface.eta, scene.surface.inertia, shares=2
    )


def wall_effect(scene: HardScene, impact: Impact, axis: Int[Array, "rows"]) -> Effect:
    """The effect of impacts on the walls across an axis, whose law is that of `HardWalls`."""
    walls, surface = scene.walls, scene.surface
    assert walls is not None
    left = None if scene.drag is None else drag_decay(scene.decay_rates, impact.time)
    eps = _restitution(scene._replace(law=walls.law), impact, left)
    kick = -((1 + eps) * impact.speed)[:, None] * impact.normal
    effect = Effect(kick, 0.5 * (1 - eps**2) * impact.speed**2)
    if surface is None or impact.spin is None:
        return effect
    if walls.beta is None:
        nothing = jnp.zeros_like(impact.spin)
        return effect._replace(spin_change=nothing, rotational_gain=nothing[:, 0])
    return _with_tangential(
        effect, impact, left, surface.eta_on_wall(walls.beta), surface.inertia, shares=1
    )


def wall_effect_along(scene: HardScene, impact: Impact, axis: Int[Array, "rows"]) -> Effect:
    """The effect of impacts on walls to a derivative: of more where walls are nearer or take more.

    A derivative sees neither where walls are nor where spheres are; it knows how often a gas meets
    them, see `share_of_impacts`.
    """
    assert scene.walls is not None
    effect = wall_effect(scene, impact, axis)
    often = scene.walls.frequency[axis]
    eps = -jnp.sum(effect.kick * impact.normal, -1) / impact.speed - 1
    often = often * share_of_impacts(eps, often, impact.normal.shape[1])
    share = often / jax.lax.stop_gradient(often)
    rotational_gain = None if effect.rotational_gain is None else effect.rotational_gain * share
    return effect._replace(lost=effect.lost * share, rotational_gain=rotational_gain)


def _restitution(scene: HardScene, impact: Impact, left: DragDecay | None) -> Float[Array, "rows"]:
    speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = scene.law.restitution(speed if left is None else speed * left.velocity)
    return jnp.where(impact.elastic, 1.0, eps)


def _with_tangential(
    effect: Effect,
    impact: Impact,
    left: DragDecay | None,
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
    shares: int,
) -> Effect:
    """The effect with the tangential part of impacts, of which each sphere bears a share."""
    assert impact.spin is not None
    kept = 1.0 if left is None else left.spin[:, None]
    found: TangentialImpulse = tangential_impulse(
        impact.relative, impact.spin * kept, impact.normal, ~impact.elastic, eta, inertia
    )
    if shares == 2:
        lost = -0.5 * jnp.sum(found.kick * (found.sideways + found.kick), -1)
    else:
        lost = -jnp.sum(found.kick * (found.sideways + 0.5 * found.kick), -1)
    spin_change = found.spin_change / kept
    rotational_gain = (
        inertia / 2 * jnp.sum(spin_change * (impact.spin * 2 / shares + spin_change), -1)
    )
    return Effect(effect.kick + found.kick, effect.lost + lost, spin_change, rotational_gain)


class HardTangents(NamedTuple):
    """Tangents of a state along p directions.

    Attributes:
        directions: in the material, stacked along a first axis of each leaf; the last one is that
            of time, in which everything is more frequent.
        exchange: tangents of the energies of translation and of the spins that are kept.
    """

    directions: Any
    exchange: ExchangeTangents

    @classmethod
    def at_start(
        cls, scene: HardScene, directions: Any, replicas: int, num_particles: int, dimension: int
    ) -> "HardTangents":
        """The tangents at t = 0, where T is 1 and T_rot as the material has it."""
        directions = jax.tree.map(_with_time_direction, directions)
        if scene.drag is not None:  # drag is sooner over, too
            rates = jax.tree.map(lambda x, rate: x.at[-1].set(rate), directions.drag, scene.drag)
            directions = directions._replace(drag=rates)
        p = len(jax.tree.leaves(directions)[0])
        energies = jnp.zeros((p, 2, replicas), scene.collision_frequency.dtype)
        if scene.surface is not None:
            each = num_particles * NUM_SPIN_COMPONENTS[dimension] / 2
            energies = energies.at[:, 1].add(each * directions.surface.ratio[:, None])
        return cls(directions, ExchangeTangents(energies, jnp.zeros((p, replicas), energies.dtype)))

    def gains(
        self,
        scene: HardScene,
        impact: Impact,
        happens: Bool[Array, "rows"],
        effect_of: Callable[[HardScene, Impact], Effect],
    ) -> Float[Array, "changes 2 rows"]:
        """Tangents of what both energies gain in impacts, see `ExchangeTangents.after`."""

        def energies(material: Material, velocity: Array, spin: Array) -> Array:
            if scene.surface is not None and material.surface is not None:
                # At a given energy spins are smaller where the inertia is larger.
                spin = spin - 0.5 * jnp.log(material.surface.inertia / scene.surface.inertia)
            effect = effect_of(scene.with_material(material), impact.faster(velocity, spin))
            rotational_gain = (
                jnp.zeros_like(effect.lost)
                if effect.rotational_gain is None
                else effect.rotational_gain
            )
            return jnp.where(happens, jnp.stack([-effect.lost, rotational_gain]), 0.0)

        zero, one = (jnp.full((), x, impact.speed.dtype) for x in (0.0, 1.0))
        material: Any = scene.material
        _, linear = jax.linearize(energies, material, zero, zero)
        nothing = jax.tree.map(jnp.zeros_like, material)
        along = jax.vmap(lambda direction: linear(direction, zero, zero))(self.directions)
        scales = jnp.stack([linear(nothing, one, zero), linear(nothing, zero, one)])
        return jnp.concatenate([along, scales])

    @property
    def num_changes(self) -> int:
        """Rows of `gains`."""
        return len(self.exchange.energies) + 2


def _with_time_direction(leaf: Array) -> Array:
    """Directions with a last one, along which the number does not change."""
    return jnp.concatenate([leaf, jnp.zeros((1, *leaf.shape[1:]), leaf.dtype)])


MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window from which on the run counts as stalled."""


class ImpactWork(NamedTuple):
    """The particles after the impacts of a window, and sums over these impacts.

    Attributes:
        slots: the particles.
        dissipated: translational energy lost, half of it counted for each of two spheres.
        turned: gain of the energy of the spins that are kept; None of smooth spheres.
        impacts: number of impacts of each particle.
        bounces: number of impacts on walls of each particle; None without walls.
        regularised: number of impacts that were elastic because they followed too soon.
        moved: largest squared distance of each particle, at its impacts, from the place for which
            the neighbour list was built.
        fastest: largest squared speed of each particle.
        pending: whether the last round executed an impact.
        num_rounds: number of rounds.
        gains: of energy in impacts of pairs along directions in the material, see
            `ImpactTangents` and `HardTangents`; without tangents, no rows.
        wall_gains: in impacts on walls.
    """

    slots: Slots
    dissipated: Float[Array, "slots"]
    rotational_gain: Float[Array, "slots"] | None
    impacts: Int[Array, "slots"]
    bounces: Int[Array, "slots"] | None
    regularised: Int[Array, "slots"]
    moved: Float[Array, "slots"]
    fastest: Float[Array, "slots"]
    pending: Bool[Array, ""]
    num_rounds: Int[Array, ""]
    gains: Float[Array, "changes *energies rows"]
    wall_gains: Float[Array, "wallchanges 2 slots"]


def resolve(
    slots: Slots,
    listed: Float[Array, "slots d"],
    chosen: Selection,
    scene: HardScene,
    began: Float[Array, ""],
    duration: ArrayLike,
    shortest: Float[Array, "replicas"],
    along: ImpactTangents | HardTangents | None,
) -> ImpactWork:
    """Execute all impacts of a window, in rounds of independent impacts.

    A round executes every impact that is the first of both its spheres before either path can have
    changed. The earliest impact of all is always one of them.

    Args:
        slots: the members of the selection.
        listed: the places for which the neighbour list was built.
        chosen: the selection.
        scene: the gas.
        began: time at which the window begins.
        duration: of the window.
        shortest: time after a sphere's last impact within which its next one is elastic.
        along: the tangents, if they are followed, for the gains of energy along their directions.
    """
    shortest = shortest[jnp.minimum(chosen.replica, len(shortest) - 1)]

    def one_round(work: ImpactWork) -> ImpactWork:
        impacts, safe, row = _executable(work.slots, chosen.rows, duration, scene.walls)
        s, soon, met = _impact_events(
            impacts, safe, work.slots, chosen.rows, shortest, scene, began
        )
        effect = pair_effect(scene, met)
        new = _with_pair_impacts(work, effect, s, soon, safe, row, chosen.rows, listed)
        new = new._replace(gains=work.gains + _gains(along, scene, met, safe, soon))
        if impacts.bounces is None or scene.walls is None:
            return new
        alone = row == len(chosen.rows.a)
        return _with_wall_impacts(work, new, impacts, alone, listed, shortest, scene, began, along)

    def unfinished(work: ImpactWork):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    first = _initial_work(slots, scene, along, len(chosen.rows.a))
    return jax.lax.while_loop(unfinished, one_round, first)


def _initial_work(
    slots: Slots, scene: HardScene, along: ImpactTangents | HardTangents | None, num_rows: int
) -> ImpactWork:
    """Before the first round."""
    num_slots = len(slots.v)
    count, zeros = jnp.zeros(num_slots, jnp.int32), jnp.zeros(num_slots, slots.x.dtype)
    size, on_walls = (0, num_rows), (0, 2, num_slots)
    if isinstance(along, ImpactTangents):
        size = len(along.log_temperature) + 1, num_rows
    elif along is not None:
        size = along.num_changes, 2, num_rows
        on_walls = (0 if scene.walls is None else along.num_changes), 2, num_slots
    return ImpactWork(
        slots=slots,
        dissipated=zeros,
        rotational_gain=None if slots.spin is None else zeros,
        impacts=count,
        bounces=None if scene.walls is None else count,
        regularised=count,
        moved=zeros,
        fastest=zeros,
        pending=jnp.array(True),
        num_rounds=jnp.int32(0),
        gains=jnp.zeros(size, zeros.dtype),
        wall_gains=jnp.zeros(on_walls, zeros.dtype),
    )


def _gains(
    along: ImpactTangents | HardTangents | None,
    scene: HardScene,
    met: Impact,
    safe: Bool[Array, "rows"],
    soon: Bool[Array, "rows"],
) -> Float[Array, "changes *energies rows"]:
    """The gains of energy along directions in the material, in the impacts marked as safe."""
    if along is None:
        return jnp.zeros((0, len(safe)), met.speed.dtype)
    if isinstance(along, HardTangents):
        # By each of two spheres half of it is lost.
        return 2 * along.gains(scene, met, safe, pair_effect)
    # The law's unit of speed is sqrt(2).
    gained = 2 * along.gains(scene.law, met.speed * 0.5**0.5)
    return jnp.where((safe & ~soon & ~scene.elastic)[None], gained, 0.0)


def _executable(
    slots: Slots, rows: Rows, duration: ArrayLike, walls: HardWalls | None
) -> tuple[FirstImpacts, Bool[Array, "rows"], Int[Array, "slots"]]:
    """The next impacts, which of them can be executed now, and the row of each particle's own.

    A particle without one has a row beyond the last.
    """
    a, b = rows.a, rows.b
    index = jnp.arange(len(a), dtype=jnp.int32)
    impacts = first_impacts(slots, rows, duration, walls)
    safe = jnp.isfinite(impacts.times)
    for k in (a, b):
        safe &= (impacts.times == impacts.first[k]) & (impacts.times == impacts.final[k])
    # Of several impacts at the very same time a sphere takes the one in the first row.
    rank = jnp.where(safe, index, len(a))
    row = jnp.full(len(slots.v), len(a), jnp.int32).at[a].min(rank).at[b].min(rank)
    return impacts, safe & (row[a] == index) & (row[b] == index), row


def _impact_events(
    impacts: FirstImpacts,
    safe: Bool[Array, "rows"],
    slots: Slots,
    rows: Rows,
    shortest: Float[Array, "slots"],
    scene: HardScene,
    began: Float[Array, ""],
) -> tuple[Float[Array, "rows"], Bool[Array, "rows"], Impact]:
    """The impacts of pairs marked as safe: their times, whether they come too soon, and they."""
    s = jnp.where(safe, impacts.times, 0.0)
    r = impacts.r + impacts.w * s[:, None]
    normal = r / jnp.where(safe, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
    speed = jnp.where(safe, -jnp.sum(impacts.w * normal, -1), 1.0)
    soon = s - jnp.maximum(slots.last[rows.a], slots.last[rows.b]) < shortest[rows.a]
    spin = None if slots.spin is None else slots.spin[rows.a] + slots.spin[rows.b]
    elastic = soon | scene.elastic | ~safe
    return s, soon, Impact(began + s, -normal, impacts.w, speed, spin, elastic)


def _with_pair_impacts(
    work: ImpactWork,
    effect: Effect,
    time: Float[Array, "rows"],
    soon: Bool[Array, "rows"],
    safe: Bool[Array, "rows"],
    row: Int[Array, "slots"],
    rows: Rows,
    listed: Float[Array, "slots d"],
) -> ImpactWork:
    """The particles after the impacts marked as safe, and the sums with these impacts."""
    slots, internal = work.slots, jnp.arange(len(row), dtype=jnp.int32)
    row = jnp.minimum(row, len(rows.a) - 1)
    hit = safe[row] & ((rows.a[row] == internal) | (rows.b[row] == internal))
    s = jnp.where(hit, time[row], 0.0)
    sign = jnp.where(hit, jnp.where(rows.a[row] == internal, 1.0, -1.0), 0.0)
    kick = sign[:, None] * effect.kick[row]
    place = slots.x + slots.v * s[:, None]
    v = slots.v + kick
    spin, rotational_gain = slots.spin, work.rotational_gain
    if spin is not None and rotational_gain is not None and effect.spin_change is not None:
        assert effect.rotational_gain is not None
        spin = spin + jnp.where(hit[:, None], effect.spin_change[row], 0.0)
        rotational_gain = rotational_gain + jnp.where(hit, effect.rotational_gain[row], 0.0)
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return work._replace(
        slots=Slots(slots.x - kick * s[:, None], v, jnp.where(hit, s, slots.last), spin),
        dissipated=work.dissipated + jnp.where(hit, effect.lost[row], 0.0),
        rotational_gain=rotational_gain,
        impacts=work.impacts + hit,
        regularised=work.regularised + (hit & soon[row]),
        moved=jnp.maximum(work.moved, away),
        fastest=jnp.maximum(work.fastest, jnp.sum(v * v, -1)),
        pending=jnp.any(safe),
        num_rounds=work.num_rounds + 1,
    )


def _with_wall_impacts(
    old: ImpactWork,
    new: ImpactWork,
    impacts: FirstImpacts,
    alone: Bool[Array, "slots"],
    listed: Float[Array, "slots d"],
    shortest: Float[Array, "slots"],
    scene: HardScene,
    began: Float[Array, ""],
    along: ImpactTangents | HardTangents | None,
) -> ImpactWork:
    """The particles after a round, with those impacts on walls that nothing can come before.

    Args:
        old, new: before the round, and after its impacts of pairs.
        impacts: the next ones, before the round.
        alone: who takes part in no impact of a pair.
        listed, shortest, scene, began, along: as for `resolve`.
    """
    assert impacts.bounces is not None and scene.walls is not None and new.bounces is not None
    slots, (times, axis) = old.slots, impacts.bounces
    hit = alone & jnp.isfinite(times) & (times == impacts.first) & (times == impacts.final)
    s = jnp.where(hit, times, 0.0)
    soon = s - slots.last < shortest
    across = axis[:, None] == jnp.arange(slots.v.shape[1])[None]
    outwards = jnp.where(across, jnp.sign(slots.v), 0.0)
    speed = jnp.where(hit, jnp.sum(slots.v * outwards, axis=1), 1.0)
    met = Impact(began + s, outwards, slots.v, speed, slots.spin, soon | scene.elastic | ~hit)
    effect = wall_effect(scene, met, axis)
    kick = jnp.where(hit[:, None], effect.kick, 0.0)
    place = slots.x + slots.v * s[:, None]
    v = jnp.where(hit[:, None], slots.v + kick, new.slots.v)
    x = jnp.where(hit[:, None], place - v * s[:, None], new.slots.x)
    spin, rotational_gain = new.slots.spin, new.rotational_gain
    if spin is not None and rotational_gain is not None and effect.spin_change is not None:
        assert effect.rotational_gain is not None
        spin = spin + jnp.where(hit[:, None], effect.spin_change, 0.0)
        rotational_gain = rotational_gain + jnp.where(hit, effect.rotational_gain, 0.0)
    gains = new.wall_gains
    if isinstance(along, HardTangents):
        gains = gains + along.gains(scene, met, hit, partial(wall_effect_along, axis=axis))
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return new._replace(
        slots=Slots(x, v, jnp.where(hit, s, new.slots.last), spin),
        dissipated=new.dissipated + jnp.where(hit, effect.lost, 0.0),
        rotational_gain=rotational_gain,
        bounces=new.bounces + hit,
        regularised=new.regularised + 2 * (hit & soon),  # an impact of two spheres counts twice
        moved=jnp.maximum(new.moved, away),
        fastest=jnp.maximum(new.fastest, jnp.sum(v * v, -1)),
        pending=new.pending | jnp.any(hit),
        wall_gains=gains,
    )

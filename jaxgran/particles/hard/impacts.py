"""Hard spheres in reduced units, the effect of their impacts, and the impacts of a window of time.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window. With drag, velocities, spins and time are transformed:
see `jaxgran.particles.state`. Spins here are then the transformed ones, which drag does not change.

For tangents see `jaxgran.gradients.tangents`. The tangents of a scene with elements follow the
energy that each impact exchanges, as a function of the numbers of the material and of the scale of
all velocities and spins.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.gradients.tangents import ExchangeTangents, ImpactTangents
from jaxgran.particles.hard.prediction import (
    HardWalls,
    ImpactCandidates,
    Paths,
    first_impacts,
)
from jaxgran.particles.state import (
    DragDecay,
    State,
    TangentialImpulse,
    drag_decay,
    tangential_impulse,
    temperature,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, wall_impact_ratio
from jaxgran.scene.gas import mean_loss
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedDrag, ReducedDrive, ReducedRough


class HardScene(NamedTuple):
    """A gas of hard spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the periodic box.
        law: of restitution, for speeds in units of sqrt(2).
        collision_frequency: at T = 1.
        contact_time: in mean free times; the impact of a sphere within this time of its last one is
            elastic.
        elastic: whether all impacts are elastic and smooth.
        surface: of rough spheres; None of smooth ones.
        drag: rates over the collision frequency; None in a vacuum. Time and velocities are then
            transformed, see `jaxgran.particles.state`.
        drive: growth of T over the collision frequency by white noise; None where there is none.
        walls: of a container; None where the box is periodic.
    """

    side: Float[Array, ""]
    law: ReducedLaw
    collision_frequency: Float[Array, ""]
    contact_time: Float[Array, ""]
    elastic: Bool[Array, ""]
    surface: ReducedRough | None = None
    drag: ReducedDrag | None = None
    drive: ReducedDrive | None = None
    walls: HardWalls | None = None

    @property
    def has_elements(self) -> bool:
        """True unless the scene has only smooth spheres in free flight."""
        return any(x is not None for x in (self.surface, self.walls, self.drag, self.drive))

    @property
    def material(self) -> Any:
        """The numbers in which derivatives are taken: those of the law, or a scene of the elements.

        All are per collision, so that in a denser gas the same happens sooner.
        """
        if not self.has_elements:
            return self.law
        geometry = {"side": None, "collision_frequency": None, "contact_time": None}
        walls = None if self.walls is None else self.walls._replace(sides=None)
        return self._replace(elastic=None, walls=walls, **geometry)

    def log_loss(self, material: ReducedLaw) -> Float[Array, ""]:
        """Return ln of ``I/(1 - I)``, I the share of normal energy that impacts dissipate."""
        lost = mean_loss(material, self.side)
        return jnp.log(lost) - jnp.log1p(-lost)

    def with_material(self, material: Any) -> "HardScene":
        """Return this scene with other numbers of its material."""
        if not self.has_elements:
            return self._replace(law=material)
        walls = None if self.walls is None else material.walls._replace(sides=self.walls.sides)
        side, _, frequency, contact_time, elastic = self[:5]
        return material._replace(
            side=side,
            collision_frequency=frequency,
            contact_time=contact_time,
            elastic=elastic,
            walls=walls,
        )

    def for_equilibration(self) -> "HardScene":
        """Return the scene with elastic and smooth impacts, without drag and drive."""
        drag = None if self.drag is None else ReducedDrag(*(0 * x for x in self.drag))
        drive = None if self.drive is None else ReducedDrive(0 * self.drive.strength)
        return self._replace(elastic=jnp.ones((), bool), drag=drag, drive=drive)

    @property
    def decay_rates(self) -> ReducedDrag:
        """Rates of drag in the units of the scene's time."""
        assert self.drag is not None
        rate, nu = self.drag, self.collision_frequency
        return ReducedDrag(rate.rate * nu, rate.rotational_rate * nu)


class ImpactEvents(NamedTuple):
    """Spheres at impact, on others or on walls; rows without an impact have no meaning.

    Attributes:
        time: of the gas.
        normal: from the first sphere out into the second, or into the wall.
        relative: velocity of the first less that of the second, or of the sphere.
        speed: its normal part.
        spin: sum of the (transformed) spins of both spheres, or that of the sphere; None of smooth
            spheres.
        elastic: whether the impact is elastic and smooth.
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]

    def scaled(self, velocity: Float[Array, ""], spin: Float[Array, ""]) -> "ImpactEvents":
        """Return the impacts with all velocities and all spins multiplied by exp(...)."""
        factor = jnp.exp(velocity)
        return self._replace(
            relative=self.relative * factor,
            speed=self.speed * factor,
            spin=None if self.spin is None else self.spin * jnp.exp(spin),
        )


class ImpactEffect(NamedTuple):
    """Effect of impacts on the first sphere.

    The second sphere gets the opposite kick and the same change of spin.

    Attributes:
        kick: change of velocity.
        lost: translational energy lost, by each sphere half of what both lose.
        spin_change: change of the (transformed) spin; None of smooth spheres.
        rotational_gain: gain of the energy of these spins, half of it for each sphere; None of
            smooth spheres.
    """

    kick: Float[Array, "rows d"]
    lost: Float[Array, "rows"]
    spin_change: Float[Array, "rows spins"] | None = None
    rotational_gain: Float[Array, "rows"] | None = None


def pair_effect(scene: HardScene, impact: ImpactEvents) -> ImpactEffect:
    """Return the effect of impacts of two spheres, see `jaxgran.Rough`."""
    decay = None if scene.drag is None else drag_decay(scene.decay_rates, impact.time)
    eps = _restitution(scene, impact, decay)
    kick = (-0.5 * (1 + eps) * impact.speed)[:, None] * impact.normal
    effect = ImpactEffect(kick, 0.125 * (1 - eps * eps) * impact.speed**2)
    if scene.surface is None or impact.spin is None:
        return effect
    return _add_tangential_impulse(
        effect, impact, decay, scene.surface.eta, scene.surface, num_spheres=2
    )


def wall_effect(scene: HardScene, impact: ImpactEvents, axis: Int[Array, "rows"]) -> ImpactEffect:
    """Return the effect of impacts on the walls across an axis, whose law is that of
    `HardWalls`."""
    walls, surface = scene.walls, scene.surface
    assert walls is not None
    decay = None if scene.drag is None else drag_decay(scene.decay_rates, impact.time)
    eps = _restitution(scene._replace(law=walls.law), impact, decay)
    kick = -((1 + eps) * impact.speed)[:, None] * impact.normal
    effect = ImpactEffect(kick, 0.5 * (1 - eps**2) * impact.speed**2)
    if surface is None or impact.spin is None:
        return effect
    if walls.beta is None:
        no_change = jnp.zeros_like(impact.spin)
        return effect._replace(spin_change=no_change, rotational_gain=no_change[:, 0])
    return _add_tangential_impulse(
        effect, impact, decay, surface.eta_on_wall(walls.beta), surface, num_spheres=1
    )


def wall_effect_for_tangents(
    scene: HardScene, impact: ImpactEvents, axis: Int[Array, "rows"]
) -> ImpactEffect:
    """Return the effect of impacts on walls with its dependence on their frequency, for tangents.

    The frequency is larger where walls are closer together or dissipate more. A tangent knows
    neither the positions of walls nor those of spheres, but only how often a gas meets the walls,
    see `wall_impact_ratio`. The value is that of `wall_effect`.
    """
    assert scene.walls is not None
    effect = wall_effect(scene, impact, axis)
    frequency = scene.walls.frequency[axis]
    eps = -jnp.sum(effect.kick * impact.normal, -1) / impact.speed - 1
    frequency = frequency * wall_impact_ratio(eps, frequency, impact.normal.shape[1])
    share = frequency / jax.lax.stop_gradient(frequency)
    rotational_gain = None if effect.rotational_gain is None else effect.rotational_gain * share
    return effect._replace(lost=effect.lost * share, rotational_gain=rotational_gain)


def _restitution(
    scene: HardScene, impact: ImpactEvents, decay: DragDecay | None
) -> Float[Array, "rows"]:
    speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = scene.law.restitution(speed if decay is None else speed * decay.velocity)
    return jnp.where(impact.elastic, 1.0, eps)


def _add_tangential_impulse(
    effect: ImpactEffect,
    impact: ImpactEvents,
    decay: DragDecay | None,
    eta: Float[Array, ""],
    surface: ReducedRough,
    num_spheres: int,
) -> ImpactEffect:
    """Add the tangential part of impacts on `num_spheres` spheres, of which each bears a share."""
    assert impact.spin is not None
    spin_factor = 1.0 if decay is None else decay.spin[:, None]
    impulse: TangentialImpulse = tangential_impulse(
        impact.relative,
        impact.spin * spin_factor,
        impact.normal,
        ~impact.elastic,
        eta,
        surface,
        -jnp.sum(effect.kick * impact.normal, axis=-1),
    )
    if num_spheres == 2:
        lost = -0.5 * jnp.sum(impulse.kick * (impulse.sideways + impulse.kick), -1)
    else:
        lost = -jnp.sum(impulse.kick * (impulse.sideways + 0.5 * impulse.kick), -1)
    spin_change = impulse.spin_change / spin_factor
    rotational_gain = (
        surface.inertia
        / 2
        * jnp.sum(spin_change * (impact.spin * 2 / num_spheres + spin_change), -1)
    )
    return ImpactEffect(
        effect.kick + impulse.kick, effect.lost + lost, spin_change, rotational_gain
    )


class HardTangents(NamedTuple):
    """Tangents of a state along p directions.

    Attributes:
        directions: in the material, stacked along a first axis of each leaf; the last one is that
            of time, in which everything is more frequent.
        exchange: tangents of the energies of translation and of the (transformed) spins.
    """

    directions: Any
    exchange: ExchangeTangents

    @classmethod
    def at_start(
        cls, scene: HardScene, directions: Any, replicas: int, num_particles: int, dimension: int
    ) -> "HardTangents":
        """Return the tangents at t = 0, where T is 1 and T_rot is that of the material."""
        directions = jax.tree.map(_append_time_direction, directions)
        if scene.drag is not None:  # drag acts sooner, too
            rates = jax.tree.map(lambda x, rate: x.at[-1].set(rate), directions.drag, scene.drag)
            directions = directions._replace(drag=rates)
        p = len(jax.tree.leaves(directions)[0])
        energies = jnp.zeros((p, 2, replicas), scene.collision_frequency.dtype)
        if scene.surface is not None:
            rotational_energy = num_particles * NUM_SPIN_COMPONENTS[dimension] / 2
            energies = energies.at[:, 1].add(rotational_energy * directions.surface.ratio[:, None])
        return cls(directions, ExchangeTangents(energies, jnp.zeros((p, replicas), energies.dtype)))

    def gains(
        self,
        scene: HardScene,
        impact: ImpactEvents,
        happens: Bool[Array, "rows"],
        effect_of: Callable[[HardScene, ImpactEvents], ImpactEffect],
    ) -> Float[Array, "changes 2 rows"]:
        """Return the tangents of the gains of both energies in impacts, see
        `ExchangeTangents.after`."""

        def energies(material: HardScene, velocity: Array, spin: Array) -> Array:
            if scene.surface is not None and material.surface is not None:
                # At a given energy spins are smaller where the inertia is larger.
                spin = spin - 0.5 * jnp.log(material.surface.inertia / scene.surface.inertia)
            effect = effect_of(scene.with_material(material), impact.scaled(velocity, spin))
            rotational_gain = (
                jnp.zeros_like(effect.lost)
                if effect.rotational_gain is None
                else effect.rotational_gain
            )
            return jnp.where(happens, jnp.stack([-effect.lost, rotational_gain]), 0.0)

        zero, one = (jnp.full((), x, impact.speed.dtype) for x in (0.0, 1.0))
        material: Any = scene.material
        _, linear = jax.linearize(energies, material, zero, zero)
        no_direction = jax.tree.map(jnp.zeros_like, material)
        by_direction = jax.vmap(lambda direction: linear(direction, zero, zero))(self.directions)
        by_scale = jnp.stack([linear(no_direction, one, zero), linear(no_direction, zero, one)])
        return jnp.concatenate([by_direction, by_scale])

    @property
    def num_changes(self) -> int:
        """Number of rows of `gains`."""
        return len(self.exchange.energies) + 2


def _append_time_direction(leaf: Array) -> Array:
    """Append a direction along which the number does not change."""
    return jnp.concatenate([leaf, jnp.zeros((1, *leaf.shape[1:]), leaf.dtype)])


MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window from which on the run counts as stalled."""


class ImpactWork(NamedTuple):
    """Particles after the impacts of a window, and sums over these impacts.

    Attributes:
        paths: of the particles.
        dissipated: translational energy lost, half of it counted for each of two spheres.
        rotational_gain: gain of the energy of the (transformed) spins; None of smooth spheres.
        impacts: number of impacts of each particle on others.
        wall_impacts: number of impacts on walls of each particle; None without walls.
        regularised: number of impacts that were elastic because they followed too soon.
        max_distance2: largest squared distance of each particle, at its impacts, from the place for
            which the neighbour list was built.
        max_speed2: largest squared speed of each particle.
        pending: whether the last round executed an impact.
        num_rounds: number of rounds.
        gains: tangents of the energy gained in impacts of pairs, along directions in the material,
            see `ImpactTangents` and `HardTangents`; without tangents, no rows.
        wall_gains: the corresponding tangents of impacts on walls.
    """

    paths: Paths
    dissipated: Float[Array, "slots"]
    rotational_gain: Float[Array, "slots"] | None
    impacts: Int[Array, "slots"]
    wall_impacts: Int[Array, "slots"] | None
    regularised: Int[Array, "slots"]
    max_distance2: Float[Array, "slots"]
    max_speed2: Float[Array, "slots"]
    pending: Bool[Array, ""]
    num_rounds: Int[Array, ""]
    gains: Float[Array, "changes *energies rows"]
    wall_gains: Float[Array, "wallchanges 2 slots"]


def execute_impacts(
    state: State,
    listed: Float[Array, "n d"],
    candidates: ImpactCandidates,
    scene: HardScene,
    duration: ArrayLike,
    replicas: int,
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
        replicas: number of boxes.
    """

    def of_members(values):
        return values.at[candidates.members].get(mode="fill", fill_value=0.0)

    internal, tangents, start_time = state.internal, state.tangents, state.time + state.time_rest
    spin = None if internal.spin is None else of_members(internal.spin)
    x, v, listed = (of_members(values) for values in (state.position, state.velocity, listed))
    paths = Paths(x, v, -of_members(internal.age), spin)
    T = temperature(state.velocity, replicas)
    T = jnp.maximum(T, jnp.finfo(T.dtype).tiny)
    # An impact is elastic within this time of a sphere's last one.
    contact_duration = scene.contact_time / (scene.collision_frequency * jnp.sqrt(T))
    contact_duration = contact_duration[jnp.minimum(candidates.replica, replicas - 1)]
    rows, slots = candidates.rows, jnp.arange(len(v), dtype=jnp.int32)
    a, b, num_rows = rows.a, rows.b, len(rows.a)
    index = jnp.arange(num_rows, dtype=jnp.int32)

    def one_round(work: ImpactWork) -> ImpactWork:
        paths = work.paths
        next_impacts = first_impacts(paths, rows, duration, scene.walls)
        times, first, final = next_impacts.times, next_impacts.first, next_impacts.final
        executable = jnp.isfinite(times)
        for k in (a, b):
            executable &= (times == first[k]) & (times == final[k])
        # Of several impacts at exactly the same time, a sphere takes the one in the first row.
        rank = jnp.where(executable, index, num_rows)
        row = jnp.full(len(slots), num_rows, jnp.int32).at[a].min(rank).at[b].min(rank)
        executable &= (row[a] == index) & (row[b] == index)

        s = jnp.where(executable, times, 0.0)
        r = next_impacts.r + next_impacts.w * s[:, None]
        normal = r / jnp.where(executable, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
        speed = jnp.where(executable, -jnp.sum(next_impacts.w * normal, -1), 1.0)
        too_soon = s - jnp.maximum(paths.last[a], paths.last[b]) < contact_duration[a]
        spin = None if paths.spin is None else paths.spin[a] + paths.spin[b]
        elastic = too_soon | scene.elastic | ~executable
        events = ImpactEvents(start_time + s, -normal, next_impacts.w, speed, spin, elastic)
        effect = pair_effect(scene, events)
        gains = work.gains
        if isinstance(tangents, HardTangents):  # each of two spheres loses half of the energy
            gains = gains + 2 * tangents.gains(scene, events, executable, pair_effect)
        elif tangents is not None:  # the law's unit of speed is sqrt(2)
            more = 2 * tangents.gains(scene.law, events.speed * 0.5**0.5)
            gains = gains + jnp.where((executable & ~too_soon & ~scene.elastic)[None], more, 0.0)

        # From the rows of pairs to the slots of their spheres.
        unpaired, row = row == num_rows, jnp.minimum(row, num_rows - 1)
        hit = executable[row] & ((a[row] == slots) | (b[row] == slots))
        sign = jnp.where(hit, jnp.where(a[row] == slots, 1.0, -1.0), 0.0)
        effect = jax.tree.map(lambda x: x[row], effect)
        effect = effect._replace(kick=sign[:, None] * effect.kick)
        s, too_soon = jnp.where(hit, s[row], 0.0), too_soon[row]
        x = paths.x - effect.kick * s[:, None]
        impacts, wall_impacts, wall_gains = work.impacts + hit, work.wall_impacts, work.wall_gains
        regularised = work.regularised + (hit & too_soon)
        if next_impacts.wall_impacts is not None and wall_impacts is not None:
            wall_times, axis = next_impacts.wall_impacts
            at_wall = unpaired & jnp.isfinite(wall_times)
            at_wall &= (wall_times == first) & (wall_times == final)
            wall_s = jnp.where(at_wall, wall_times, 0.0)
            too_soon = wall_s - paths.last < contact_duration
            is_axis = axis[:, None] == jnp.arange(paths.v.shape[1])[None]
            outwards = jnp.where(is_axis, jnp.sign(paths.v), 0.0)
            speed = jnp.where(at_wall, jnp.sum(paths.v * outwards, axis=1), 1.0)
            elastic = too_soon | scene.elastic | ~at_wall
            events = ImpactEvents(
                start_time + wall_s, outwards, paths.v, speed, paths.spin, elastic
            )
            on_wall = wall_effect(scene, events, axis)
            if isinstance(tangents, HardTangents):
                with_frequency = partial(wall_effect_for_tangents, axis=axis)
                wall_gains = wall_gains + tangents.gains(scene, events, at_wall, with_frequency)
            effect = jax.tree.map(partial(_where_rows, at_wall), on_wall, effect)
            s, hit = jnp.where(at_wall, wall_s, s), hit | at_wall
            after = paths.x + paths.v * s[:, None] - (paths.v + effect.kick) * s[:, None]
            x = _where_rows(at_wall, after, x)
            wall_impacts = wall_impacts + at_wall
            # An impact of two spheres counts twice.
            regularised = regularised + 2 * (at_wall & too_soon)

        v, spin, rotational_gain = paths.v + effect.kick, paths.spin, work.rotational_gain
        if spin is not None and rotational_gain is not None:
            spin = spin + _where_rows(hit, effect.spin_change, jnp.zeros_like(spin))
            rotational_gain = rotational_gain + jnp.where(hit, effect.rotational_gain, 0.0)
        distance2 = jnp.sum((paths.x + paths.v * s[:, None] - listed) ** 2, -1)
        return ImpactWork(
            paths=Paths(x, v, jnp.where(hit, s, paths.last), spin),
            dissipated=work.dissipated + jnp.where(hit, effect.lost, 0.0),
            rotational_gain=rotational_gain,
            impacts=impacts,
            wall_impacts=wall_impacts,
            regularised=regularised,
            max_distance2=jnp.maximum(work.max_distance2, jnp.where(hit, distance2, 0.0)),
            max_speed2=jnp.maximum(work.max_speed2, jnp.sum(v * v, -1)),
            pending=jnp.any(hit),
            num_rounds=work.num_rounds + 1,
            gains=gains,
            wall_gains=wall_gains,
        )

    def unfinished(work: ImpactWork):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    counts, zeros = jnp.zeros_like(slots), jnp.zeros(len(slots), paths.x.dtype)
    shape, wall_shape = (0, num_rows), (0, 2, len(slots))
    if isinstance(tangents, ImpactTangents):
        shape = len(tangents.log_temperature) + 1, num_rows
    elif tangents is not None:
        shape = tangents.num_changes, 2, num_rows
        wall_shape = (0 if scene.walls is None else tangents.num_changes), 2, len(slots)
    work = ImpactWork(
        paths=paths,
        dissipated=zeros,
        rotational_gain=None if paths.spin is None else zeros,
        impacts=counts,
        wall_impacts=None if scene.walls is None else counts,
        regularised=counts,
        max_distance2=zeros,
        max_speed2=zeros,
        pending=jnp.array(True),
        num_rounds=jnp.int32(0),
        gains=jnp.zeros(shape, zeros.dtype),
        wall_gains=jnp.zeros(wall_shape, zeros.dtype),
    )
    return jax.lax.while_loop(unfinished, one_round, work)


def _where_rows(mask: Bool[Array, "rows"], x: Any, y: Any) -> Array:
    return jnp.where(mask if x.ndim == 1 else mask[:, None], x, y)

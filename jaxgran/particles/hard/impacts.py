"""Execution of the impacts of hard spheres within one window of time.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.hard import effects
from jaxgran.particles.hard.candidates import Selection
from jaxgran.particles.hard.effects import Effect, Impact
from jaxgran.particles.hard.prediction import FirstImpacts, Rows, Slots, first_impacts
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.hard.tangents import HardTangents
from jaxgran.particles.hard.walls import HardWalls
from jaxgran.tangents.impact import ImpactTangents

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
    turned: Float[Array, "slots"] | None
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
        s, soon, met = _met(impacts, safe, work.slots, chosen.rows, shortest, scene, began)
        effect = effects.of_pairs(scene, met)
        new = _executed(work, effect, s, soon, safe, row, chosen.rows, listed)
        new = new._replace(gains=work.gains + _gains(along, scene, met, safe, soon))
        if impacts.bounces is None or scene.walls is None:
            return new
        alone = row == len(chosen.rows.a)
        return _bounced(work, new, impacts, alone, listed, shortest, scene, began, along)

    def unfinished(work: ImpactWork):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    first = _before(slots, scene, along, len(chosen.rows.a))
    return jax.lax.while_loop(unfinished, one_round, first)


def _before(
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
        turned=None if slots.spin is None else zeros,
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
        return 2 * along.gains(scene, met, safe, effects.of_pairs)
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


def _met(
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


def _executed(
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
    slots, own = work.slots, jnp.arange(len(row), dtype=jnp.int32)
    row = jnp.minimum(row, len(rows.a) - 1)
    hit = safe[row] & ((rows.a[row] == own) | (rows.b[row] == own))
    s = jnp.where(hit, time[row], 0.0)
    sign = jnp.where(hit, jnp.where(rows.a[row] == own, 1.0, -1.0), 0.0)
    kick = sign[:, None] * effect.kick[row]
    place = slots.x + slots.v * s[:, None]
    v = slots.v + kick
    spin, turned = slots.spin, work.turned
    if spin is not None and turned is not None and effect.twist is not None:
        assert effect.turned is not None
        spin = spin + jnp.where(hit[:, None], effect.twist[row], 0.0)
        turned = turned + jnp.where(hit, effect.turned[row], 0.0)
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return work._replace(
        slots=Slots(slots.x - kick * s[:, None], v, jnp.where(hit, s, slots.last), spin),
        dissipated=work.dissipated + jnp.where(hit, effect.lost[row], 0.0),
        turned=turned,
        impacts=work.impacts + hit,
        regularised=work.regularised + (hit & soon[row]),
        moved=jnp.maximum(work.moved, away),
        fastest=jnp.maximum(work.fastest, jnp.sum(v * v, -1)),
        pending=jnp.any(safe),
        num_rounds=work.num_rounds + 1,
    )


def _bounced(
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
    effect = effects.of_walls(scene, met, axis)
    kick = jnp.where(hit[:, None], effect.kick, 0.0)
    place = slots.x + slots.v * s[:, None]
    v = jnp.where(hit[:, None], slots.v + kick, new.slots.v)
    x = jnp.where(hit[:, None], place - v * s[:, None], new.slots.x)
    spin, turned = new.slots.spin, new.turned
    if spin is not None and turned is not None and effect.twist is not None:
        assert effect.turned is not None
        spin = spin + jnp.where(hit[:, None], effect.twist, 0.0)
        turned = turned + jnp.where(hit, effect.turned, 0.0)
    gains = new.wall_gains
    if isinstance(along, HardTangents):
        gains = gains + along.gains(scene, met, hit, partial(effects.of_walls_as_often, axis=axis))
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return new._replace(
        slots=Slots(x, v, jnp.where(hit, s, new.slots.last), spin),
        dissipated=new.dissipated + jnp.where(hit, effect.lost, 0.0),
        turned=turned,
        bounces=new.bounces + hit,
        regularised=new.regularised + 2 * (hit & soon),  # an impact of two spheres counts twice
        moved=jnp.maximum(new.moved, away),
        fastest=jnp.maximum(new.fastest, jnp.sum(v * v, -1)),
        pending=new.pending | jnp.any(hit),
        wall_gains=gains,
    )

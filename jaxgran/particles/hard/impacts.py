"""Execution of the impacts of hard spheres within one window of time.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.hard.candidates import Selection
from jaxgran.particles.hard.prediction import FirstImpacts, Rows, Slots, first_impacts
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.hard.walls import HardWalls, bounced
from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedRough
from jaxgran.tangents.impact import ImpactTangents

MAX_ROUNDS = 100_000
"""Rounds of independent impacts in one window from which on the run counts as stalled."""


class ImpactWork(NamedTuple):
    """The particles after the impacts of a window, and sums over these impacts.

    Attributes:
        slots: the particles.
        dissipated: energy lost, half of it counted for each of two spheres.
        impacts: number of impacts of each particle.
        bounces: number of impacts on walls of each particle; None without walls.
        regularised: number of impacts that were elastic because they followed too soon.
        moved: largest squared distance of each particle, at its impacts, from the place for which
            the neighbour list was built.
        fastest: largest squared speed of each particle.
        pending: whether the last round executed an impact.
        num_rounds: number of rounds.
        gains: of energy along directions in the law, see `ImpactTangents`; without these, no rows.
    """

    slots: Slots
    dissipated: Float[Array, "slots"]
    impacts: Int[Array, "slots"]
    bounces: Int[Array, "slots"] | None
    regularised: Int[Array, "slots"]
    moved: Float[Array, "slots"]
    fastest: Float[Array, "slots"]
    pending: Bool[Array, ""]
    num_rounds: Int[Array, ""]
    gains: Float[Array, "changes rows"]


def resolve(
    slots: Slots,
    listed: Float[Array, "slots d"],
    chosen: Selection,
    scene: HardScene,
    duration: ArrayLike,
    shortest: Float[Array, "replicas"],
    along: ImpactTangents | None,
) -> ImpactWork:
    """Execute all impacts of a window, in rounds of independent impacts.

    A round executes every impact that is the first of both its spheres before either path can have
    changed. The earliest impact of all is always one of them.

    Args:
        slots: the members of the selection.
        listed: the places for which the neighbour list was built.
        chosen: the selection.
        scene: the gas.
        duration: of the window.
        shortest: time after a sphere's last impact within which its next one is elastic.
        along: the tangents, if they are followed, for the gains of energy along their directions.
    """
    num_rows, num_slots = len(chosen.rows.a), len(slots.v)
    shortest = shortest[jnp.minimum(chosen.replica, len(shortest) - 1)]

    def one_round(work: ImpactWork) -> ImpactWork:
        impacts, safe, row = _executable(work.slots, chosen.rows, duration, scene.walls)
        effect = _effect(impacts, safe, work.slots, chosen.rows, shortest, scene, along)
        new = _executed(work, effect, safe, row, chosen.rows, listed)
        if impacts.bounces is None or scene.walls is None:
            return new
        alone = row == len(chosen.rows.a)
        return _bounced(work, new, impacts, alone, listed, shortest, scene)

    def unfinished(work: ImpactWork):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    count, zeros = jnp.zeros(num_slots, jnp.int32), jnp.zeros(num_slots, slots.x.dtype)
    size = (0, 0) if along is None else (len(along.log_temperature) + 1, num_rows)
    gains = jnp.zeros(size, zeros.dtype)
    bounces = None if scene.walls is None else count
    work = ImpactWork(
        slots, zeros, count, bounces, count, zeros, zeros, jnp.array(True), jnp.int32(0), gains
    )
    return jax.lax.while_loop(unfinished, one_round, work)


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


class _Effect(NamedTuple):
    """What impacts do; in other rows the values have no meaning."""

    s: Float[Array, "rows"]  # time
    kick: Float[Array, "rows d"]  # change of velocity of a; that of b is opposite
    lost: Float[Array, "rows"]  # energy, half of it
    soon: Bool[Array, "rows"]  # elastic, as too little time has passed
    gains: Float[Array, "changes rows"]
    twist: Float[Array, "rows spins"] | None = None  # change of the spins of both spheres


def _effect(
    impacts: FirstImpacts,
    safe: Bool[Array, "rows"],
    slots: Slots,
    rows: Rows,
    shortest: Float[Array, "slots"],
    scene: HardScene,
    along: ImpactTangents | None,
) -> _Effect:
    """The effect of the impacts marked as safe, by the law of restitution."""
    s = jnp.where(safe, impacts.times, 0.0)
    r = impacts.r + impacts.w * s[:, None]
    normal = r / jnp.where(safe, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
    speed = jnp.where(safe, -jnp.sum(impacts.w * normal, -1), 1.0)
    soon = s - jnp.maximum(slots.last[rows.a], slots.last[rows.b]) < shortest[rows.a]
    eps = scene.law.restitution(speed * 0.5**0.5)
    eps = jnp.where(soon | scene.elastic, 1.0, eps)
    kick = (0.5 * (1 + eps) * speed)[:, None] * normal
    lost = 0.125 * (1 - eps * eps) * speed**2
    gains = jnp.zeros((0, 0), speed.dtype)
    if along is not None:
        # The law's unit of speed is sqrt(2).
        gained = 2 * along.gains(scene.law, speed * 0.5**0.5)
        gains = jnp.where((safe & ~soon & ~scene.elastic)[None], gained, 0.0)
    effect = _Effect(s, kick, lost, soon, gains)
    if scene.surface is None or slots.spin is None:
        return effect
    smooth = ~safe | soon | scene.elastic
    spin = slots.spin[rows.a] + slots.spin[rows.b]
    return _rubbed(effect, scene.surface, impacts.w, spin, normal, smooth)


def _rubbed(
    effect: _Effect,
    surface: ReducedRough,
    w: Float[Array, "rows d"],
    spin: Float[Array, "rows spins"],
    normal: Float[Array, "rows d"],
    smooth: Bool[Array, "rows"],
) -> _Effect:
    """The effect with the tangential part of impacts, see `jaxgran.Rough`, where not smooth."""
    found = rub(w, spin, -normal, ~smooth, surface.eta, surface.inertia)
    lost = 0.125 * surface.lost_share(surface.beta) * jnp.sum(found.slip**2, -1)
    return effect._replace(
        kick=effect.kick + found.kick, lost=effect.lost + lost, twist=found.twist
    )


def _executed(
    work: ImpactWork,
    effect: _Effect,
    safe: Bool[Array, "rows"],
    row: Int[Array, "slots"],
    rows: Rows,
    listed: Float[Array, "slots d"],
) -> ImpactWork:
    """The particles after the impacts marked as safe, and the sums with these impacts."""
    slots, own = work.slots, jnp.arange(len(row), dtype=jnp.int32)
    row = jnp.minimum(row, len(rows.a) - 1)
    hit = safe[row] & ((rows.a[row] == own) | (rows.b[row] == own))
    s = jnp.where(hit, effect.s[row], 0.0)
    sign = jnp.where(hit, jnp.where(rows.a[row] == own, 1.0, -1.0), 0.0)
    kick = sign[:, None] * effect.kick[row]
    place = slots.x + slots.v * s[:, None]
    v = slots.v + kick
    spin = slots.spin
    if spin is not None and effect.twist is not None:
        spin = spin + jnp.where(hit[:, None], effect.twist[row], 0.0)
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return ImpactWork(
        slots=Slots(slots.x - kick * s[:, None], v, jnp.where(hit, s, slots.last), spin),
        dissipated=work.dissipated + jnp.where(hit, effect.lost[row], 0.0),
        impacts=work.impacts + hit,
        bounces=work.bounces,
        regularised=work.regularised + (hit & effect.soon[row]),
        moved=jnp.maximum(work.moved, away),
        fastest=jnp.maximum(work.fastest, jnp.sum(v * v, -1)),
        pending=jnp.any(safe),
        num_rounds=work.num_rounds + 1,
        gains=work.gains + effect.gains,
    )


def _bounced(
    old: ImpactWork,
    new: ImpactWork,
    impacts: FirstImpacts,
    alone: Bool[Array, "slots"],
    listed: Float[Array, "slots d"],
    shortest: Float[Array, "slots"],
    scene: HardScene,
) -> ImpactWork:
    """The particles after a round, with those impacts on walls that nothing can come before.

    Args:
        old, new: before the round, and after its impacts of pairs.
        impacts: the next ones, before the round.
        alone: who takes part in no impact of a pair.
        listed, shortest, scene: as for `resolve`.
    """
    assert impacts.bounces is not None and scene.walls is not None and new.bounces is not None
    slots, (times, axis) = old.slots, impacts.bounces
    hit = alone & jnp.isfinite(times) & (times == impacts.first) & (times == impacts.final)
    s = jnp.where(hit, times, 0.0)
    soon = s - slots.last < shortest
    after = bounced(scene.walls, scene.surface, slots.v, slots.spin, axis, soon | scene.elastic)
    place = slots.x + slots.v * s[:, None]
    v = jnp.where(hit[:, None], after.v, new.slots.v)
    x = jnp.where(hit[:, None], place - v * s[:, None], new.slots.x)
    spin = new.slots.spin
    if spin is not None and after.spin is not None:
        spin = jnp.where(hit[:, None], after.spin, spin)
    away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
    return new._replace(
        slots=Slots(x, v, jnp.where(hit, s, new.slots.last), spin),
        dissipated=new.dissipated + jnp.where(hit, after.lost, 0.0),
        bounces=new.bounces + hit,
        regularised=new.regularised + 2 * (hit & soon),  # an impact of two spheres counts twice
        moved=jnp.maximum(new.moved, away),
        fastest=jnp.maximum(new.fastest, jnp.sum(v * v, -1)),
        pending=new.pending | jnp.any(hit),
    )

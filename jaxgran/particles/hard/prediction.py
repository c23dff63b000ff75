"""Prediction of the next impacts of hard spheres, on each other and on walls.

Units here: the diameter is 1. The time s counts from the start of a window. A path is given by its
velocity and its position extrapolated back to s = 0, as in x(s) = x + v s.

In a container positions are coordinates from a corner, as in `jaxgran.scene.reduced.SphereScene`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int


class PairRows(NamedTuple):
    """Pairs of particles that may touch.

    Attributes:
        a, b: the slots of the two particles.
        offset: of the pair, as in `jaxgran.particles.neighbours.pairs.Pairs`.
        bound: an upper bound on the speed of all spheres of this replica during the window.
        real: whether the row holds a pair.
    """

    a: Int[Array, "rows"]
    b: Int[Array, "rows"]
    offset: Float[Array, "rows d"]
    bound: Float[Array, "rows"]
    real: Bool[Array, "rows"]


class Paths(NamedTuple):
    """Current paths of particles.

    Attributes:
        x: position, extrapolated back to the start of the window.
        v: velocity.
        last: time of the last impact, where the path begins; negative if the impact was
            before the window.
        spin: of rough spheres; None for smooth ones.
    """

    x: Float[Array, "slots d"]
    v: Float[Array, "slots d"]
    last: Float[Array, "slots"]
    spin: Float[Array, "slots spins"] | None = None


class RelativeMotion(NamedTuple):
    """Relative motion ``r + w s`` of pairs, as the scalar products that their distance needs."""

    rr: Float[Array, "rows"]
    rw: Float[Array, "rows"]
    ww: Float[Array, "rows"]

    def gap(self, s: ArrayLike) -> Float[Array, "rows"]:
        """Return the distance between the surfaces at s."""
        return jnp.sqrt(jnp.maximum(self.rr + (2 * self.rw + self.ww * s) * s, 0.0)) - 1

    def impact_time(self, since: ArrayLike) -> Float[Array, "rows"]:
        """Return the first s >= `since` at which the spheres touch while they approach, or inf.

        ``s - since = c / (sqrt(b^2 - w^2 c) - b)`` with ``b = r w`` and ``c = r^2 - 1`` at `since`,
        the form of the root without cancellation. Approaching spheres that rounding has left closer
        than a diameter touch at once. Grazing impacts to a depth of less than 1e-16 are left out.
        """
        b = self.rw + self.ww * since
        c = self.rr + (2 * self.rw + self.ww * since) * since - 1
        graze = jnp.finfo(b.dtype).eps ** 0.5
        square = b * b - self.ww * c
        touch = (b < -graze * jnp.sqrt(self.ww)) & ((c <= 0) | (square > 0))
        root = jnp.sqrt(jnp.where(touch & (c > 0), square, 1.0))
        ahead = jnp.maximum(c, 0.0) / jnp.where(touch, root - b, 1.0)
        return jnp.where(touch, since + ahead, jnp.inf)


class WallImpacts(NamedTuple):
    """Next impacts of particles on walls.

    Attributes:
        times: of each particle's impact; inf if there is none before the end.
        axis: across which the wall lies.
    """

    times: Float[Array, "slots"]
    axis: Int[Array, "slots"]


def next_wall_impacts(container: Float[Array, "d"], paths: Paths, end: ArrayLike) -> WallImpacts:
    """Return the next impacts on walls before `end`."""
    x = paths.x
    v = paths.v
    target = jnp.where(v > 0, container[None] - 0.5, 0.5)
    moving = v != 0
    times_by_axis = jnp.where(moving, (target - x) / jnp.where(moving, v, 1.0), jnp.inf)
    axis = jnp.argmin(times_by_axis, axis=1)
    # A sphere that rounding has left beyond a wall hits it at once.
    times = jnp.maximum(jnp.min(times_by_axis, axis=1), jnp.maximum(paths.last, 0.0))
    return WallImpacts(jnp.where(times < end, times, jnp.inf), axis)


class FirstImpacts(NamedTuple):
    """Next impacts of particles on their current paths.

    Attributes:
        r, w: relative position, extrapolated back to the start of the window, and relative velocity
            of each pair.
        motion: the same vectors as scalar products.
        times: of each pair's impact; inf if there is none before the end.
        walls: next impacts on walls; None without walls.
        first: the earliest impact time of each particle on its current path.
        final: a lower bound on the time until which each particle's path is final.
    """

    r: Float[Array, "rows d"]
    w: Float[Array, "rows d"]
    motion: RelativeMotion
    times: Float[Array, "rows"]
    walls: WallImpacts | None
    first: Float[Array, "slots"]
    final: Float[Array, "slots"]


def first_impacts(
    paths: Paths, rows: PairRows, end: ArrayLike, container: Float[Array, "d"] | None = None
) -> FirstImpacts:
    """Return the next impact of each pair and of each particle before `end`."""
    a = rows.a
    b = rows.b
    r = paths.x[a] - paths.x[b] - rows.offset
    w = paths.v[a] - paths.v[b]
    motion = RelativeMotion(jnp.sum(r * r, -1), jnp.sum(r * w, -1), jnp.sum(w * w, -1))
    last_of_a = paths.last[a]
    last_of_b = paths.last[b]
    times = motion.impact_time(jnp.maximum(jnp.maximum(last_of_a, last_of_b), 0.0))
    times = jnp.where(rows.real & (times < end), times, jnp.inf)
    first = jnp.full(len(paths.x), jnp.inf, times.dtype).at[a].min(times).at[b].min(times)
    walls = None
    if container is not None:
        walls = next_wall_impacts(container, paths, end)
        first = jnp.minimum(first, walls.times)
    speed = jnp.sqrt(jnp.sum(paths.v**2, -1))
    final = _final_until(rows, motion, last_of_a, last_of_b, speed, first, end)
    return FirstImpacts(r, w, motion, times, walls, first, final)


def _final_until(
    rows: PairRows,
    motion: RelativeMotion,
    last_of_a: Float[Array, "rows"],
    last_of_b: Float[Array, "rows"],
    speed: Float[Array, "slots"],
    first: Float[Array, "slots"],
    end: ArrayLike,
) -> Float[Array, "slots"]:
    """Return a lower bound on the time until which the path of each particle is final.

    The path of a particle changes at its first impact, or when it is hit by a particle whose path
    has changed earlier. Such a particle moves no faster than the bound on all speeds, which gives
    the earliest time at which it can arrive. These times depend on each other from pair to pair;
    starting from the first impacts they are lowered until they are consistent.
    """
    a = rows.a
    b = rows.b
    closing_on_a = rows.bound + speed[a]
    closing_on_b = rows.bound + speed[b]

    def arrival(
        disturbed: Float[Array, "rows"], last: Float[Array, "rows"], closing: Float[Array, "rows"]
    ) -> Float[Array, "rows"]:
        """Return when the other particle of a pair, disturbed at some time, can arrive."""
        arrives = rows.real & (disturbed < end)
        disturbed = jnp.where(arrives, disturbed, 0.0)
        # The path of the particle that may be hit is known from its last impact on only.
        since = jnp.maximum(disturbed, last)
        gap_left = motion.gap(since) - 2 * rows.bound * (since - disturbed)
        return jnp.where(arrives, since + jnp.maximum(gap_left, 0.0) / closing, jnp.inf)

    def lower(carry: tuple) -> tuple:
        final, _ = carry
        new = final.at[b].min(arrival(final[a], last_of_b, closing_on_b))
        new = new.at[a].min(arrival(new[b], last_of_a, closing_on_a))
        return new, jnp.any(new < jnp.minimum(final, end))  # times after `end` do not matter

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        _, was_lowered = carry
        return was_lowered

    final, _ = jax.lax.while_loop(unfinished, lower, (first, jnp.array(True)))
    return final

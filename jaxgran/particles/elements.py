"""Drag, the kicks of a drive, and rough impacts: elements of a scene by particles.

Spins are ``s = (sigma/2) w`` with the angular velocity w: the surface of a sphere moves at the
speed s.

Instantaneous impacts with drag are computed in transformed time. Between collisions
``dv/dt = -gamma v``, and so ``v = u exp(-gamma t)`` with a velocity u that only collisions change.
In the time ``s = (1 - exp(-gamma t))/gamma`` positions obey ``dx = u ds``, so that the sequence of
collisions is the same as without drag. The laws of collision take the true velocities,
``v = u (1 - gamma s)``, and the true spins, which decay at another rate. A run stores u, and spins
without their decay.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.reduced import ReducedDrag, ReducedRough


class DragDecay(NamedTuple):
    """Decay by drag until one time.

    Attributes:
        velocity: true over stored velocities, v over u: ``exp(-gamma t)``.
        spin: true over stored spins.
    """

    velocity: Float[Array, "..."]
    spin: Float[Array, "..."]

    @property
    def spin_over_velocity(self) -> Float[Array, "..."]:
        """Spins in the unit of u over stored spins."""
        return self.spin / self.velocity


def drag_decay(drag: ReducedDrag | None, time: Float[Array, "..."]) -> DragDecay:
    """Return the decay until a transformed time, ``s = (1 - exp(-gamma t))/gamma``; 1 without drag.

    Args:
        drag: rates of drag in the unit of the time; None without drag.
        time: s.
    """
    if drag is None:
        one = jnp.ones_like(time)
        return DragDecay(one, one)
    velocity = 1 - drag.rate * time
    rotational_rate = 0.0 if drag.rotational_rate is None else drag.rotational_rate
    spin = jnp.exp(-rotational_rate * true_duration(drag, 0.0, time))
    return DragDecay(velocity, spin)


SERIES_LIMIT = 0.01
"""Largest gamma t for which a series is used, which keeps derivatives accurate, also at 0."""


def flight_time(rate: ArrayLike, duration: ArrayLike) -> Array:
    """Return ``(1 - exp(-gamma t))/gamma``, the duration of free flight over the same distance."""
    z = jnp.asarray(rate * duration)
    small = jnp.abs(z) < SERIES_LIMIT
    large = jnp.where(small, 1.0, z)
    series = jnp.ones_like(z)
    for k in (6, 5, 4, 3, 2):  # to z^5: the next term is 1e-15
        series = 1 - z / k * series
    return jnp.asarray(duration) * jnp.where(small, series, -jnp.expm1(-large) / large)


def true_duration(
    drag: ReducedDrag, start: Float[Array, "..."] | float, duration: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the true duration, >= 0, of a transformed one that begins at a transformed time.

    It is the inverse of `flight_time`, at the velocity that drag has left.
    """
    scaled = duration / (1 - drag.rate * start)
    z = drag.rate * scaled
    small = jnp.abs(z) < SERIES_LIMIT
    large = jnp.where(small, 0.5, z)
    series = jnp.full_like(z, 1 / 7)
    for k in (6, 5, 4, 3, 2, 1):  # to z^6: the next term is 1e-15
        series = 1 / k + z * series
    ratio = jnp.where(small, series, -jnp.log1p(-large) / large)
    return jnp.maximum(scaled * ratio, 0.0)


def exchange_slopes(
    values: dict[str, Array],
    tangents: ExchangeTangents,
    drag: ReducedDrag | None,
    drag_directions: Any,
    time: Float[Array, ""],
    num_particles: int,
    dimension: int,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return derivatives of T, T_rot and collisions.

    Args:
        values: the records, some of which are these.
        tangents: of the energies that the particles exchange.
        drag: rates of drag; None without drag.
        drag_directions: directions in these rates, like `drag`.
        time: transformed time of the records.
        num_particles: N, of each replica.
        dimension: d.

    Returns:
        The derivatives in time, and along the directions, as in `jaxgran.gradients.rule.Records`.
    """
    log_decay = jnp.zeros(2)
    log_decay_slopes = jnp.zeros((len(tangents.energies), 2))
    if drag is not None:

        def logarithms(drag: ReducedDrag) -> Array:
            decay = drag_decay(drag, time)
            return jnp.log(jnp.stack([decay.velocity, decay.spin]))

        log_decay, linear = jax.linearize(logarithms, drag)
        log_decay_slopes = jax.vmap(linear)(drag_directions)
    slopes = {"collisions": 2 / num_particles * tangents.collisions}
    components = {
        "temperature": dimension,
        "rotational_temperature": NUM_SPIN_COMPONENTS[dimension],
    }
    for k, (name, count) in enumerate(components.items()):
        if name in values:
            energy = num_particles * count / 2
            by_energy = jnp.exp(2 * log_decay[k]) * tangents.energies[:, k] / energy
            slopes[name] = by_energy + 2 * log_decay_slopes[:, k, None] * values[name][None]
    elapsed = jnp.where(time > 0, time, 1.0)  # the last direction is the direction of time
    rates = {name: x[-1] / elapsed for name, x in slopes.items()}
    return rates, {name: x[:-1] for name, x in slopes.items()}


MAX_KICK = 0.05
"""Largest relative growth of T by the kicks of one step."""


class KickGrowth(NamedTuple):
    """Growth of T by the kicks of one step.

    Attributes:
        at_start: by the half of the kicks at the start of the step.
        at_end: by the half at its end.
    """

    at_start: Float[Array, "..."]
    at_end: Float[Array, "..."]


def kick_growth(
    strength: Array, drag: ReducedDrag | None, start: Array, duration: Array
) -> KickGrowth:
    """Return the growth of T by the kicks of a step.

    With drag it is the growth for the stored velocities u, which do not decay. A kick of v at a
    time t is a kick of u that is ``exp(gamma t)`` times as large.

    Args:
        strength: growth of T in a unit of time.
        drag: rates of drag; None without drag.
        start: time at which the step begins; transformed with drag.
        duration: of the step; transformed with drag. A negative one counts as 0.
    """
    if drag is None:
        half = strength * jnp.maximum(duration, 0.0) / 2
        return KickGrowth(half, half)
    half = strength * true_duration(drag, start, duration) / 2
    decay_at_start = drag_decay(drag, start)
    decay_at_end = drag_decay(drag, start + duration)
    return KickGrowth(half / decay_at_start.velocity**2, half / decay_at_end.velocity**2)


def random_kicks(
    key: PRNGKeyArray,
    velocity: Float[Array, "N d"],
    zero_momentum: bool,
    kicked: Bool[Array, "N"] | None = None,
) -> Float[Array, "N d"]:
    """Draw kicks with components of mean 0 and variance 1, in the shape of velocities.

    Each component is the number of ones in 16 random bits, centred and scaled. Its fourth moment is
    4 % below the value of a Gaussian number. Sums over the many small kicks of a mean free time are
    Gaussian.

    Args:
        key: key of the random numbers.
        velocity: velocities of the particles of one replica.
        zero_momentum: whether the sum of the kicks is 0. Kicks are then enlarged by
            ``sqrt(N/(N - 1))``, so that their mean square is 1 again.
        kicked: mask of the particles that are kicked; None for all. The values of the others are
            arbitrary.
    """
    bits = jax.random.bits(key, velocity.shape, jnp.uint16)
    kicks = 0.5 * (jax.lax.population_count(bits).astype(velocity.dtype) - 8)
    if not zero_momentum:
        return kicks
    if kicked is None:
        kicked = jnp.ones(len(velocity), bool)
    n = jnp.maximum(jnp.sum(kicked), 2).astype(velocity.dtype)
    mean = jnp.sum(jnp.where(kicked[:, None], kicks, 0.0), axis=0, keepdims=True) / n
    return jnp.sqrt(n / (n - 1)) * (kicks - mean)


def threefry_key(words: Array) -> PRNGKeyArray:
    """Return a threefry key from two 32-bit words; its numbers are the same under `jax.vmap`."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def surface_velocity(
    spin: Float[Array, "pairs spins"], normal: Float[Array, "pairs d"]
) -> Float[Array, "pairs d"]:
    """Return ``s x n``, the velocity of the surface at the point in direction n."""
    if normal.shape[-1] == 2:
        return spin * jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    return jnp.cross(spin, normal)


def torque(
    normal: Float[Array, "pairs d"], force: Float[Array, "pairs d"]
) -> Float[Array, "pairs spins"]:
    """Return ``n x f``, which has one component in two dimensions."""
    if normal.shape[-1] == 2:
        return (normal[:, 0] * force[:, 1] - normal[:, 1] * force[:, 0])[:, None]
    return jnp.cross(normal, force)


def tangential_impulse(
    relative: Float[Array, "pairs d"],
    spin: Float[Array, "pairs spins"],
    normal: Float[Array, "pairs d"],
    where: Bool[Array, "pairs"],
    eta: Float[Array, ""],
    surface: ReducedRough,
    normal_kick: Float[Array, "pairs"],
) -> tuple[Float[Array, "pairs d"], Float[Array, "pairs d"], Float[Array, "pairs spins"]]:
    """Return the tangential part of impacts, ``-eta`` times the slip: see `jaxgran.Rough`.

    Args:
        relative: velocity of the first partner relative to the second, v_1 - v_2.
        spin: sum of the spins of both partners; a wall has none.
        normal: unit vector from the first to the second.
        where: mask of the impacts with friction.
        eta: share of the slip that becomes the kick of spheres that stick.
        surface: of the spheres.
        normal_kick: size of the normal part of the velocity change of the first partner.

    Returns:
        The tangential part of the relative velocity of the centres, the velocity change of the
        first partner, and the spin change, the same for both partners.
    """
    sideways = relative - jnp.sum(relative * normal, axis=-1, keepdims=True) * normal
    slip = jnp.where(where[:, None], sideways + surface_velocity(spin, normal), 0.0)
    kick = -eta * slip
    if surface.friction is not None:
        square = jnp.sum(kick**2, axis=-1)
        length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
        kick = kick * jnp.minimum(surface.friction * normal_kick / length, 1.0)[:, None]
    return sideways, kick, torque(normal, kick) / surface.inertia

"""The state of spheres in periodic boxes, soft or hard, and what is recorded of it.

Units here: diameter, mass and first temperature are 1. All particles of all boxes stand in one
array, replica after replica (n = replicas * N rows).

Drag on spheres, exactly: collisions in transformed time.

Between collisions ``dv/dt = -gamma v``, and so ``v = u exp(-gamma t)`` with a velocity u that only
collisions change. In the time ``s = (1 - exp(-gamma t))/gamma`` positions obey ``dx = u ds``: the
sequence of collisions is that of a gas without drag. Its laws see the true velocities,
``v = u (1 - gamma s)``, and spins that have decayed at a rate of their own.

Random kicks by which white noise drives spheres.

Spins of rough spheres, ``s = (sigma/2) w``, which are velocities of their surfaces.
"""

from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran.gradients.tangents import PathTangents
from jaxgran.particles import neighbours, observables
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.reduced import ReducedDrag


class DragDecay(NamedTuple):
    """What drag has left at a time.

    Attributes:
        velocity: v over u, ``exp(-gamma t)``.
        spin: spins in the units of u over those that are kept.
        kept: spins over those that are kept.
    """

    velocity: Float[Array, "..."]
    spin: Float[Array, "..."]
    kept: Float[Array, "..."]


def drag_decay(drag: ReducedDrag, time: Float[Array, "..."]) -> DragDecay:
    """What drag has left at a transformed time, ``s = (1 - exp(-gamma t))/gamma``."""
    velocity = 1 - drag.rate * time
    kept = jnp.exp(-drag.rotational_rate * true_time(drag, time))
    return DragDecay(velocity, kept / velocity, kept)


def true_time(drag: ReducedDrag, time: Float[Array, "..."]) -> Float[Array, "..."]:
    """The time at a transformed time."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    return jnp.where(drag.rate > 0, -jnp.log1p(-drag.rate * time) / safe, time)


def true_duration(
    drag: ReducedDrag, began: Float[Array, "..."], duration: Float[Array, "..."]
) -> Float[Array, "..."]:
    """The time that a transformed duration lasts, >= 0."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    share = drag.rate * duration / (1 - drag.rate * began)
    return jnp.maximum(jnp.where(drag.rate > 0, -jnp.log1p(-share) / safe, duration), 0.0)


def transformed_times(drag: ReducedDrag, times: Float[Array, "times"]) -> Float[Array, "times"]:
    """The transformed times of times."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    return jnp.where(drag.rate > 0, -jnp.expm1(-drag.rate * times) / safe, times)


MAX_KICK = 0.05
"""Largest growth of T by the kicks of one step, over T."""


def threefry_key(words: Array) -> PRNGKeyArray:
    """Two 32-bit words as a key of threefry, whose numbers do not change under `jax.vmap`."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def random_kicks(
    key: PRNGKeyArray,
    velocity: Float[Array, "N d"],
    at_rest: bool,
    counted: Bool[Array, "N"] | None = None,
) -> Float[Array, "N d"]:
    """Random kicks of variance 1 for each component, of the shape of velocities.

    Each is the number of ones in 16 random bits, whose fourth moment is 4 % below that of a
    Gaussian number. Sums over the many small kicks of a mean free time are Gaussian.

    Args:
        key: of the random numbers.
        velocity: of the particles of one replica.
        at_rest: whether the kicks together leave the momentum as it is; they are then enlarged by
            ``sqrt(N/(N - 1))``, so that their mean square is 1 again.
        counted: which particles are kicked; all by default. Those that are not have any value.
    """
    bits = jax.random.bits(key, velocity.shape, jnp.uint16)
    found = 0.5 * (jax.lax.population_count(bits).astype(velocity.dtype) - 8)
    if not at_rest:
        return found
    if counted is None:
        n = len(velocity)
        return (n / (n - 1)) ** 0.5 * (found - jnp.mean(found, axis=0, keepdims=True))
    n = jnp.maximum(jnp.sum(counted), 2).astype(velocity.dtype)
    mean = jnp.sum(jnp.where(counted[:, None], found, 0.0), axis=0, keepdims=True) / n
    return jnp.sqrt(n / (n - 1)) * (found - mean)


def maxwellian_spins(
    key: PRNGKeyArray, shape: tuple[int, int, int], mean_square: Float[Array, ""]
) -> Float[Array, "replicas N spins"]:
    """Maxwellian spins of a given mean square of each component in each replica."""
    spins = jax.random.normal(key, shape, mean_square.dtype)
    size = jnp.sqrt(mean_square / jnp.mean(spins**2, axis=(1, 2), keepdims=True))
    return size * spins


def initial_spins(
    key: PRNGKeyArray, velocity: Float[Array, "n d"], replicas: int, mean_square: Float[Array, ""]
) -> Float[Array, "n spins"]:
    """Spins at t = 0 of all spheres of a run with this key, see `at_start`."""
    n, d = velocity.shape
    key = jax.random.fold_in(key, 2)  # 0 and 1 are of positions and velocities
    shape = replicas, n // replicas, NUM_SPIN_COMPONENTS[d]
    return maxwellian_spins(key, shape, mean_square.astype(velocity.dtype)).reshape(
        n, NUM_SPIN_COMPONENTS[d]
    )


def surface_direction(
    spin: Float[Array, "pairs spins"], normal: Float[Array, "pairs d"]
) -> Float[Array, "pairs d"]:
    """``s x n``, the velocity of a surface in the direction of n."""
    if normal.shape[-1] == 2:
        return spin * jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    return jnp.cross(spin, normal)


def torque(
    normal: Float[Array, "pairs d"], force: Float[Array, "pairs d"]
) -> Float[Array, "pairs spins"]:
    """``n x f``; the one component of two vectors in a plane."""
    if normal.shape[-1] == 2:
        return (normal[:, 0] * force[:, 1] - normal[:, 1] * force[:, 0])[:, None]
    return jnp.cross(normal, force)


class TangentialImpulse(NamedTuple):
    """The tangential part of impacts.

    Attributes:
        sideways: tangential part of the relative velocity of the centres.
        slip: that of the surfaces at contact; 0 where there is no friction.
        kick: change of velocity of the first partner.
        twist: change of spin, of both partners alike.
    """

    sideways: Float[Array, "pairs d"]
    slip: Float[Array, "pairs d"]
    kick: Float[Array, "pairs d"]
    spin_change: Float[Array, "pairs spins"]


def tangential_impulse(
    relative: Float[Array, "pairs d"],
    spin: Float[Array, "pairs spins"],
    normal: Float[Array, "pairs d"],
    where: Bool[Array, "pairs"],
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
) -> TangentialImpulse:
    """The tangential part of impacts, ``-eta`` times the slip: see `jaxgran.Rough`.

    Args:
        relative: velocity of the first partner less that of the second.
        spin: sum of their spins; a wall has none.
        normal: from the first to the second.
        where: there is friction.
        eta: share of the slip that becomes the kick.
        inertia: q.
    """
    sideways = relative - jnp.sum(relative * normal, axis=-1, keepdims=True) * normal
    slip = jnp.where(where[:, None], sideways + surface_direction(spin, normal), 0.0)
    kick = -eta * slip
    return TangentialImpulse(sideways, slip, kick, torque(normal, kick) / inertia)


S = TypeVar("S")


class State(NamedTuple):
    """Particles of all replicas at one time.

    Attributes:
        time: t.
        time_rest: what rounding has left out of `time`, which thus is the sum of even the shortest
            steps in single precision.
        position: not wrapped into the box since the last neighbour list was built.
        velocity: in the laboratory frame.
        image: box sides that wrapping has subtracted from the position.
        origin: position at t = 0.
        first_velocity: velocity at t = 0.
        dissipated: energy lost since t = 0.
        collisions: begun since t = 0, each pair counted once.
        skin: of the neighbour list.
        own: what only one kind of spheres has.
        tangents: derivatives of the state, if they are followed.
    """

    time: Float[Array, ""]
    time_rest: Float[Array, ""]
    position: Float[Array, "n d"]
    velocity: Float[Array, "n d"]
    image: Int[Array, "n d"]
    origin: Float[Array, "n d"]
    first_velocity: Float[Array, "n d"]
    dissipated: Float[Array, "replicas"]
    collisions: Int[Array, "replicas"]
    skin: Float[Array, ""]
    internal: Any
    tangents: Any = None


def initial_state(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    side: ArrayLike,
    skin: ArrayLike,
    replicas: int,
    internal: Any,
) -> State:
    """The state at t = 0."""
    dtype, inside = position.dtype, neighbours.wrap(side, position)
    return State(
        time=jnp.zeros((), dtype),
        time_rest=jnp.zeros((), dtype),
        position=inside,
        velocity=velocity,
        image=jnp.zeros(position.shape, jnp.int32),
        origin=inside,
        first_velocity=velocity,
        dissipated=jnp.zeros(replicas, dtype),
        collisions=jnp.zeros(replicas, jnp.result_type(int)),
        skin=jnp.asarray(skin, dtype),
        internal=internal,
    )


def with_own_buffers(state: S) -> S:
    """The same state in buffers of its own, none of them twice, which may be donated."""
    return jax.tree.map(jnp.copy, state)


def time_left(state: State, end: ArrayLike) -> Array:
    """The time from a state to an end."""
    return (jnp.asarray(end) - state.time) - state.time_rest


def advance_time(state: State, duration: ArrayLike, end: ArrayLike, at_end: ArrayLike) -> State:
    """The state with its time after a duration, or at the end; a compensated sum."""
    step = state.time_rest + duration
    time = state.time + step
    return state._replace(
        time=jnp.where(at_end, end, time),
        time_rest=jnp.where(at_end, 0.0, step - (time - state.time)),
    )


@jax.jit
def wrap_positions(state: State, side: ArrayLike) -> State:
    """The same state with every position inside the box; a new neighbour list must follow."""
    inside = neighbours.wrap(side, state.position)
    image = state.image + jnp.round((state.position - inside) / side).astype(jnp.int32)
    return state._replace(position=inside, image=image)


def centred(values: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas N d"]:
    """Values less their mean over each replica: in the frame in which its momentum is zero."""
    each = values.reshape(replicas, -1, values.shape[-1])
    return each - jnp.mean(each, axis=1, keepdims=True)


def temperature(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """T of each replica."""
    return observables.temperature(centred(velocity, replicas))


def kinetic_energy(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """Kinetic energy of each replica in the laboratory frame."""
    return 0.5 * jnp.sum(velocity.reshape(replicas, -1) ** 2, axis=-1)


def fastest(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """Speed of the fastest sphere of each replica."""
    return jnp.sqrt(jnp.max(jnp.sum(velocity * velocity, -1).reshape(replicas, -1), axis=-1))


def common_records(
    state: State, side: ArrayLike, replicas: int
) -> tuple[dict[str, Array], Float[Array, "replicas N d"], Float[Array, "replicas N d"]]:
    """What is recorded of every kind of spheres, and displacements and velocities, centred."""
    velocity = centred(state.velocity, replicas)
    travelled = centred(state.position - state.origin + side * state.image, replicas)
    num_particles = velocity.shape[1]
    position = state.position.reshape(velocity.shape)
    values = {
        "temperature": observables.temperature(velocity),
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(travelled),
        "velocity_correlation": observables.velocity_correlation(
            centred(state.first_velocity, replicas), velocity
        ),
        "dissipated_energy": state.dissipated / num_particles,
        "collisions": 2 / num_particles * state.collisions,
        "flow_share": jax.vmap(partial(observables.flow_share, side=side))(position, velocity),
    }
    return values, travelled, velocity


def derivatives_of_records(
    values: dict[str, Array],
    travelled: Float[Array, "replicas N d"],
    velocity: Float[Array, "replicas N d"],
    log_temperature: Float[Array, "p replicas"],
    paths: PathTangents,
    cooling: Float[Array, "replicas"],
    meeting: Float[Array, "replicas"],
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Derivatives of the records of `records`, as `jaxgran.gradients.rule.with_tangents` takes them.

    In time ``<v(0).v>`` decays at 2/d of the collision rate.

    Args:
        values, travelled, velocity: what `records` returns.
        log_temperature: derivatives of ln T along p directions.
        paths: tangents of the paths.
        cooling: ``-d ln T/dt``.
        meeting: collisions per particle and time.

    Returns:
        The derivatives along the directions at a fixed place, and those in time.
    """
    c, d = log_temperature, velocity.shape[-1]
    T, C = values["temperature"], values["velocity_correlation"]
    kept = {
        "temperature": c * T[None],
        "displacement": paths.log_displacement * values["displacement"][None],
        "velocity_correlation": (0.5 * c + paths.correlation_along) * C[None],
    }
    rates = {
        "temperature": -cooling * T,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, -1), axis=1),
        "velocity_correlation": -2 / d * meeting * C,
        "collisions": meeting,
    }
    return kept, rates


def empty_records(observed: dict[str, jax.Array], num_times: int) -> dict[str, np.ndarray]:
    """Records at so many times, of the shapes and types of those at one time."""
    each = {name: np.asarray(value) for name, value in observed.items()}
    return {name: np.zeros((num_times, *v.shape), v.dtype) for name, v in each.items()}


def fill_nan_from(records: dict[str, np.ndarray], done: int) -> None:
    """Nan from the time of a failure on; 0 where there is no nan."""
    for values in records.values():
        values[done:] = np.nan if np.issubdtype(values.dtype, np.inexact) else 0

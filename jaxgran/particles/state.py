"""The state of spheres in periodic boxes, soft or hard, and what is recorded of it.

Units here: diameter, mass and first temperature are 1. All particles of all boxes stand in one
array, replica after replica (n = replicas * N rows).
"""

from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.particles import neighbours, observables
from jaxgran.tangents.paths import PathTangents

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
    own: Any
    tangents: Any = None


def at_start(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    side: ArrayLike,
    skin: ArrayLike,
    replicas: int,
    own: Any,
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
        own=own,
    )


def owned(state: S) -> S:
    """The same state in buffers of its own, none of them twice, which may be donated."""
    return jax.tree.map(jnp.copy, state)


def time_left(state: State, end: ArrayLike) -> Array:
    """The time from a state to an end."""
    return (jnp.asarray(end) - state.time) - state.time_rest


def later(state: State, duration: ArrayLike, end: ArrayLike, at_end: ArrayLike) -> State:
    """The state with its time after a duration, or at the end; a compensated sum."""
    step = state.time_rest + duration
    time = state.time + step
    return state._replace(
        time=jnp.where(at_end, end, time),
        time_rest=jnp.where(at_end, 0.0, step - (time - state.time)),
    )


@jax.jit
def rewrapped(state: State, side: ArrayLike) -> State:
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


def records(
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
    """Derivatives of the records of `records`, as `jaxgran.tangents.rule.with_tangents` takes them.

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


def spoil(records: dict[str, np.ndarray], done: int) -> None:
    """Nan from the time of a failure on; 0 where there is no nan."""
    for values in records.values():
        values[done:] = np.nan if np.issubdtype(values.dtype, np.inexact) else 0

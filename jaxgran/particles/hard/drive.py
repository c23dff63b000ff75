"""The drive of hard spheres: random kicks, half of them at each end of a window.

Kicks whose components have a variance make T grow by this variance, as the mass is 1. Units as in
`jaxgran.particles.hard.impacts`: with drag times and velocities are transformed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, UInt32

from jaxgran.particles.elements import (
    MAX_KICK,
    KickGrowth,
    kick_growth,
    random_kicks,
    threefry_key,
)
from jaxgran.particles.spheres import SphereState, by_replica, temperature
from jaxgran.scene.reduced import ReducedScene, SphereScene

DRIVE_STREAM = 3
"""Stream of a drive's random numbers, apart from the stream of the start."""


def initial_kick_key(key: PRNGKeyArray) -> UInt32[Array, "3"]:
    """Return the two words of a key for all kicks of a run, and the number of kicks made, 0."""
    words = jax.random.bits(jax.random.fold_in(key, DRIVE_STREAM), (2,), jnp.uint32)
    return jnp.concatenate([words, jnp.zeros(1, jnp.uint32)])


def kick_at_start(state: SphereState, scene: SphereScene, duration: ArrayLike) -> SphereState:
    """Return the state with the first half of the kicks of a window; as it is without a drive.

    Args:
        state: at the start of the window.
        scene: the gas.
        duration: of the window.
    """
    if scene.material.drive is None:
        return state
    return _kicked(state, scene, _growth_in_window(state, scene, duration).at_start)


def kick_at_end(state: SphereState, scene: SphereScene, duration: ArrayLike) -> SphereState:
    """Return the state with the second half of the kicks of a window; as it is without a drive.

    Args:
        state: after the impacts of the window, with the time at its start.
        scene: the gas.
        duration: of the window.
    """
    if scene.material.drive is None:
        return state
    return _kicked(state, scene, _growth_in_window(state, scene, duration).at_end)


def window_of_small_kicks(state: SphereState, scene: SphereScene) -> Float[Array, ""]:
    """Return the duration in which the coldest replica is heated by the share `MAX_KICK`.

    It is infinite without a drive.
    """
    if scene.material.drive is None:
        return jnp.asarray(jnp.inf, state.velocity.dtype)
    lowest = jnp.min(temperature(state.velocity, len(state.dissipated)))
    rate = 2 * _growth_in_window(state, scene, jnp.ones_like(lowest)).at_start
    safe_rate = jnp.where(rate > 0, rate, 1.0)
    return jnp.where(rate > 0, MAX_KICK * lowest / safe_rate, jnp.inf)


def heat_of_kicks(
    state: SphereState, scene: SphereScene, duration: ArrayLike, directions: ReducedScene
) -> tuple[Float[Array, ""], Float[Array, "p"]]:
    """Return the mean energy that a replica gains by the kicks of a window, and its tangents.

    Args:
        state: at the start of the window.
        scene: the gas, with a drive.
        duration: of the window.
        directions: of the tangents in the material, stacked along a first axis.
    """
    num_components = state.velocity.size / len(state.dissipated)

    def heat(material: ReducedScene) -> Array:
        growth = _growth_in_window(state, scene._replace(material=material), duration)
        return num_components / 2 * (growth.at_start + growth.at_end)

    value, linear = jax.linearize(heat, scene.material)
    return value, jax.vmap(linear)(directions)


def _growth_in_window(state: SphereState, scene: SphereScene, duration: ArrayLike) -> KickGrowth:
    """Return the growth of T by the kicks of a window that starts at the time of the state."""
    strength = scene.material.drive * scene.collision_frequency
    start = state.time + state.time_rest
    return kick_growth(strength, scene.drag_rates, start, jnp.asarray(duration))


def _kicked(state: SphereState, scene: SphereScene, variance: Float[Array, ""]) -> SphereState:
    """Return the state after kicks whose components have a variance."""
    counted_key = state.internal.key
    replicas = len(state.dissipated)
    zero_momentum = scene.container is None
    key = jax.random.fold_in(threefry_key(counted_key[:2]), counted_key[2])
    velocity = by_replica(state.velocity, replicas)
    kicks = jax.vmap(random_kicks, (0, 0, None))(
        jax.random.split(key, replicas), velocity, zero_momentum
    )
    velocity = velocity + jnp.sqrt(variance) * kicks
    internal = state.internal._replace(key=counted_key.at[2].add(jnp.uint32(1)))
    return state._replace(velocity=velocity.reshape(state.velocity.shape), internal=internal)
